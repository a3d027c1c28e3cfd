"""The sparse points of a capture as initial points of a keyframe: those that the pictures of the frame do not refute.

In: the points of the capture, which are of its frame 0, and the views of a frame. A point stays that lies in the mask
of every view that has it in sight, so that of a subject that has moved on only what still fits is kept.
"""

from __future__ import annotations

import numpy as np

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
