"""Gaussians -> the 16 cameras for the comparison of stream and source without a capture.

Directions on a Fibonacci sphere around the box of the 1st to 99th percentile of positions; even cameras have its
bounding sphere just in frame, odd ones stand at half that distance. 512 x 512, focal length 1.2 x width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import UsageError
from ..model.camera import LOW_PASS, Camera, cameras_around
from ..model.gaussians import Gaussians

COUNT = 16


def codec_cameras(frames: Sequence[Gaussians], low_pass: float = LOW_PASS) -> list[Camera]:
    """The cameras around the Gaussians of all given frames, which are drawn with `low_pass` (px^2).

    Raises:
        UsageError: the frames hold no Gaussians.
    """
    means = np.concatenate([g.means for g in frames]) if frames else np.zeros((0, 3))
    if not len(means):
        raise UsageError("no Gaussians to place cameras around")
    return cameras_around(means, COUNT, name="codec", low_pass=low_pass)
