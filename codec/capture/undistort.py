"""Distorted camera -> pinhole camera, and its views warped to that camera.

The later stages know pinhole cameras only. The new K has the largest view without unknown pixels, so that training
never sees a black border; for a fisheye lens, which may see more than a plane can show, `WIDEST` at most. Pixel centres
are at half-integers in our K and at integers in OpenCV's; K is shifted here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..errors import CaptureError, require
from ..model.camera import Camera
from .images import View, resample

WIDEST = 65.0  # degrees from the optical axis, largest angle in the pinhole camera of a fisheye lens
HALVINGS = 30  # of the interval in which its focal length is searched


@dataclass(frozen=True)
class _Lens:
    """K [3][3] with OpenCV's pixel centres, distortion, whether it is of the fisheye model, (width, height)."""

    K: tuple
    distortion: tuple
    fisheye: bool
    size: tuple[int, int]


class Undistortion:
    """Undistorts one camera and its views; the identity without distortion. Thread-safe.

    The camera may zoom or focus: each view is warped with the lens of its own frame. The maps of the last lens are
    kept; they are as large as a few images.
    """

    def __init__(self):
        self._pinhole, self._maps = lru_cache(1)(_pinhole), lru_cache(1)(_maps)

    def camera(self, camera: Camera) -> Camera:
        """The pinhole camera that replaces `camera`.

        Raises:
            CaptureError: its distortion is not that of a lens.
        """
        if not _bends(camera):
            return replace(camera, distortion=np.zeros(0))
        return replace(camera, K=_shifted(self._pinhole(_lens(camera)), 0.5), distortion=np.zeros(0), fisheye=False)

    def view(self, view: View, camera: Camera) -> View:
        """A view of the distorted `camera`, warped to its pinhole camera."""
        if not _bends(camera):
            return view
        cv2, maps = require("cv2", "undistorting images"), self._maps(_lens(camera))

        def warped(interpolation: int) -> Callable[[np.ndarray], np.ndarray]:
            return lambda x: cv2.remap(x, *maps, interpolation, borderMode=cv2.BORDER_REPLICATE)

        return resample(view, warped(cv2.INTER_LINEAR), warped(cv2.INTER_NEAREST))


def _bends(camera: Camera) -> bool:
    return camera.fisheye or bool(np.any(camera.distortion))


def _lens(camera: Camera) -> _Lens:
    K = tuple(map(tuple, _shifted(camera.K, -0.5).tolist()))
    return _Lens(K, tuple(camera.distortion.tolist()), camera.fisheye, (camera.width, camera.height))


def _shifted(K: np.ndarray, by: float) -> np.ndarray:
    K = K.copy()
    K[:2, 2] += by
    return K


def _pinhole(lens: _Lens) -> np.ndarray:
    """[3, 3] f64 K of the pinhole camera, with OpenCV's pixel centres."""
    cv2 = require("cv2", "undistorting images")
    if lens.fisheye:
        return _fisheye_pinhole(lens)
    return cv2.getOptimalNewCameraMatrix(np.array(lens.K), np.array(lens.distortion), lens.size, 0)[0]


def _fisheye_pinhole(lens: _Lens) -> np.ndarray:
    """`_pinhole` of a fisheye lens: same principal point; focal lengths shrink until the borders of both views meet."""
    K, (width, height) = np.array(lens.K), lens.size
    x, y = np.linspace(-0.5, width - 0.5, 65), np.linspace(-0.5, height - 0.5, 65)
    sides = [(x, np.full(65, v)) for v in y[[0, -1]]] + [(np.full(65, v), y) for v in x[[0, -1]]]
    border = np.concatenate([np.stack(side, 1) for side in sides])
    rays = (border - K[:2, 2]) / [K[0, 0], K[1, 1]]
    away = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)

    def sees(scale: float) -> bool:
        angle = np.arctan(away / scale)
        r = _bent(np.linspace(0, angle.max(), 256), lens.distortion)
        p = rays * (_bent(angle, lens.distortion) / away)[:, None] * [K[0, 0], K[1, 1]] + K[:2, 2]
        inside = ((p >= -0.5) & (p <= [width - 0.5, height - 0.5])).all()
        return bool(angle.max() <= np.radians(WIDEST) and (np.diff(r) > 0).all() and inside)

    low, high = 0.05, 20.0
    if not sees(high):
        raise CaptureError(f"fisheye distortion {list(lens.distortion)} is not that of a lens, expected k1, k2, k3, k4")
    for _ in range(HALVINGS):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if sees(middle) else (middle, high)
    K[[0, 1], [0, 1]] *= high
    return K


def _bent(angle: np.ndarray, distortion: tuple) -> np.ndarray:
    """Distance from the principal point, in focal lengths, at an angle from the optical axis (Kannala and Brandt)."""
    squared = angle**2
    k1, k2, k3, k4 = distortion
    return angle * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))


def _maps(lens: _Lens) -> tuple[np.ndarray, np.ndarray]:
    """The maps for cv2.remap: source position of each pixel in the distorted image."""
    cv2 = require("cv2", "undistorting images")
    undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    return undistort(np.array(lens.K), np.array(lens.distortion), np.eye(3), _pinhole(lens), lens.size, cv2.CV_16SC2)
