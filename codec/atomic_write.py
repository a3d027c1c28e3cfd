"""Files appear complete or not at all: written as NAME.part, renamed at the end, removed on failure."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np


@contextmanager
def part_file(path: Path) -> Iterator[Path]:
    """Yields NAME.part to write to; when the block ends well it becomes `path`, which it replaces."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Arrays by name as an .npz file."""
    with part_file(path) as part, part.open("wb") as f:
        np.savez(f, **arrays)


def read_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """The mirror of `write_arrays`; None where there is no such file, or a damaged one."""
    try:
        with np.load(path) as z:
            return dict(z)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
