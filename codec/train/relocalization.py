"""Relocalization: a batch of new Gaussians that has moved out of reach of the gradient is found again, or removed.

In: the Gaussians of a frame at constant velocity, and the batch. Out: the shift that moves the batch to where the
images show it, or None. A batch is lost if the images fit better without it. Then a plane sweep searches the pixels
that are wrong without it, and the place that fits best is taken.
"""

from __future__ import annotations

import numpy as np
import torch

from ..farthest_point_sampling import farthest_points
from .densification import error_masks, sweep_masked
from .model import REMOVED_LOGIT, Model
from .settings import RelocalizationSettings, TrainSettings


def relocalize(
    model: Model, some: torch.Tensor, frame: int, changes, masks: list[np.ndarray], settings: TrainSettings
) -> torch.Tensor | None:
    """Shift [3] that moves Gaussians to where `frame` shows them; None: they are nowhere.

    Args:
        model: all Gaussians.
        some: [N] bool, the Gaussians to find.
        changes: reference images, fitted to `frame`.
        masks: [h, w] bool of each training camera, changed pixels.
    """
    s, views = settings.relocalization, changes.views
    hidden = torch.where(some, REMOVED_LOGIT, model.params["logit_opacities"])
    others = Model({**model.params, "logit_opacities": hidden})
    best, found = image_error(others, frame, changes), None
    if image_error(model, frame, changes) < s.error_ratio * best:
        return torch.zeros(3)
    wrong = error_masks(others, masks, frame, views, settings.densification)
    points, _ = sweep_masked(wrong, frame, views, s.points, settings.plane_sweep)
    means = model.params["means"]
    center = means[some].mean(0)
    radius = float((means[some] - center).norm(dim=1).quantile(s.radius_quantile))
    for place in _mean_shift(points, radius, s):
        shift = torch.from_numpy(place).float() - center
        moved = Model({**model.params, "means": means + torch.where(some[:, None], shift, 0.0)})
        if (e := image_error(moved, frame, changes)) < best:
            best, found = e, shift
    return found


def image_error(model: Model, frame: int, changes) -> float:
    """Mean absolute difference to the small images of `changes` in grey levels, over all training cameras."""
    g, views, differences = model.gaussians(), changes.views, []
    for i, image in zip(views.train_cameras, changes.fitted, strict=True):
        rendered = views.render(g, i, frame, image.shape[1::-1])
        differences.append(np.abs(rendered.astype(np.float32) - image).mean())
    return float(np.mean(differences))


def _mean_shift(points: np.ndarray, radius: float, settings: RelocalizationSettings) -> list[np.ndarray]:
    """Centers [3] of dense balls of this radius among `points` [P, 3]."""
    found = []
    for place in points[farthest_points(points, settings.places)] if len(points) else ():
        for _ in range(settings.mean_shift_rounds):
            place = points[np.linalg.norm(points - place, axis=1) <= radius].mean(0)
        found.append(place)
    return found
