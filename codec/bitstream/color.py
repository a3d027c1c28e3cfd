"""Colour decorrelation of SH coefficients (spec: "Colour"): an orthonormal luma-chroma rotation.

Orthonormal, so that one step means the same error in RGB whichever channel it hits.
"""

import numpy as np

# Rows: luma, red-blue, green-magenta.
DECORRELATION = np.array(
    [
        [3**-0.5, 3**-0.5, 3**-0.5],
        [2**-0.5, 0.0, -(2**-0.5)],
        [-(6**-0.5), 2 * 6**-0.5, -(6**-0.5)],
    ]
)


def decorrelate(rgb: np.ndarray) -> np.ndarray:
    """[..., 3] rgb coefficients -> [..., 3] luma, red-blue, green-magenta (f64)."""
    return rgb.astype(np.float64) @ DECORRELATION.T


def correlate(channels: np.ndarray) -> np.ndarray:
    """Inverse of `decorrelate`."""
    return channels @ DECORRELATION
