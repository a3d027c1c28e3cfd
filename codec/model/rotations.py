"""Rotations, for numpy arrays and torch tensors alike: quaternions (wxyz, Hamilton), rotation vectors, matrices."""

from __future__ import annotations

import numpy as np

from .. import _native


def _namespace(a):
    """numpy, or torch for a tensor; torch is already loaded then."""
    if isinstance(a, np.ndarray):
        return np
    import torch

    return torch


def quat_multiply(a, b):
    """Hamilton product, [..., 4] x [..., 4] -> [..., 4] wxyz: the rotation b, then a."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    parts = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return _namespace(a).stack(parts, -1)


def quat_conjugate(q):
    """Inverse of unit quaternions, [..., 4] -> [..., 4]."""
    xp = _namespace(q)
    return q * xp.asarray([1.0, -1.0, -1.0, -1.0], dtype=q.dtype)


def quat_normalize(q):
    """[..., 4] -> unit length; a quaternion of length 0 stays 0."""
    length = _namespace(q).sqrt((q * q).sum(-1))[..., None]
    return q / (length + (length == 0))


def rotate(q, v):
    """Vectors [..., 3] rotated by unit quaternions [..., 4]."""
    w, x, y, z = (q[..., i] for i in range(4))
    a, b, c = (v[..., i] for i in range(3))
    # t = 2 u x v, then v + w t + u x t
    ta, tb, tc = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    parts = (a + w * ta + y * tc - z * tb, b + w * tb + z * ta - x * tc, c + w * tc + x * tb - y * ta)
    return _namespace(q).stack(parts, -1)


def rotvec_to_quat(v):
    """Rotation vectors [..., 3] in radians -> [..., 4] wxyz; smooth at zero."""
    xp = _namespace(v)
    half = xp.sqrt((v * v).sum(-1) + 1e-16)[..., None] / 2
    return xp.concatenate([xp.cos(half), v * (0.5 * xp.sinc(half / np.pi))], -1)


def quat_to_rotvec(q, near=None):
    """Unit quaternions [..., 4] -> rotation vectors [..., 3], radians; of the equal rotation vectors the nearest to
    `near` [..., 3], so that a rotation over time has no jumps."""
    xp = _namespace(q)
    q = xp.where(q[..., :1] < 0, -q, q)
    sine = xp.sqrt((q[..., 1:] * q[..., 1:]).sum(-1))[..., None]
    axis = q[..., 1:] / sine.clip(1e-12, None)
    angle = 2 * xp.arctan2(sine, q[..., :1])
    if near is not None:
        length = xp.sqrt((near * near).sum(-1))[..., None]
        axis = xp.where(sine < 1e-7, near / length.clip(1e-12, None), axis)  # a whole turn has no axis of its own
        off = (near * axis).sum(-1)[..., None] - angle
        angle = angle + 2 * np.pi * xp.round(off / (2 * np.pi))
    return axis * angle


def quat_to_matrix(q):
    """Unit quaternions [..., 4] -> [..., 3, 3]."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return _namespace(q).stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def matrix_to_quat(R: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] -> [N, 4] wxyz."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]


def turned_harmonics(shN: np.ndarray, rotations: np.ndarray, *, back: bool = False) -> np.ndarray:
    """Bands 1 to 3 of spherical harmonics [N, K, 3] f32, rotated by unit quaternions [N, 4] f32 or, with `back`, by
    their inverse (spec 13.4)."""
    return _native.turned_harmonics(np.ascontiguousarray(shN, np.float32), rotations, back)
