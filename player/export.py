"""`gscodec play --export`: a folder with the page and a stream, for any static host."""

from __future__ import annotations

import shutil
from pathlib import Path
from urllib.parse import quote

from gscodec.atomic_write import part_file
from gscodec.decode import open_stream
from gscodec.errors import UsageError
from gscodec.player.server import FILES, PAGE


def export_page(path: Path, folder: Path) -> str:
    """Copies page and stream `path` to `folder`, which may hold other streams. Files of the same name are replaced.

    Returns:
        The HTML that shows the stream in another page, with an address relative to the parent of `folder`.

    Raises:
        OSError, BitstreamError: the file does not exist or is not a .gsv file, or `folder` cannot be written.
        UsageError: the file has the name of a file of the page, or is still being written.
    """
    if path.name in FILES or path.suffix == ".part":
        raise UsageError(f"{path} cannot be exported under its name: expected a finished stream, such as movie.gsv")
    open_stream(path)  # reports a bad file here instead of in the page
    folder.mkdir(parents=True, exist_ok=True)
    for source in (*(PAGE / name for name in FILES), path):
        to = folder / source.name
        if to.exists() and to.samefile(source):
            continue
        with part_file(to) as part:
            shutil.copyfile(source, part)
    src = quote(path.name, safe=" ")  # an address itself
    address = f"{quote(folder.resolve().name)}/index.html?src={quote(src)}"
    return (
        f'<iframe src="{address}" width="640" height="480" allow="autoplay; fullscreen; xr-spatial-tracking"></iframe>'
    )
