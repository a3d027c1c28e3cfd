"""Initial model of a keyframe: Gaussians at the capture's own points and at points of the visual hull or of a plane
sweep, or at random ones where there is none of these."""

from __future__ import annotations

import numpy as np

from ..bitstream.quantization import subject_radius
from ..errors import CaptureError
from .model import Model, from_points
from .plane_sweep import shell, sweep
from .settings import TrainSettings
from .sparse_points import known_points, triangulated
from .visual_hull import hull_points, random_points

Cloud = tuple[np.ndarray, np.ndarray]  # points [P, 3], colours [P, 3] in 0..1


def initial_model(capture, frame: int, count: int, settings: TrainSettings) -> tuple[Model, float]:
    """Gaussians on the surfaces that are known, and the radius of what they show: the capture's own points, and the
    visual hull of the masks besides; without masks matched features, a plane sweep, and a far shell that the radius
    does not count. They are random where too little is found.

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
    most = int(s.points_share_max * count)
    points = capture.points if s.use_points else None
    if points is None and s.triangulate and any(alpha is None for _, _, alpha in views):
        points = triangulated(capture, frame, s)
    own = known_points(points, views, most, settings.seed)
    left = count - len(own[0])
    if all(alpha is not None for _, _, alpha in views):
        hull = hull_points(known, views, left, settings.visual_hull)
        if len(hull[0]):
            surface = _joined(own, hull)
            return from_points(*surface, opacity=s.surface_opacity), subject_radius(surface[0])
    found = _joined(own, sweep(views, left, settings.seed, settings.plane_sweep)) if s.use_plane_sweep else own
    if len(found[0]) and len(found[0]) >= s.sweep_min_share * count:
        whole = _joined(found, shell(views, settings.plane_sweep))
        return from_points(*whole, opacity=s.surface_opacity), subject_radius(found[0])
    points, colors = random_points(known, views, count, settings.seed, settings.visual_hull)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=s.random_opacity), subject_radius(points)


def _joined(a: Cloud, b: Cloud) -> Cloud:
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
