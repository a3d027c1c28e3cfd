"""Initial model of a keyframe: Gaussians at the capture's own points and at points of depth images, of the visual hull
or of a plane sweep, or at random points where there are none of these."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..bitstream.quantization import subject_radius
from ..capture import View
from ..errors import CaptureError
from .depth_points import depth_points
from .far_shell import far_shell
from .model import Model, from_points
from .plane_sweep import sweep
from .settings import TrainSettings
from .sparse_points import known_points, triangulated
from .visual_hull import hull_points, random_points

Cloud = tuple[np.ndarray, np.ndarray]  # points [P, 3], colours [P, 3] in 0..1


def initial_model(
    capture,
    frame: int,
    count: int,
    settings: TrainSettings,
    look: Callable[[int, int], View] | None = None,
) -> tuple[Model, float]:
    """Gaussians at points on known surfaces, and the radius of these points. The points are the capture's own and those
    of its depth images, or else of the visual hull of the masks; without depth and masks, of matched features and a
    plane sweep. Points of a plane sweep, or without masks, get a far shell around them, which does not count in the
    radius. Where too few points are found, they are random, without a shell.

    Args:
        count: number of points, about.
        look: (camera, frame) -> its picture, from a cache; None: `capture.view`.

    Raises:
        CaptureError: no point is seen by two training cameras.
    """
    s, look = settings.initialization, look or capture.view
    pictures = {camera: look(camera, frame) for camera in capture.indices("train")}
    views = [(capture.camera(i, frame), v.rgb, v.alpha) for i, v in pictures.items()]
    depths = [v.depth if s.use_depth else None for v in pictures.values()]
    known = [c for c, _, _ in views]
    has_depth, masked = any(d is not None for d in depths), all(alpha is not None for _, _, alpha in views)
    most = int(s.points_share_max * count)
    points = capture.points if s.use_points else None
    if points is None and s.triangulate and not masked and not has_depth:
        points = triangulated(capture, frame, s, pictures.__getitem__)
    own = known_points(points, views, most, settings.seed)
    left = count - len(own[0])
    if has_depth:
        found = _joined(own, depth_points(views, depths, left, settings.seed, settings.plane_sweep.depth_tolerance))
        if len(found[0]) >= s.sweep_min_share * count:
            return _on_surfaces(found, views, masked, settings)
    if masked:
        hull = hull_points(known, views, left, settings.visual_hull)
        if len(hull[0]):
            return _on_surfaces(_joined(own, hull), views, masked, settings)
    found = _joined(own, sweep(views, left, settings.seed, settings.plane_sweep)) if s.use_plane_sweep else own
    if len(found[0]) and len(found[0]) >= s.sweep_min_share * count:
        return _on_surfaces(found, views, False, settings)
    points, colors = random_points(known, views, count, settings.seed, settings.visual_hull)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=s.random_opacity), subject_radius(points)


def _on_surfaces(found: Cloud, views, masked: bool, settings: TrainSettings) -> tuple[Model, float]:
    """Gaussians at points on surfaces, and in a far shell where there are no masks; and the radius of the points."""
    model = from_points(*found, opacity=settings.initialization.surface_opacity)
    if not masked:
        model.append(far_shell(views, settings.far_shell).params)
    return model, subject_radius(found[0])


def _joined(a: Cloud, b: Cloud) -> Cloud:
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
