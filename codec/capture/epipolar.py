"""Calibration error of a capture: distance of matched features from their epipolar lines (Hartley and Zisserman 2004,
11.4.3). Needs no model of the scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .capture import Capture
from .images import View
from .matching import matched_features

LEAST = 40  # matches; fewer do not tell the error


def epipolar_error(
    capture: Capture, frame: int, cameras: list[int], look: Callable[[int], View] | None = None
) -> float | None:
    """Median distance of matched features from their epipolar lines, pixels; None: too few features match.

    Args:
        cameras: indices of the compared cameras.
        look: see `matched_features`.

    Raises:
        CaptureError: an image cannot be read.
    """
    found = [m.distances for m in matched_features(capture, frame, cameras, look)]
    everything = np.concatenate([np.zeros(0), *found])
    return float(np.median(everything)) if len(everything) >= LEAST else None
