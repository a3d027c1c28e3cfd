"""Far shell: Gaussians around a scene without masks, for background without depth (sky, a dark hall).

In: views of one frame. Out: a model. Its Gaussians are flat and opaque, and overlap: if the background showed through,
training would fill the gap with Gaussians anywhere between the cameras and the scene.
"""

from __future__ import annotations

import numpy as np
import torch

from ..model.camera import fibonacci_directions, meeting_point, working_distance
from .model import Model, from_points
from .settings import FarShellSettings
from .visual_hull import colors_of, project


def far_shell(views, settings: FarShellSettings) -> Model:
    """Gaussians evenly over the directions that a view sees, each with the median colour of the views.

    Args:
        views: (camera, rgb u8 [H, W, 3], alpha or None) of each training camera.
    """
    cameras = [c for c, _, _ in views]
    directions = fibonacci_directions(settings.points)
    points = meeting_point(cameras) + settings.distance * working_distance(cameras) * directions
    seen = np.zeros(len(points), bool)
    for c in cameras:
        p, depth = project(c, points)
        seen |= (depth > 0) & (p >= 0).all(1) & (p < [c.width, c.height]).all(1)
    model = from_points(points[seen], colors_of(points[seen], views), opacity=settings.opacity)
    model.params["quats"] = torch.from_numpy(_from_x(directions[seen]).astype(np.float32))
    model.params["log_scales"] += torch.log(
        torch.tensor([settings.thickness * settings.width, settings.width, settings.width])
    )
    return model


def _from_x(directions: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] that turn the x axis to unit vectors [N, 3]; half a turn for vectors opposite to it."""
    x, y, z = directions.T
    quats = np.stack([1 + x, 0 * x, -z, y], 1)
    quats[x < -1 + 1e-9] = (0, 0, 0, 1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
