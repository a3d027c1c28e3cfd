"""Two frames of splats -> the same Gaussian at index i (identity), a matching of the indices, or neither.

Only positions are compared. Under identity, displacements must be far below the distances of random pairs. This also
holds for frames that were each sorted along a space-filling curve (SOG), where a third of the indices may be swapped
locally. But on a moving body spatial neighbours have similar displacements, and swapped indices do not. So identity
and nearest-neighbour matching are compared by the roughness of their displacement fields.
"""

from __future__ import annotations

import numpy as np

from ..errors import require

FAR_BELOW = 0.1  # largest ratio of the median displacement of tracked Gaussians to that of random pairs
ROUGH = 1.5  # displacement fields at least this rough are no motion
SMOOTH = 0.1  # identity is taken without trying a matching up to this roughness
BETTER = 0.5  # a matching replaces identity if its roughness is below this share of identity's
MUTUAL = 0.9  # least share of mutual nearest neighbours in a matching
SAMPLES = 4000  # Gaussians that roughness is measured on
LEFT_MAX = 3000  # Gaussians, at most, that are matched by assignment, which takes cubic time


def relate(a: np.ndarray, b: np.ndarray) -> np.ndarray | bool:
    """How the Gaussians of one frame continue in the next.

    Args:
        a, b: [N, 3] positions of the two frames.

    Returns:
        True: index i is the same Gaussian in both. An order [N] int: b[order[i]] is a[i] moved. False: neither.
    """
    tree = require("scipy.spatial", "checking whether splats are tracked").cKDTree
    if len(a) < 8:
        return bool(np.array_equal(a, b))
    rng = np.random.default_rng(0)
    pick = rng.permutation(len(a))[:SAMPLES]
    near = tree(a, balanced_tree=False, compact_nodes=False).query(a[pick], k=2)  # twice as fast for few queries
    other = np.where(
        near[1][:, 0] == pick, near[1][:, 1], near[1][:, 0]
    )  # two Gaussians in one place may come in either order
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
    """[N] int, a one-to-one matching of two sets of N positions: mutual nearest neighbours, then the least sum of
    squared distances for the rest. None: too few mutual nearest neighbours."""
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
