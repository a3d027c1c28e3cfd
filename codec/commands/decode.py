"""`gscodec decode`: stream -> one standard 3DGS .ply per frame, or the points alone as Draco files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .inputs import open_stream_of_frames
from .options import StreamPath, stdout


def decode(
    stream: StreamPath,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    drc: Annotated[bool, typer.Option("--drc", help="Only the points, as Draco files.")] = False,
) -> None:
    """Stream to one standard 3DGS .ply per frame."""
    from ..splats import write_sequence, write_splat

    s = open_stream_of_frames(stream)
    if drc:
        folder.mkdir(parents=True, exist_ok=True)
        for t in range(s.frame_count):
            write_splat(folder / f"{t:06d}.drc", s.frame(t))
    else:
        write_sequence(s.sequence(), folder)
    stdout.print(f"{folder}: {s.frame_count} frames")
