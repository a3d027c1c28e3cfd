"""Frames that are read from files on demand: sequences may be larger than memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.gaussians import Gaussians
from .files import read_splat

KEEP = 4  # frames in memory


class Frames(Sequence):
    """Lazy frames of a folder: reads and reorders a frame when asked for, keeps the last few; thread-safe."""

    def __init__(self, paths: list[Path], orders: dict[int, np.ndarray], hidden: dict[int, tuple] | None = None):
        """
        Args:
            orders: frame -> [N] int, index in the file of each Gaussian.
            hidden: frame -> ([N] bool, Gaussians outside their lifetime; their logit opacities [H]).
        """
        self._paths, self._orders, self._hidden = paths, orders, hidden or {}
        self._kept: OrderedDict[int, Gaussians] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, t):
        if isinstance(t, slice):
            return FrameRange(self, range(len(self))[t])
        t = range(len(self))[t]
        with self._lock:
            kept = self._kept.get(t)
        if kept is not None:
            return kept
        read = self._read(t)
        with self._lock:
            self._kept[t] = read
            while len(self._kept) > KEEP:
                self._kept.popitem(last=False)
        return read

    def _read(self, t: int) -> Gaussians:
        g = read_splat(self._paths[t])
        if t in self._orders:
            g = g.take(self._orders[t])
        if t in self._hidden:
            where, values = self._hidden[t]
            if len(where) != len(g) or where.sum() != len(values):
                raise CaptureError(f"{self._paths[t]}: {len(g)} Gaussians, sequence.json has lifetimes of {len(where)}")
            opacities = g.logit_opacities.copy()
            opacities[where] = values
            g = replace(g, logit_opacities=opacities)
        return g


class FrameRange(Sequence):
    """A range of the frames of a `Frames`, also lazy."""

    def __init__(self, frames: Frames, index: range):
        self._frames, self._index = frames, index

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, t):
        if isinstance(t, slice):
            return FrameRange(self._frames, self._index[t])
        return self._frames[self._index[t]]
