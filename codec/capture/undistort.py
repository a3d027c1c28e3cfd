"""Distorted camera -> pinhole camera, and its views warped to that camera.

The later stages know pinhole cameras only. The new K has the largest view without unknown pixels, so that training
never sees a black border. Pixel centres are at half-integers in our K and at integers in OpenCV's; K is shifted here.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..errors import require
from ..model.camera import Camera
from .images import View, resample

_Lens = tuple[tuple, tuple, tuple[int, int]]  # K with OpenCV's pixel centres, distortion, (width, height); hashable


class Undistortion:
    """Undistorts one camera and its views; the identity without distortion. Thread-safe.

    The camera may zoom or focus: each view is warped with the lens of its own frame. The maps of one lens are kept,
    which are as large as a few images.
    """

    def __init__(self):
        self._pinhole, self._maps = lru_cache(1)(_pinhole), lru_cache(1)(_maps)

    def camera(self, camera: Camera) -> Camera:
        """The pinhole camera in the place of `camera`."""
        if not np.any(camera.distortion):
            return replace(camera, distortion=np.zeros(0))
        return replace(camera, K=_shifted(self._pinhole(_lens(camera)), 0.5), distortion=np.zeros(0))

    def view(self, view: View, camera: Camera) -> View:
        """A view of `camera`, which has distortion, as its pinhole camera would show it."""
        if not np.any(camera.distortion):
            return view
        cv2, maps = require("cv2", "undistorting images"), self._maps(_lens(camera))
        return resample(view, lambda x: cv2.remap(x, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _lens(camera: Camera) -> _Lens:
    K = _shifted(camera.K, -0.5)
    return tuple(map(tuple, K.tolist())), tuple(camera.distortion.tolist()), (camera.width, camera.height)


def _shifted(K: np.ndarray, by: float) -> np.ndarray:
    K = K.copy()
    K[:2, 2] += by
    return K


def _pinhole(lens: _Lens) -> np.ndarray:
    """[3, 3] f64 K of the pinhole camera, with OpenCV's pixel centres."""
    K, distortion, size = lens
    cv2 = require("cv2", "undistorting images")
    return cv2.getOptimalNewCameraMatrix(np.array(K), np.array(distortion), size, 0)[0]


def _maps(lens: _Lens) -> tuple[np.ndarray, np.ndarray]:
    """What cv2.remap takes: where in the distorted image each pixel comes from."""
    K, distortion, size = lens
    cv2 = require("cv2", "undistorting images")
    return cv2.initUndistortRectifyMap(np.array(K), np.array(distortion), None, _pinhole(lens), size, cv2.CV_16SC2)
