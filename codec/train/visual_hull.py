"""Initial points of a keyframe: the surface of the visual hull of the masks, or random points without masks.

In: views of one frame. Out: points and colours. The volume is found from the cameras alone (where their optical axes
meet), carved coarsely, then again inside the box of the coarse hull. Only the surface is kept: no view shows more.
"""

from __future__ import annotations

import numpy as np

from ..model.camera import meeting_point, working_distance
from .settings import VisualHullSettings

OPAQUE = 128  # of 255, alpha from which a pixel belongs to the subject


def project(camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points [N, 3] -> pixels [N, 2] and depth [N]."""
    x = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    p = x @ camera.K.T
    return p[:, :2] / np.where(np.abs(p[:, 2:]) < 1e-9, 1e-9, p[:, 2:]), x[:, 2]


def _lattice(low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Centers of the voxels [V, 3] of a box, and their number along each axis."""
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(a) for a in axes)
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), shape


def _inside(points: np.ndarray, views, settings: VisualHullSettings) -> np.ndarray:
    """[N] bool: the point is seen by most views, and in the mask of every view that sees it."""
    seen = np.zeros(len(points), np.int32)
    missed = np.zeros(len(points), np.int32)
    for camera, _, alpha in views:
        p, depth = project(camera, points)
        x, y = np.floor(p).astype(np.int64).T
        on = (depth > camera.near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        seen += on
        missed[on] += alpha[y[on], x[on]] < OPAQUE
    return (seen >= max(2, settings.seen_share * len(views))) & (missed <= settings.misses_max)


def colors_of(points: np.ndarray, views) -> np.ndarray:
    """Colours of points, [N, 3] in 0..1: median over the views with the point in their mask. Occlusion is ignored."""
    colors = np.full((len(views), len(points), 3), np.nan, np.float32)
    for i, (camera, rgb, alpha) in enumerate(views):
        p, depth = project(camera, points)
        x, y = np.floor(p).astype(np.int64).T
        on = np.flatnonzero((depth > camera.near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))
        if alpha is not None:
            on = on[alpha[y[on], x[on]] >= OPAQUE]
        colors[i, on] = rgb[y[on], x[on]] / 255
    unseen = np.isnan(colors).all(0)
    colors[:, unseen] = 0.5
    return np.nanmedian(colors, axis=0)


def hull_points(cameras, views, count: int, settings: VisualHullSettings) -> tuple[np.ndarray, np.ndarray]:
    """Points on the surface of the visual hull.

    Args:
        cameras: training cameras.
        views: (camera, rgb u8, alpha u8) of each.
        count: number of points, about.

    Returns:
        points [P, 3], colours [P, 3] in 0..1. P may be 0 if the masks agree nowhere.
    """
    centre = meeting_point(cameras)
    half = min(np.linalg.norm(c.center - centre) for c in cameras)
    low, high = centre - half, centre + half
    step = 2 * half / settings.coarse_voxels
    occupied, _ = _lattice(low, high, step)
    occupied = occupied[_inside(occupied, views, settings)]
    if len(occupied) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    low, high = occupied.min(0) - step, occupied.max(0) + step
    # The surface of a hull with V voxels of size s has about 6 V^(2/3) of them: refine until it has `count`.
    volume = len(occupied) * step**3
    step = min(step, np.sqrt(6 * volume ** (2 / 3) / count))
    for _ in range(4):
        points, shape = _lattice(low, high, step)
        inside = _inside(points, views, settings).reshape(shape)
        padded = np.pad(inside, 1)
        core = padded[1:-1, 1:-1, 1:-1].copy()
        for axis in range(3):
            for shift in (-1, 1):
                core &= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
        surface = points[(inside & ~core).ravel()]
        if 0.7 * count < len(surface) < 1.4 * count or len(surface) == 0:
            break
        step *= np.sqrt(len(surface) / count)
    return surface, colors_of(surface, views)


def random_points(cameras, views, count: int, seed: int, settings: VisualHullSettings) -> tuple[np.ndarray, np.ndarray]:
    """Random points in the view of the cameras, denser near them; for captures without masks.

    Depths along random pixels of random cameras are uniform in 1/depth; points that fewer than
    two cameras see are dropped.
    """
    rng, distance = np.random.default_rng(seed), working_distance(cameras)
    near, far = 1 / (settings.random_depth_min * distance), 1 / (settings.random_depth_max * distance)
    picked = []
    for c in cameras:
        n = 3 * count // len(cameras) + 1
        pixels = rng.uniform(0, 1, (n, 2)) * [c.width, c.height]
        depth = 1 / rng.uniform(far, near, n)
        rays = np.concatenate([pixels, np.ones((n, 1))], 1) @ np.linalg.inv(c.K).T
        picked.append((rays * depth[:, None] - c.viewmat[:3, 3]) @ c.viewmat[:3, :3])
    points = np.concatenate(picked)
    seen = np.zeros(len(points), np.int32)
    for c in cameras:
        p, depth = project(c, points)
        seen += (depth > c.near) & (p >= 0).all(1) & (p < [c.width, c.height]).all(1)
    points = points[seen >= min(2, len(cameras))]
    points = points[rng.permutation(len(points))[:count]]
    return points, colors_of(points, views)
