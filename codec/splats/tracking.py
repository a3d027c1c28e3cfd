"""Two frames of splats -> is index i the same Gaussian in both, or which index of the second is it, or neither?

Positions alone decide. The displacement of a tracked Gaussian is far below the distance of random pairs; but so is
that of frames that were each sorted along a space-filling curve (SOG), where a third of the indices may be swapped
locally. What tells them apart is that the displacements of spatial neighbours are alike on a body that moves, and
are not where indices are swapped. So identity and nearest-neighbour matching are compared by how rough their
displacement fields are.
"""

from __future__ import annotations

import numpy as np

from ..errors import require

FAR_BELOW = 0.1  # median displacement of tracked Gaussians over that of random pairs, at most
ROUGH = 1.5  # roughness from which a displacement field is no motion any more
SMOOTH = 0.1  # roughness below which nothing else needs to be tried
BETTER = 0.5  # a matching replaces identity if its field is at most this much as rough
MUTUAL = 0.9  # share of Gaussians that must be each other's nearest for a matching
SAMPLES = 4000
LEFT_MAX = 3000  # Gaussians that may be left to the (cubic) assignment


def relate(a: np.ndarray, b: np.ndarray) -> np.ndarray | bool:
    """How the Gaussians of one frame continue in the next.

    Args:
        a, b: [N, 3] positions of the two frames.

    Returns:
        True if index i is the same in both, an order ([N] int, b[order[i]] is a[i] moved) if they had to be matched, or
        False if neither holds.
    """
    tree = require("scipy.spatial", "checking whether splats are tracked").cKDTree
    if len(a) < 8:
        return bool(np.array_equal(a, b))
    rng = np.random.default_rng(0)
    pick = rng.permutation(len(a))[:SAMPLES]
    near = tree(a, balanced_tree=False, compact_nodes=False).query(a[pick], k=2)  # for few queries, half of the time
    other = np.where(near[1][:, 0] == pick, near[1][:, 1], near[1][:, 0])  # of two at one place either may come first
    spacing = np.median(near[0][:, 1]) + 1e-9 * np.ptp(a, axis=0).max() + 1e-30

    def roughness(moved: np.ndarray) -> float:
        differ = (moved[pick] - a[pick]) - (moved[other] - a[other])
        return float(np.minimum(np.linalg.norm(differ, axis=1) / spacing, 4).mean())

    random = np.median(np.linalg.norm(a[pick] - b[rng.permutation(pick)], axis=1))
    close = np.median(np.linalg.norm(a[pick] - b[pick], axis=1)) <= FAR_BELOW * random
    own = roughness(b) if close else np.inf
    if own <= SMOOTH:
        return True
    order = match(a, b)
    if order is not None and roughness(b[order]) < min(ROUGH, BETTER * own):
        return order
    return own < ROUGH


def match(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """A one-to-one matching of two sets of N positions, nearest first; None if too few are each other's nearest."""
    tree = require("scipy.spatial", "matching splats").cKDTree
    forward, backward = tree(b).query(a)[1], tree(a).query(b)[1]
    mutual = backward[forward] == np.arange(len(a))
    left = np.flatnonzero(~mutual)
    if mutual.mean() < MUTUAL or len(left) > LEFT_MAX:
        return None
    order = np.where(mutual, forward, -1)
    if len(left):
        free = np.setdiff1d(np.arange(len(b)), order)
        cost = ((a[left, None] - b[None, free]) ** 2).sum(2)
        order[left] = free[require("scipy.optimize", "matching splats").linear_sum_assignment(cost)[1]]
    return order
