"""Initial model of a keyframe: Gaussians at points of the visual hull, of a plane sweep, or at random ones."""

from __future__ import annotations

import numpy as np

from ..errors import CaptureError
from .model import Model, from_points
from .plane_sweep import shell, sweep
from .settings import TrainSettings
from .visual_hull import hull_points, random_points


def initial_model(capture, frame: int, settings: TrainSettings) -> Model:
    """Gaussians from the visual hull of the masks. Without masks: from a plane sweep, or random where it finds little.

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
        points, colors = hull_points(known, views, settings.initial_points, settings.visual_hull)
        if len(points):
            return from_points(points, colors, opacity=s.surface_opacity)
    if s.use_plane_sweep:
        points, colors = sweep(views, settings.initial_points, settings.seed, settings.plane_sweep)
        if len(points) >= s.sweep_min_share * settings.initial_points:
            surface = zip((points, colors), shell(views, settings.plane_sweep), strict=True)
            return from_points(*(np.concatenate(pair) for pair in surface), opacity=s.surface_opacity)
    points, colors = random_points(known, views, settings.initial_points, settings.seed, settings.visual_hull)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=s.random_opacity)
