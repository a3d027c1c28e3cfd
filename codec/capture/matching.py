"""Features that are matched between neighbouring cameras of one frame: what calibration and colours are checked with.

SIFT (Lowe 2004) with the ratio test. A match far from its epipolar line is wrong whatever the calibration is, and is
left out (Hartley and Zisserman 2004, 11.4.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import require
from ..model.camera import Camera, meeting_point
from .capture import Capture, blend
from .images import View

NEIGHBOURS = 2  # cameras that each one is compared with
RATIO = 0.7  # of the best descriptor distance to the second best: a match is distinct (Lowe 2004)
INLIER = 0.01  # of the image's width: farther from its epipolar line, a match is wrong whatever the calibration is
INLIER_PIXELS = 3.0  # at least, four times the error from which poses are learned: else small pictures hide it
FEATURES = 1500  # of one image at most


@dataclass(frozen=True)
class Matches:
    """What two cameras see both.

    Attributes:
        first, second: the cameras, positions in the list that was asked for.
        p, q: [M, 2] f64, pixels of the first and of the second camera.
        distances: [M] f64, from the epipolar line, pixels.
    """

    first: int
    second: int
    p: np.ndarray
    q: np.ndarray
    distances: np.ndarray


def matched_features(
    capture: Capture,
    frame: int,
    cameras: list[int],
    look: Callable[[int], View] | None = None,
    *,
    neighbours: int = NEIGHBOURS,
    features: int = FEATURES,
) -> list[Matches]:
    """Matches of each camera with the `neighbours` that see the scene from most nearly the same side.

    Args:
        cameras: indices of those that are compared.
        look: camera -> its picture at `frame`, where it is decoded already; None: as the capture gives it.
        features: of one image at most.

    Raises:
        CaptureError: an image cannot be read.
    """
    cv2 = require("cv2", "matching features")
    known = [capture.camera(i, frame) for i in cameras]
    sift, found = cv2.SIFT_create(features), []
    for i in cameras:
        view = look(i) if look else capture.view(i, frame)
        grey = cv2.cvtColor(np.rint(blend(view, (0.5,) * 3)).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        points, descriptors = sift.detectAndCompute(grey, None)
        found.append((np.array([p.pt for p in points], np.float64).reshape(-1, 2) + 0.5, descriptors))
    return [_matches(known, found, a, b) for a, b in _pairs(known, neighbours)]


def _pairs(cameras: list[Camera], neighbours: int) -> list[tuple[int, int]]:
    rays = np.stack([c.center for c in cameras]) - meeting_point(cameras)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    near = np.argsort(-(rays @ rays.T), axis=1)
    pairs = {(min(i, j), max(i, j)) for i in range(len(cameras)) for j in near[i, : neighbours + 1].tolist() if j != i}
    return sorted(pairs)


def _matches(cameras: list[Camera], found: list, a: int, b: int) -> Matches:
    """Matches of two cameras, without those that are wrong anyway."""
    import cv2

    (points_a, of_a), (points_b, of_b) = found[a], found[b]
    pairs = []
    if of_a is not None and of_b is not None and len(of_b) >= 2:
        nearest = cv2.BFMatcher().knnMatch(of_a, of_b, k=2)
        pairs = [m[0] for m in nearest if m[0].distance < RATIO * m[1].distance]
    p = points_a[[m.queryIdx for m in pairs]].reshape(-1, 2)
    q = points_b[[m.trainIdx for m in pairs]].reshape(-1, 2)
    distances = _distances(cameras[a], cameras[b], p, q)
    kept = distances < max(INLIER * cameras[a].width, INLIER_PIXELS)
    return Matches(a, b, p[kept], q[kept], distances[kept])


def _distances(a: Camera, b: Camera, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[M] distances from each other's epipolar lines, pixels (Sampson's)."""
    R = b.viewmat[:3, :3] @ a.viewmat[:3, :3].T
    x, y, z = b.viewmat[:3, 3] - R @ a.viewmat[:3, 3]
    F = np.linalg.inv(b.K).T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ np.linalg.inv(a.K)
    ones = np.ones((len(p), 1))
    p, q = np.hstack([p, ones]), np.hstack([q, ones])
    lines, back = p @ F.T, q @ F
    return np.abs((q * lines).sum(1)) / np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
