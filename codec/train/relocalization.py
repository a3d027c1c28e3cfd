"""Newcomers that are lost: what falls is elsewhere in the next frame, out of the gradient's reach, or it is gone.

In: the Gaussians of a frame as the motion so far continues, and which of them came in together. Out: the shift that
brings these to where the pictures show them, or that they are nowhere. They are lost where the pictures are better
without them; then a plane sweep looks where pictures are wrong without them, and what fits best there is taken.
"""

from __future__ import annotations

import numpy as np
import torch

from ..farthest_point_sampling import farthest_points
from .densification import sweep_wrong, wrong_pixels
from .model import HIDDEN, Model
from .settings import RelocalizationSettings, TrainSettings


def whereabouts(
    model: Model, some: torch.Tensor, frame: int, changes, masks: list[np.ndarray], settings: TrainSettings
) -> torch.Tensor | None:
    """[3], the shift that brings Gaussians to where `frame` shows them; None: nowhere.

    Args:
        model: all Gaussians; some: [N] bool, those in question.
        changes: fitted to `frame`; masks: [h, w] bool of each training camera, what has changed in it.
    """
    s, views = settings.relocalization, changes.views
    hidden = torch.where(some, HIDDEN, model.params["logit_opacities"])
    others = Model({**model.params, "logit_opacities": hidden})
    least, found = error(others, frame, changes), None
    if error(model, frame, changes) < s.error_ratio * least:
        return torch.zeros(3)
    wrong = wrong_pixels(others, masks, frame, views, settings.densification)
    points, _ = sweep_wrong(wrong, frame, views, s.points, settings.plane_sweep)
    means = model.params["means"]
    centre = means[some].mean(0)
    radius = float((means[some] - centre).norm(dim=1).quantile(s.radius_quantile))
    for place in _places(points, radius, s):
        shift = torch.from_numpy(place).float() - centre
        moved = Model({**model.params, "means": means + torch.where(some[:, None], shift, 0.0)})
        if (e := error(moved, frame, changes)) < least:
            least, found = e, shift
    return found


def error(model: Model, frame: int, changes) -> float:
    """Mean absolute difference to the small pictures of `changes`, over all training cameras."""
    g, views, differences = model.gaussians(), changes.views, []
    for i, picture in zip(views.train_cameras, changes.fitted, strict=True):
        shown = views.render(g, i, frame, picture.shape[1::-1])
        differences.append(np.abs(shown.astype(np.float32) - picture).mean())
    return float(np.mean(differences))


def _places(points: np.ndarray, radius: float, settings: RelocalizationSettings) -> list[np.ndarray]:
    """Centres [3] of balls of this radius that hold many of the `points` [P, 3] (mean shift)."""
    found = []
    for place in points[farthest_points(points, settings.places)] if len(points) else ():
        for _ in range(settings.mean_shift_rounds):
            place = points[np.linalg.norm(points - place, axis=1) <= radius].mean(0)
        found.append(place)
    return found
