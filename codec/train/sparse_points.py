"""Sparse points as initial points of a keyframe: points of the capture that the pictures of the frame do not refute, or
else triangulated matches of features of its training cameras.

In: the points of the capture, which are of its frame 0, and the views of a frame. A point is kept if it lies in the
mask of every view that has it in sight, so that points of a subject that has moved on are dropped.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..capture import View
from ..capture.matching import Matches, matched_features
from ..capture.points import Points
from ..model.camera import Camera
from .settings import InitializationSettings
from .visual_hull import OPAQUE, project


def known_points(points, views, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The points that at least two views have in sight, `count` at most.

    Args:
        points: of the capture (`Points`), or None.
        views: (camera, rgb u8, alpha u8 or None) of each training camera.

    Returns:
        points [P, 3], colours [P, 3] in 0..1.
    """
    if points is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    seen, outside = np.zeros(len(points), np.int32), np.zeros(len(points), bool)
    for camera, _, alpha in views:
        p, depth = project(camera, points.means)
        sight = (depth > camera.near) & (p >= 0).all(1) & (p < [camera.width, camera.height]).all(1)
        on = np.flatnonzero(sight)
        seen[on] += 1
        if alpha is not None:
            x, y = p[on].astype(np.int64).T
            outside[on] |= alpha[y, x] < OPAQUE
    kept = np.flatnonzero((seen >= min(2, len(views))) & ~outside)
    kept = np.random.default_rng(seed).permutation(kept)[:count]
    return points.means[kept].astype(np.float64), points.colors[kept] / 255


def triangulated(
    capture, frame: int, settings: InitializationSettings, look: Callable[[int], View] | None = None
) -> Points:
    """Triangulated features of `frame` that are matched between neighbouring training cameras.

    Args:
        look: camera -> its picture at `frame`, where it is decoded already; None: as the capture gives it.

    Raises:
        CaptureError: an image cannot be read.
    """
    s, trained = settings, capture.indices("train")
    look = look or (lambda camera: capture.view(camera, frame))
    means, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    sought = {"neighbours": s.match_neighbours, "features": s.match_features}
    for m in matched_features(capture, frame, trained, look, **sought):
        if not len(m.p):
            continue
        first, second = (capture.camera(trained[i], frame) for i in (m.first, m.second))
        x, good = _intersections(first, second, m, s)
        at = m.p[good].astype(int)
        means.append(x[good])
        colors.append(look(trained[m.first]).rgb[at[:, 1], at[:, 0]])
    return Points(np.concatenate(means).astype(np.float32), np.concatenate(colors))


def _intersections(
    a: Camera, b: Camera, matches: Matches, settings: InitializationSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] of the matches, and [M] bool: where the rays meet before both cameras, at a large enough angle."""
    import cv2

    x = cv2.triangulatePoints(a.K @ a.viewmat[:3], b.K @ b.viewmat[:3], matches.p.T, matches.q.T)
    x = (x[:3] / np.where(x[3] == 0, np.nan, x[3])).T
    good = np.isfinite(x).all(1)
    x = np.where(good[:, None], x, 0.0)
    for camera, seen in ((a, matches.p), (b, matches.q)):
        p, depth = project(camera, x)
        good &= (depth > camera.near) & (np.linalg.norm(p - seen, axis=1) < settings.reprojection_max)
    rays = [(x - c.center) / np.maximum(np.linalg.norm(x - c.center, axis=1, keepdims=True), 1e-12) for c in (a, b)]
    return x, good & ((rays[0] * rays[1]).sum(1) < np.cos(np.radians(settings.parallax_min)))
