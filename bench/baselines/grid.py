"""Gaussians -> their order on a square grid with similar neighbours, for image and video codecs.

Parallel linear assignment sorting (PLAS, Morgenstern et al. 2024, "Compact 3D Scene Representation via
Self-Organizing Gaussian Grids") in numpy: the Gaussians of four random cells take the best of their 24 permutations
against a blurred copy of the grid; the radius of the blur shrinks. The start is Morton order along a Morton curve
instead of a random order, which needs fewer rounds for the same smoothness.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from gscodec.errors import require
from gscodec.model.gaussians import Gaussians

PERMUTATIONS = np.array(list(permutations(range(4))))  # [24, 4]
SHRINK, RADIUS_MIN = 0.93, 1.0
SWAPS = 3  # rounds of swapping for each blur
POSITION_WEIGHT = 16


def side_of(count: int) -> int:
    """Side of the smallest square of `count` cells, a multiple of 8 and at least 16, since x265 takes no 8 x 8."""
    return max(16, 8 * int(np.ceil(np.sqrt(count) / 8)))


def morton(coordinates: np.ndarray) -> np.ndarray:
    """[N, D] unsigned integers below 2^(63 // D) -> [N] codes of interleaved bits."""
    dimensions = coordinates.shape[1]
    code = np.zeros(len(coordinates), np.uint64)
    for bit in range(63 // dimensions):
        for d in range(dimensions):
            code |= ((coordinates[:, d].astype(np.uint64) >> np.uint64(bit)) & np.uint64(1)) << np.uint64(
                bit * dimensions + d
            )
    return code


def morton_order(means: np.ndarray) -> np.ndarray:
    """[N] order of positions along a Morton curve of 2^16 steps a side."""
    low, high = means.min(0), means.max(0)
    return np.argsort(morton(((means - low) / max(float((high - low).max()), 1e-9) * 65535).astype(np.int64)))


def grid_order(g: Gaussians, seed: int = 0) -> np.ndarray:
    """[side, side] index of the Gaussian in each cell; -1 where there is none."""
    blur = require("scipy.ndimage", "sorting Gaussians on a grid").uniform_filter
    side = side_of(len(g))
    cells = side * side
    features = np.concatenate([g.means, g.sh0, g.log_scales, g.quats, g.logit_opacities[:, None]], 1)
    features = (features - features.mean(0)) / np.maximum(features.std(0), 1e-6)
    features[:, :3] *= POSITION_WEIGHT  # Gaussians close to each other move alike
    features = np.concatenate([features, np.zeros((cells - len(g), features.shape[1]))]).astype(np.float32)
    curve = np.argsort(morton(np.indices((side, side)).reshape(2, -1).T))
    held = np.empty(cells, np.int64)  # the Gaussian of each cell
    held[curve] = np.concatenate([morton_order(g.means), np.arange(len(g), cells)])
    rng, radius = np.random.default_rng(seed), side / 4
    rows, columns = np.indices((side, side)).reshape(2, -1)
    while radius >= RADIUS_MIN:
        size = int(radius)
        target = blur(features[held].reshape(side, side, -1), (2 * size + 1, 2 * size + 1, 1), mode="nearest")
        target = target.reshape(cells, -1)
        for _ in range(SWAPS):
            dy, dx = rng.integers(0, size + 1, 2)
            block = (rows + dy) // (size + 1) * (side + 1) + (columns + dx) // (size + 1)
            quad = np.argsort(block + rng.random(cells)).reshape(-1, 4)  # four random cells of a block
            _assign(held, quad, features, target)
        radius *= SHRINK
    return np.where(held < len(g), held, -1).reshape(side, side)


def _assign(held: np.ndarray, quad: np.ndarray, features: np.ndarray, target: np.ndarray) -> None:
    """Permutes the Gaussians of each four cells to the least squared distance from the targets."""
    products = features[held[quad]] @ target[quad].swapaxes(1, 2)  # the squares are the same for all permutations
    scores = sum(products[:, PERMUTATIONS[:, j], j] for j in range(4))  # [Q, 24]
    best = PERMUTATIONS[scores.argmax(1)]
    held[quad] = np.take_along_axis(held[quad], best, 1)
