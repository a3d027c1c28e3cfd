"""`gscodec render`: stream -> video or images, on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..frame_range import frame_range
from ..progress import Bar
from .inputs import open_stream_of_frames
from .options import Frames, StreamPath, stdout
from .tracks import Tracks


def render(
    stream: StreamPath,
    dest: Annotated[Path, typer.Argument(metavar="DEST", help="A .mp4 file or a folder for .png images.")],
    camera: Annotated[str, typer.Option(help="orbit, the name of a reference camera, or a camera .json.")] = "orbit",
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Picture size.")] = None,
    frames: Frames = None,
    track: Tracks = None,
) -> None:
    """Render a stream on the CPU to a video or images."""
    from ..render.movie import render_stream

    s = open_stream_of_frames(stream, track)
    with Bar() as bar:
        count = render_stream(s, dest, camera=camera, size=size, frames=frame_range(frames, s.frame_count), bar=bar)
    stdout.print(f"{dest}: {count} frames")
