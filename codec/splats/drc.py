"""Draco point clouds (.drc) <-> Gaussians: the positions only, for what reads and writes nothing else.

Points become light opaque balls as wide as the distance to their neighbours, as splat training starts from.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError, require
from ..model.gaussians import Gaussians

BITS, LEVEL = 16, 10  # quantization of an axis; effort
OPACITY, LIGHT = 4.0, 1.0  # logit; coefficient of the colour
NEIGHBORS = 3


def read_drc(path: Path) -> Gaussians:
    """Raises CaptureError: not a Draco file. UsageError: DracoPy is not installed."""
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
    """Positions of `gaussians`, 16 bits an axis, in an order of Draco's; of equal ones it keeps one."""
    draco = require("DracoPy", "writing a .drc")
    data = draco.encode(gaussians.means, quantization_bits=BITS, compression_level=LEVEL, preserve_order=False)
    with part_file(path) as part:
        part.write_bytes(data)


def _spacing(points: np.ndarray) -> np.ndarray:
    """[N] distance to the nearest neighbours, the mean of three; 0.01 for a single point."""
    from scipy.spatial import cKDTree

    k = min(NEIGHBORS, len(points) - 1)
    if k < 1:
        return np.full(len(points), 0.01)
    distance = cKDTree(points).query(points, k + 1)[0][:, 1:].mean(1)
    return np.maximum(distance, 1e-3 * np.median(distance) + 1e-9)
