"""antimatter15's .splat -> Gaussians: 32 bytes each, without a header.

Position and scales in f32, colour and opacity in 8 bits, the quaternion (wxyz) in 8 bits around 128. Other tools sort
the Gaussians by size; there are no harmonics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.gaussians import SH_C0, Gaussians, logit

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
SCALE_MIN = 1e-9  # a scale of 0 has no logarithm


def splat_count(path: Path) -> int:
    """Number of Gaussians in the file.

    Raises:
        CaptureError: the size of the file is 0 or not a multiple of that of a Gaussian.
    """
    size = path.stat().st_size
    if not size or size % ROW.itemsize:
        raise CaptureError(f"{path}: {size} bytes, expected {ROW.itemsize} for each Gaussian; truncated, or no .splat")
    return size // ROW.itemsize


def read_splat_rows(path: Path) -> Gaussians:
    """Reads a .splat.

    Raises:
        CaptureError: truncated, or the bytes are not positions and scales.
    """
    rows = np.fromfile(path, ROW, splat_count(path))
    scales = rows["scales"].astype(np.float64)
    if not np.isfinite(scales).all() or (scales < 0).any():
        bad = int((~(np.isfinite(scales) & (scales >= 0))).any(1).argmax())
        raise CaptureError(
            f"{path}: scales of Gaussian {bad} are {scales[bad].tolist()}, expected 0 or more; no .splat?"
        )
    quats = (rows["quats"].astype(np.float64) - 128) / 128
    quats[~quats.any(1)] = (1, 0, 0, 0)
    return Gaussians(
        means=rows["means"],
        quats=quats,
        log_scales=np.log(np.maximum(scales, SCALE_MIN)),
        logit_opacities=logit(rows["rgba"][:, 3] / 255),
        sh0=(rows["rgba"][:, :3] / 255 - 0.5) / SH_C0,
        shN=np.zeros((len(rows), 0, 3)),
    ).validate(str(path))
