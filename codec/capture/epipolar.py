"""How well the calibration of a capture holds: features that are matched between neighbouring cameras, and how far they
lie from each other's epipolar lines (Hartley and Zisserman 2004, 11.4.3). Needs no model of the scene."""

from __future__ import annotations

import numpy as np

from ..model.camera import Camera, meeting_point
from .capture import Capture, blend

NEIGHBOURS = 2  # cameras that each one is compared with
RATIO = 0.7  # of the best descriptor distance to the second best: a match is distinct (Lowe 2004)
INLIER = 0.01  # of the image's width: farther from its epipolar line, a match is wrong whatever the calibration is
LEAST = 40  # matches, fewer say nothing
FEATURES = 1500  # of one image at most


def epipolar_error(capture: Capture, frame: int, cameras: list[int]) -> float | None:
    """Median distance of matched features from their epipolar lines, pixels; None: too few features match.

    Args:
        cameras: indices of those that are compared.

    Raises:
        CaptureError: an image cannot be read.
    """
    import cv2

    known = [capture.camera(i, frame) for i in cameras]
    sift, found = cv2.SIFT_create(FEATURES), []
    for i in cameras:
        view = capture.view(i, frame)
        grey = cv2.cvtColor(np.rint(blend(view, (0.5,) * 3)).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        points, descriptors = sift.detectAndCompute(grey, None)
        found.append((np.array([p.pt for p in points], np.float64).reshape(-1, 2) + 0.5, descriptors))
    distances = []
    for a, b in _pairs(known):
        distances.append(_distances(known[a], known[b], *found[a], *found[b]))
    everything = np.concatenate([np.zeros(0), *distances])
    return float(np.median(everything)) if len(everything) >= LEAST else None


def _pairs(cameras: list[Camera]) -> set[tuple[int, int]]:
    """Each camera with the ones that see the scene from most nearly the same side."""
    rays = np.stack([c.center for c in cameras]) - meeting_point(cameras)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    near = np.argsort(-(rays @ rays.T), axis=1)
    return {(min(i, j), max(i, j)) for i in range(len(cameras)) for j in near[i, : NEIGHBOURS + 1].tolist() if j != i}


def _distances(a: Camera, b: Camera, points_a, of_a, points_b, of_b) -> np.ndarray:
    """Distances of the matches of two images, pixels, without those that are wrong anyway."""
    import cv2

    if of_a is None or of_b is None or len(of_b) < 2:
        return np.zeros(0)
    matches = [m[0] for m in cv2.BFMatcher().knnMatch(of_a, of_b, k=2) if m[0].distance < RATIO * m[1].distance]
    if not matches:
        return np.zeros(0)
    R = b.viewmat[:3, :3] @ a.viewmat[:3, :3].T
    x, y, z = b.viewmat[:3, 3] - R @ a.viewmat[:3, 3]
    F = np.linalg.inv(b.K).T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R @ np.linalg.inv(a.K)
    p = np.stack([[*points_a[m.queryIdx], 1] for m in matches])
    q = np.stack([[*points_b[m.trainIdx], 1] for m in matches])
    lines, back = p @ F.T, q @ F
    away = np.abs((q * lines).sum(1)) / np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    return away[away < INLIER * a.width]
