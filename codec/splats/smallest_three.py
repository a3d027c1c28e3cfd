"""Unit quaternions <-> their three smallest components and the index of the largest.

The largest component follows from the unit length. compressed.ply and SOG quantize rotations this way; component order
is wxyz in both.
"""

from __future__ import annotations

import numpy as np

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # row: index of the largest component; the other three


def split_smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, 4] -> [N, 3] f64 in +-1/sqrt(2) and [N] index; the sign makes the largest component positive."""
    q = quats.astype(np.float64)
    largest = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1, 1)[:, None]
    return q[rows[:, None], OTHERS[largest]], largest


def join_smallest_three(small: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """[N, 3] and [N] index -> [N, 4], the mirror of split_smallest_three."""
    out = np.empty((len(small), 4))
    rows = np.arange(len(small))
    out[rows[:, None], OTHERS[largest]] = small
    out[rows, largest] = np.sqrt(np.maximum(0, 1 - (small**2).sum(1)))
    return out
