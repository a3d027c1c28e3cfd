"""The axes of each Gaussian by falling scale: of the 24 equal forms of a (quaternion, scale) pair, four are left.

A covariance does not change when its axes are permuted or flipped. Sorted, a scale tells something about the next; of
the four orientations left, the one nearest to a neighbour's is coded (turns.py). In -> out: scales of one frame -> the
same choice for every frame, so that trajectories stay smooth.
"""

from itertools import permutations

import numpy as np

_HALF = np.sqrt(0.5)


def quat_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of wxyz quaternions, [..., 4] x [..., 4] -> [..., 4]."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    out = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    out[..., 0] = aw * bw - ax * bx - ay * by - az * bz
    out[..., 1] = aw * bx + ax * bw + ay * bz - az * by
    out[..., 2] = aw * by - ax * bz + ay * bw + az * bx
    out[..., 3] = aw * bz + ax * by - ay * bx + az * bw
    return out


def quat_conjugate(q: np.ndarray) -> np.ndarray:
    """Inverse of unit wxyz quaternions, [..., 4] -> [..., 4]."""
    return q * np.array([1, -1, -1, -1], q.dtype)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] turned by unit quaternions [..., 4]."""
    u, w = q[..., 1:], q[..., :1]
    return v + 2 * np.cross(u, np.cross(u, v) + w * v)


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


def canonical_axes(log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The form to code, by log_scales [N, 3] of the frame that decides.

    Returns:
        turn [N, 4] f64, by which quaternions of every frame are right-multiplied; order [N, 3] int, the axes by
        falling scale.
    """
    order = np.argsort(-log_scales, axis=1, kind="stable")
    code = np.array([o[0] * 9 + o[1] * 3 + o[2] for o in _ORDERS])
    which = np.searchsorted(code, order[:, 0] * 9 + order[:, 1] * 3 + order[:, 2])
    return _PERMUTATION_QUATS[which], order
