"""`gscodec play`: checks the file, serves it, opens the browser."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from pathlib import Path

from gscodec.decode import open_stream
from gscodec.player.server import Server


def play_stream(path: Path, *, host: str, port: int, browser: bool, say: Callable[[str], object]) -> None:
    """Serves the file `path` and the player until Ctrl-C. A file that is being written plays as it grows.

    Args:
        browser: open the page.
        say: prints the address.

    Raises:
        OSError, BitstreamError: the file does not exist or is not a .gsv file.
        UsageError: the address cannot be used.
    """
    open_stream(path)  # reports a bad file here instead of in the page
    server = Server(path, host=host, port=port)
    say(f"{path} plays at {server.url} (Ctrl-C ends it)")
    if browser:
        webbrowser.open(server.url)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass  # Ctrl-C ends the command
    finally:
        server.server_close()
