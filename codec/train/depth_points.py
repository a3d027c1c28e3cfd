"""Depth images as initial points of a keyframe: pixels of all cameras, back-projected.

In: views of one frame and their depth images. Out: points and colours. A point is left out if more cameras look through
it (their depth there is larger) than see it: along an edge, sensors mix the depths of both sides.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .plane_sweep import unproject
from .visual_hull import OPAQUE, project

TRIED = 2.0  # pixels that are tried, times the wanted number of points


def depth_points(
    views, depths: Sequence[np.ndarray | None], count: int, seed: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points of random pixels with known depth, the same share of them in each picture.

    Args:
        views: (camera, rgb u8 [H, W, 3], alpha u8 or None) of each training camera.
        depths: [H, W] f32 of each view, 0 where unknown; None: the camera has no depth image.
        count: bound on the number of points.
        tolerance: relative difference of depth at which two cameras see the same surface.

    Returns:
        points [P, 3], colours [P, 3] in 0..1.
    """
    rng, known = np.random.default_rng(seed), []
    for (camera, _, alpha), depth in zip(views, depths, strict=True):
        if depth is None:
            known.append(np.zeros(0, np.int64))
        else:
            known.append(np.flatnonzero((depth > camera.near) & (True if alpha is None else alpha >= OPAQUE)))
    share = min(1.0, TRIED * count / max(sum(map(len, known)), 1))
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for (camera, rgb, _), depth, pixels in zip(views, depths, known, strict=True):
        chosen = rng.permutation(pixels)[: round(share * len(pixels))]
        if len(chosen):
            y, x = np.divmod(chosen, camera.width)
            points.append(unproject(camera, x, y, depth[y, x]))
            colors.append(rgb[y, x] / 255)
    points, colors = np.concatenate(points), np.concatenate(colors)
    votes = np.zeros(len(points), np.int32)
    for (camera, _, _), depth in zip(views, depths, strict=True):
        if depth is not None:
            votes += _seen(points, camera, depth, tolerance)
    kept = rng.permutation(np.flatnonzero(votes >= 0))[:count]
    return points[kept], colors[kept]


def _seen(points: np.ndarray, camera, depth: np.ndarray, tolerance: float) -> np.ndarray:
    """[N] int: 1 where the camera sees a surface at the point, -1 where it sees a surface behind it, else 0."""
    p, z = project(camera, points)
    x, y = np.floor(p).astype(np.int64).T
    on = (z > camera.near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    there = np.where(on, depth[y.clip(0, camera.height - 1), x.clip(0, camera.width - 1)], 0)
    known = there > 0
    return (known & (np.abs(there - z) <= tolerance * z)).astype(int) - (known & (there > (1 + tolerance) * z))
