"""Axes of each Gaussian sorted by falling scale: of the 24 equal forms of a (quaternion, scale) pair, four are left.

A covariance does not change when its axes are permuted or flipped. Sorted, each scale predicts the next one; of the
four orientations left, the one nearest to a neighbour's orientation is coded (rotation_residuals.py). In: canonical
scales. Out: one choice for all frames, so that trajectories stay smooth.
"""

from itertools import permutations

import numpy as np


def _permutation_quat(order: tuple[int, ...]) -> np.ndarray:
    """Quaternion of the rotation whose column j is +-axis order[j]."""
    R = np.zeros((3, 3))
    R[list(order), range(3)] = 1
    if np.linalg.det(R) < 0:
        R = -R  # an odd permutation needs one flip or three; the sign of an axis means nothing here
    w = np.sqrt(max(0.0, 1 + np.trace(R))) / 2
    if w > 0.1:
        v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
        return np.array([w, *v])
    i = int(np.argmax(np.diag(R)))
    v = (R[:, i] + np.eye(3)[i]) / 2
    return np.array([0.0, *(v / np.linalg.norm(v))])


_ORDERS = list(permutations(range(3)))
_PERMUTATION_QUATS = np.stack([_permutation_quat(o) for o in _ORDERS])  # [6, 4]


def sorted_axes(log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axis order to code, from log_scales [N, 3].

    Returns:
        order [N, 3] int, the axes by falling scale; rotation [N, 4] f32, right factor of the quaternions of all frames.
    """
    order = np.argsort(-log_scales, axis=1, kind="stable")
    code = np.array([o[0] * 9 + o[1] * 3 + o[2] for o in _ORDERS])
    which = np.searchsorted(code, order[:, 0] * 9 + order[:, 1] * 3 + order[:, 2])
    return order, _PERMUTATION_QUATS[which].astype(np.float32)
