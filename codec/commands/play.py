"""`gscodec play`: serves the web player and a stream on this machine, and opens the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import StreamPath, stdout


def play(
    stream: StreamPath,
    port: Annotated[int, typer.Option(help="Port of the local server, 0: any free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 lets other machines watch.")] = "127.0.0.1",
    export: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Do not serve: write the page and the stream to DIR, for any host."),
    ] = None,
) -> None:
    """Play a stream in the browser. Needs no GPU; Ctrl-C ends it."""
    if export:
        from gscodec.player.export import export_page

        stdout.print(export_page(stream, export), markup=False)
        return
    from gscodec.player.play import play_stream

    play_stream(stream, host=host, port=port, browser=not no_browser, say=stdout.print)
