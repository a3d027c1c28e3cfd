"""Colour decorrelation of SH coefficients (spec 13.5): Y, Co, Cg.

With `STEP_WEIGHTS`, one nominal step causes the same squared error in RGB in each channel.
"""

import numpy as np

TO_YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])
TO_RGB = np.array([[1.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, -1.0, -1.0]])
STEP_WEIGHTS = 1 / np.linalg.norm(TO_RGB, axis=0)  # [3]


def decorrelate(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] RGB coefficients -> [..., 3] Y, Co, Cg, of the same float type."""
    return (rgb.reshape(-1, 3) @ TO_YCOCG.T.astype(rgb.dtype)).reshape(rgb.shape)


def correlate(channels: np.ndarray) -> np.ndarray:
    """Inverse of `decorrelate`."""
    return channels @ TO_RGB.T.astype(channels.dtype)
