"""Draco point clouds (.drc) <-> Gaussians: positions only.

A point becomes a light, opaque, isotropic Gaussian whose scale is the mean distance to its nearest neighbours, like the
initial Gaussians of 3DGS.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError, require
from ..model.gaussians import Gaussians

BITS, LEVEL = 16, 10  # quantization of an axis, bits; compression level of Draco, 0 to 10
OPACITY, LIGHT = 4.0, 1.0  # logit; sh0
NEIGHBORS = 3


def read_drc(path: Path) -> Gaussians:
    """Reads the points as Gaussians.

    Raises:
        CaptureError: not a Draco point cloud.
        UsageError: DracoPy is not installed.
    """
    draco = require("DracoPy", "reading a .drc")
    try:
        points = np.asarray(draco.decode(path.read_bytes()).points, np.float32).reshape(-1, 3)
    except (draco.FileTypeException, ValueError) as e:
        raise CaptureError(f"{path}: not a Draco point cloud ({e})") from None
    n = len(points)
    scales = np.repeat(np.log(_spacing(points))[:, None], 3, 1).astype(np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    opacities = np.full(n, OPACITY, np.float32)
    return Gaussians(
        points, quats, scales, opacities, np.full((n, 3), LIGHT, np.float32), np.zeros((n, 0, 3), np.float32)
    )


def write_drc(path: Path, gaussians: Gaussians) -> None:
    """Writes the positions, 16 bits an axis. Draco changes their order and drops duplicates.

    Raises:
        CaptureError: there are no Gaussians, which this format cannot express.
        UsageError: DracoPy is not installed.
    """
    if not len(gaussians):
        raise CaptureError(f"{path}: no Gaussians to write; use .ply for an empty frame")
    draco = require("DracoPy", "writing a .drc")
    data = draco.encode(gaussians.means, quantization_bits=BITS, compression_level=LEVEL, preserve_order=False)
    with part_file(path) as part:
        part.write_bytes(data)


def _spacing(points: np.ndarray) -> np.ndarray:
    """[N] mean distance to the three nearest neighbours; 0.01 for a single point."""
    from scipy.spatial import cKDTree

    k = min(NEIGHBORS, len(points) - 1)
    if k < 1:
        return np.full(len(points), 0.01)
    distance = cKDTree(points).query(points, k + 1)[0][:, 1:].mean(1)
    return np.maximum(distance, 1e-3 * np.median(distance) + 1e-9)
