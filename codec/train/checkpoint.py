"""Checkpoints of training: the state from which the next group starts, on disk after every group."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..atomic_write import read_arrays, write_arrays


class Checkpoint:
    """Folder of states; None: nothing is written."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def _path(self, next_frame: int) -> Path:
        return self.folder / f"before_{next_frame:06d}.npz"

    def save(self, next_frame: int, state: dict[str, np.ndarray] | None) -> None:
        """Writes the state before `next_frame`, atomically; None: nothing is written.

        The last older state is kept: the stream may not hold the group between the two yet.
        """
        if self.folder is None or state is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        write_arrays(self._path(next_frame), state)
        for path in sorted(p for p in self.folder.glob("before_*.npz") if p < self._path(next_frame))[:-1]:
            path.unlink()

    def load(self, next_frame: int) -> dict[str, np.ndarray] | None:
        """The state that `save` wrote for `next_frame`, or None."""
        return None if self.folder is None else read_arrays(self._path(next_frame))

    def clear(self) -> None:
        """Removes the folder, after a complete run or before a new one."""
        if self.folder is not None and self.folder.is_dir():
            for path in self.folder.glob("before_*"):
                path.unlink()
            self.folder.rmdir()
