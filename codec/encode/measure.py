"""Stage measure: how much each Gaussian of a group shows. It does not depend on quality, and is done once a group."""

from __future__ import annotations

import numpy as np

from ..model.camera import Camera
from ..model.parametric_group import ParametricGroup
from ..render.sensitivity import Importance, measure
from .settings import PlanSettings


def measure_group(group: ParametricGroup, cameras: list[Camera], settings: PlanSettings) -> Importance:
    """Importance of the N Gaussians, from the first, the middle and the last frame.

    Args:
        cameras: from which the subject was captured, if it was.
    """
    g, frames = group.canonical, group.frame_count
    if not len(g):
        sizes = {"means": 3, "log_scales": 3, "quats": 3, "logit_opacities": 1, "sh0": 3}
        sizes |= {"shN": 3 * g.shN.shape[1]} if g.sh_degree else {}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    shown = [group.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    views = settings.more_views if frames == 1 or len(g) <= settings.few else settings.views
    return measure(shown, cameras, views)
