"""Vector quantization for the formats that index codebooks: values -> a small table and indices into it.

Scalars: Lloyd's algorithm on sorted values, where each iteration is a binary search and a prefix sum. SH vectors: a
palette by repeated median cuts; k-means with 65,536 entries would take minutes and not be visibly better.
"""

from __future__ import annotations

import numpy as np

STEPS = 8  # iterations of Lloyd's algorithm; more reduce the error by less than 1 %


def codebook(values: np.ndarray, size: int = 256) -> tuple[list[float], np.ndarray]:
    """Values of any shape -> `size` sorted levels and the index of the nearest level, in the shape of `values`."""
    flat = np.sort(values.ravel().astype(np.float64))
    levels = np.unique(flat)
    if len(levels) > size:
        levels = _start(flat, size)
        total = np.concatenate([[0], np.cumsum(flat)])
        for _ in range(STEPS):
            ends = np.concatenate([[0], np.searchsorted(flat, (levels[1:] + levels[:-1]) / 2), [len(flat)]])
            count = np.diff(ends)
            levels = np.where(count > 0, np.diff(total[ends]) / np.maximum(count, 1), levels)
        levels = np.sort(levels)
    levels = np.concatenate([levels, np.full(size - len(levels), levels[-1])]).astype(np.float32)
    middle = (levels[1:].astype(np.float64) + levels[:-1]) / 2
    return levels.tolist(), np.searchsorted(middle, values.astype(np.float64))


def _start(flat: np.ndarray, size: int) -> np.ndarray:
    """[size] initial levels; their density is the cube root of that of the values, the optimum for squared error
    (Bennett 1948)."""
    count, edges = np.histogram(flat, size)
    share = np.concatenate([[0], np.cumsum(np.cbrt(count))])
    return np.interp((np.arange(size) + 0.5) / size, share / share[-1], edges)


def palette(vectors: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """[N, D] -> at most `size` entries [P, D] and labels [N]; exact if there are at most `size` distinct vectors."""
    entries, label = np.unique(vectors, axis=0, return_inverse=True)
    if len(entries) <= size:
        return entries, label.ravel()
    cells = [np.arange(len(vectors))]
    while 2 * len(cells) <= size:
        cells = [half for cell in cells for half in _cut(vectors, cell)]
    label = np.empty(len(vectors), np.int64)
    for i, cell in enumerate(cells):
        label[cell] = i
    return np.stack([vectors[cell].mean(0) for cell in cells]), label


def _cut(vectors: np.ndarray, cell: np.ndarray) -> list[np.ndarray]:
    if len(cell) < 2:
        return [cell]
    own = vectors[cell]
    order = cell[np.argsort(own[:, own.var(0).argmax()], kind="stable")]
    return [order[: len(order) // 2], order[len(order) // 2 :]]
