"""Skin weights: positions in a posed frame -> weights of the joints, as the integers of the stream.

Weights come from the nearest vertices of the rig's skin if it has one, else from the distance to the bones. The rig
does not move positions far from both, such as a wall behind a figure.
"""

from __future__ import annotations

import numpy as np

from .rig import Rig

WHOLE = 64  # sum of the weights of a position
MOST_JOINTS = 4  # joints that move one position, at most
LEAST = 0.04  # of the largest share of a position; smaller shares are left out
REACH = 0.25  # of the largest extent of the skeleton; positions farther away are not moved
SHARPNESS = 8.0  # weights fall with this power of the distance to a bone
NEAREST = 4  # vertices whose weights are averaged for a position


def skin_weights(rig: Rig, frame: int, places: np.ndarray) -> np.ndarray:
    """[M, J] u8, weights of positions [M, 3] of a frame; each row sums to 64, or is 0."""
    reach = REACH * float(np.ptp(rig.joints, axis=0).max(initial=0.0))
    shares, distance = (_by_bones if rig.vertices is None else _by_vertices)(rig, frame, places)
    if len(rig.joints) > 1:  # a single joint has no extent
        shares[distance > reach] = 0
    return integer_weights(shares)


def integer_weights(shares: np.ndarray) -> np.ndarray:
    """Shares [M, J] >= 0 -> [M, J] u8: the `MOST_JOINTS` largest, summing to 64 by largest remainders; 0 rows stay."""
    shares = np.asarray(shares, np.float64)
    least = np.sort(shares, 1)[:, -min(MOST_JOINTS, shares.shape[1])][:, None]
    shares = np.where((shares >= least) & (shares >= LEAST * shares.max(1, keepdims=True)), shares, 0)
    total = shares.sum(1, keepdims=True)
    exact = WHOLE * shares / np.maximum(total, 1e-30)
    whole = np.floor(exact)
    rank = np.argsort(np.argsort(whole - exact, 1, kind="stable"), 1)
    missing = WHOLE - whole.sum(1, keepdims=True)
    return np.where(total > 0, whole + (rank < missing), 0).astype(np.uint8)


def _by_vertices(rig: Rig, frame: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    posed = rig.posed(frame, rig.vertices, integer_weights(rig.weights))
    distance, near = cKDTree(posed).query(places, min(NEAREST, len(posed)))
    distance, near = distance.reshape(len(places), -1), near.reshape(len(places), -1)
    share = 1 / np.maximum(distance, 1e-9)
    shares = np.einsum("mk,mkj->mj", share / share.sum(1, keepdims=True), rig.weights[near])
    return shares, distance[:, 0]


def _by_bones(rig: Rig, frame: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each joint moves the bones from it to its children."""
    count = len(rig.joints)
    own = WHOLE * np.eye(count, dtype=np.uint8)
    joints = rig.posed(frame, rig.joints, own).astype(np.float64)
    distance = np.linalg.norm(places[:, None] - joints, axis=2)  # [M, J]
    for child, parent in enumerate(rig.parents):
        if parent != child:
            a, b = joints[parent], joints[child]
            along = b - a
            share = np.clip((places - a) @ along / max(along @ along, 1e-30), 0, 1)
            bone = np.linalg.norm(places - a - share[:, None] * along, axis=1)
            distance[:, parent] = np.minimum(distance[:, parent], bone)
    nearest = distance.min(1)
    return (np.maximum(nearest, 1e-9)[:, None] / np.maximum(distance, 1e-9)) ** SHARPNESS, nearest
