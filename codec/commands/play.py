"""`gscodec play`: serves the web player and a stream on this machine, and opens the browser."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import StreamPath, stdout


def play(
    stream: StreamPath,
    port: Annotated[int, typer.Option(help="Port of the local server, 0: any free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 lets other machines watch.")] = "127.0.0.1",
) -> None:
    """Play a stream in the browser. Needs no GPU; Ctrl-C ends it."""
    from gscodec.player.play import play_stream

    play_stream(stream, host=host, port=port, browser=not no_browser, say=stdout.print)
