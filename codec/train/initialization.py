"""Initial model of a keyframe: Gaussians at points of the visual hull, of a plane sweep, or at random ones."""

from __future__ import annotations

import numpy as np

from ..bitstream.quantization import subject_radius
from ..errors import CaptureError
from .model import Model, from_points
from .plane_sweep import shell, sweep
from .settings import TrainSettings
from .visual_hull import hull_points, random_points


def initial_model(capture, frame: int, count: int, settings: TrainSettings) -> tuple[Model, float]:
    """Gaussians from the visual hull of the masks, and the radius of what they show. Without masks: from a plane sweep,
    and a far shell that the radius does not count, or random where the sweep finds little.

    Args:
        count: of points, about.

    Raises:
        CaptureError: there is no training camera, or no point is seen by two of them.
    """
    cameras = capture.indices("train")
    if not cameras:
        raise CaptureError(f"{capture.name}: no training camera, expected at least one with split 'train'")
    s, views = settings.initialization, []
    for camera in cameras:
        v = capture.view(camera, frame)
        views.append((capture.camera(camera, frame), v.rgb, v.alpha))
    known = [c for c, _, _ in views]
    if all(alpha is not None for _, _, alpha in views):
        points, colors = hull_points(known, views, count, settings.visual_hull)
        if len(points):
            return from_points(points, colors, opacity=s.surface_opacity), subject_radius(points)
    if s.use_plane_sweep:
        points, colors = sweep(views, count, settings.seed, settings.plane_sweep)
        if len(points) >= s.sweep_min_share * count:
            surface = zip((points, colors), shell(views, settings.plane_sweep), strict=True)
            whole = from_points(*(np.concatenate(pair) for pair in surface), opacity=s.surface_opacity)
            return whole, subject_radius(points)
    points, colors = random_points(known, views, count, settings.seed, settings.visual_hull)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=s.random_opacity), subject_radius(points)
