"""`gscodec decode`: stream -> one standard 3DGS .ply per frame, the points alone as Draco files, or maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .inputs import open_stream_of_frames
from .options import StreamPath, stdout


def decode(
    stream: StreamPath,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    drc: Annotated[bool, typer.Option("--drc", help="Only the points, as Draco files.")] = False,
    maps: Annotated[bool, typer.Option("--maps", help="The attribute maps as 16-bit images, and maps.json.")] = False,
) -> None:
    """Stream to one standard 3DGS .ply per frame, or to attribute maps."""
    from ..splats import write_sequence, write_splat

    if drc and maps:
        raise UsageError("--drc and --maps exclude each other")
    s = open_stream_of_frames(stream)
    if maps:
        from ..decode.maps import write_maps

        stdout.print(f"{folder}: {write_maps(s, folder)} images of {len(s.groups)} groups, maps.json")
        return
    if drc:
        folder.mkdir(parents=True, exist_ok=True)
        for t in range(s.frame_count):
            write_splat(folder / f"{t:06d}.drc", s.frame(t))
    else:
        write_sequence(s.sequence(), folder)
    stdout.print(f"{folder}: {s.frame_count} frames")
