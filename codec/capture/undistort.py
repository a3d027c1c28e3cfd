"""Distorted camera -> pinhole camera, and the warp that takes its images there.

The later stages know pinhole cameras only. The new K is the largest view without unknown pixels, so that no black
border is taught to the model. Our K has pixel centres at half-integers, OpenCV's at integers; the shift is made
here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import require
from ..model.camera import Camera
from .images import View, resample


def _shifted(K: np.ndarray, by: float) -> np.ndarray:
    K = K.copy()
    K[:2, 2] += by
    return K


def undistortion(camera: Camera) -> tuple[Camera, Callable[[View], View]]:
    """The pinhole camera of a distorted one and the function that warps its views; the identity without distortion."""
    if not np.any(camera.distortion):
        return replace(camera, distortion=np.zeros(0)), lambda view: view
    cv2 = require("cv2", "undistorting images")
    size = (camera.width, camera.height)
    K = _shifted(camera.K, -0.5)
    distortion = np.asarray(camera.distortion, np.float64)
    new_K, _ = cv2.getOptimalNewCameraMatrix(K, distortion, size, 0)
    maps = cv2.initUndistortRectifyMap(K, distortion, None, new_K, size, cv2.CV_16SC2)

    def warp(view: View) -> View:
        return resample(view, lambda x: cv2.remap(x, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))

    return replace(camera, K=_shifted(new_K, 0.5), distortion=np.zeros(0)), warp
