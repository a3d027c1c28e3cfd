"""A zip of splats -> a temporary folder, which lives as long as the process. Sizes are checked before unpacking."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
import zlib
from functools import lru_cache
from pathlib import Path

from ..errors import CaptureError

FILES_MAX = 100_000
RATIO_MAX = 100  # of unpacked to packed bytes; splats hardly shrink, so a zip with a higher ratio is a zip bomb
SPARE = 256 << 20  # bytes that stay free on the disk
_folders: list[tempfile.TemporaryDirectory] = []  # removed at exit


def unpacked(path: Path) -> Path:
    """The folder, or the only file, that the zip holds; the same zip is unpacked once.

    Raises:
        CaptureError: not a zip, damaged, protected, or larger than the disk has room for.
    """
    stat = path.stat()
    return _unpacked(path.resolve(), stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=8)
def _unpacked(path: Path, _: int, size: int) -> Path:
    try:
        with zipfile.ZipFile(path) as z:
            members = [i for i in z.infolist() if not i.is_dir() and not _is_litter(i.filename)]
            _check(path, members, size)
            folder = tempfile.TemporaryDirectory(prefix="gscodec-")
            _folders.append(folder)
            for member in members:
                z.extract(member, folder.name)  # drops parts of the path that lead outside
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as e:
        raise CaptureError(f"{path}: not a readable zip ({e}), expected a zip of splats") from None
    inner = Path(folder.name)
    while len(found := list(inner.iterdir())) == 1 and not _is_frame(found[0]):
        inner = found[0]
        if inner.is_file():
            break
    return inner


def _is_frame(folder: Path) -> bool:
    """Whether the folder is a numbered frame, of VideoGS's checkpoints or an unpacked SOG."""
    return folder.name.isdigit() and any((folder / inside).exists() for inside in ("point_cloud", "meta.json"))


def _is_litter(name: str) -> bool:
    """Whether the file is one that archivers of macOS add."""
    return name.startswith("__MACOSX/") or name.rpartition("/")[2].startswith(".")


def _check(path: Path, members: list[zipfile.ZipInfo], size: int) -> None:
    total, free = sum(i.file_size for i in members), shutil.disk_usage(tempfile.gettempdir()).free
    if not members or len(members) > FILES_MAX:
        raise CaptureError(f"{path}: {len(members)} files, expected a zip of 1 to {FILES_MAX} files")
    if total > RATIO_MAX * size or total > free - SPARE:
        most = max(0, min(RATIO_MAX * size, free - SPARE))
        raise CaptureError(f"{path}: {total} bytes once unpacked, expected at most {most}; unpack it yourself")
