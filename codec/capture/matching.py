"""Feature matches between neighbouring cameras of one frame, with which calibration and colours are checked.

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

NEIGHBOURS = 2  # cameras with which each camera is compared
RATIO = 0.7  # largest ratio of the best to the second best descriptor distance: a match is distinct (Lowe 2004)
INLIER = 0.01  # of the image's width; a match farther from its epipolar line is wrong, whatever the calibration
INLIER_PIXELS = 3.0  # its lower bound, 4 times the error from which poses are learned: else small pictures hide it
FEATURES = 1500  # per image, at most


@dataclass(frozen=True)
class Matches:
    """Matched features of two cameras.

    Attributes:
        first, second: the cameras, as positions in the argument `cameras` of `matched_features`.
        p, q: [M, 2] f64, pixels of the first and of the second camera.
        distances: [M] f64, distance from the epipolar line, pixels.
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
    """Matches of each camera with the `neighbours` cameras whose viewing directions are the most similar.

    Args:
        cameras: indices of the compared cameras.
        look: camera -> its picture at `frame`, if it is decoded already; None: the capture decodes it.
        features: per image, at most.

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
    """Matches of two cameras, without wrong ones."""
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
    """[M] Sampson distances of matches from their epipolar lines, pixels."""
    R = b.viewmat[:3, :3] @ a.viewmat[:3, :3].T
    x, y, z = b.viewmat[:3, 3] - R @ a.viewmat[:3, 3]
    F = np.linalg.inv(b.K).T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ np.linalg.inv(a.K)
    ones = np.ones((len(p), 1))
    p, q = np.hstack([p, ones]), np.hstack([q, ones])
    lines, back = p @ F.T, q @ F
    return np.abs((q * lines).sum(1)) / np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
