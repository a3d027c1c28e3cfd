"""`gscodec play`: serves the web player and a stream on this machine, and opens the browser."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from .inputs import open_tracks
from .options import StreamPath, stdout
from .tracks import Tracks, place


def play(
    stream: StreamPath,
    port: Annotated[int, typer.Option(help="Port of the local server, 0: any free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 lets other machines watch.")] = "127.0.0.1",
    export: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Do not serve: write the page and the stream to DIR, for any host."),
    ] = None,
    track: Tracks = None,
) -> None:
    """Play a stream in the browser. Needs no GPU; Ctrl-C ends it."""
    part = stream.with_name(stream.name + ".part")
    if not stream.exists() and part.exists():  # it is being written
        stream = part
    with TemporaryDirectory() as folder:
        shown = _placed(stream, Path(folder), track) if track else stream
        if export:
            from gscodec.player.export import export_page

            stdout.print(export_page(shown, export))
            return
        from gscodec.player.play import play_stream

        play_stream(shown, host=host, port=port, browser=not no_browser, say=stdout.print)


def _placed(stream: Path, folder: Path, track: list[str]) -> Path:
    """A copy of the stream in which its tracks are as the options say."""
    from ..encode.tracks import TrackPlan, write_tracks

    copy = folder / stream.name
    write_tracks(copy, [TrackPlan.of(t) for t in place(open_tracks(stream), track).tracks])
    return copy
