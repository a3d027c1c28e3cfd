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
    """Yields NAME.part to write to; if the block succeeds, NAME.part is renamed to `path`, which it replaces."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes arrays, by name, to an .npz file."""
    with part_file(path) as part, part.open("wb") as f:
        np.savez(f, **arrays)


def read_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Inverse of `write_arrays`; None if the file is missing or damaged."""
    try:
        with np.load(path) as z:
            return dict(z)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
