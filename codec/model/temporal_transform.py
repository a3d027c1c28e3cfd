"""Temporal transform of trajectories: the orthonormal DCT-II over the T frames of a group (spec: "Trajectories").

Defined for every T >= 1, so that a group may have any length; coefficient 0 is the mean times sqrt(T).
"""

import numpy as np


def dct_basis(frames: int) -> np.ndarray:
    """[T, T] f64; row k is basis function k sampled at the T frames, rows orthonormal."""
    k = np.arange(frames)[:, None]
    t = np.arange(frames)[None, :]
    basis = np.sqrt(2 / frames) * np.cos(np.pi * (t + 0.5) * k / frames)
    basis[0] = np.sqrt(1 / frames)
    return basis
