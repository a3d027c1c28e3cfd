"""Maps and tiles (spec 7.2): Gaussians of a layer <-> cells of the W x H planes of its channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class HilbertLayout:
    """The map of a layer.

    Attributes:
        width, height: size of the map in cells.
        side: side of a tile in cells.
        x, y: [N] column and row of each Gaussian.
    """

    width: int
    height: int
    side: int
    x: np.ndarray
    y: np.ndarray

    @staticmethod
    def of(tiles: list[int], side: int) -> HilbertLayout:
        """The map of a layer; `tiles`: number of Gaussians in each tile of `side` x `side` cells."""
        cells = side * side
        index = np.concatenate([np.arange(n) + cells * t for t, n in enumerate(tiles)] or [np.zeros(0, int)])
        used = cells * (len(tiles) - 1) + tiles[-1] if tiles else 0
        bits = (used.bit_length() - 1) >> 1 if used else 0
        square = 1 << 2 * bits
        x, y = _hilbert(index % square, bits)
        return HilbertLayout(1 << bits, (1 << bits) * -(-used // square), side, x, y + (index // square << bits))

    def arrange(self, values: np.ndarray) -> np.ndarray:
        """Values [N] of the Gaussians -> plane [H, W]; cells without a Gaussian are 0."""
        plane = np.zeros((self.height, self.width), values.dtype)
        plane[self.y, self.x] = values
        return plane

    def collect(self, plane: np.ndarray) -> np.ndarray:
        """Inverse of `arrange`."""
        return plane[self.y, self.x]


def _hilbert(t: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of each step of the Hilbert curve that fills a square of 2^bits x 2^bits cells."""
    x, y = np.zeros_like(t), np.zeros_like(t)
    for j in range(bits):
        s = 1 << j
        ry = 1 & (t >> 1)
        rx = 1 & (t ^ ry)
        back = (rx == 0) & (ry == 1)
        x, y = np.where(back, s - 1 - x, x), np.where(back, s - 1 - y, y)
        x, y = np.where(rx == 0, y, x) + s * rx, np.where(rx == 0, x, y) + s * ry
        t = t >> 2
    return x, y
