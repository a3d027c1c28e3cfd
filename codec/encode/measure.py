"""Stage measure: how much each Gaussian of a group shows. It does not depend on quality, and is done once a group."""

from __future__ import annotations

import numpy as np

from ..model.attributes import ATTRIBUTES
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
        own = [a for a in ATTRIBUTES if a.name != "shN" or g.sh_degree]
        sizes = {a.name: a.channels * (g.shN.shape[1] if a.name == "shN" else 1) for a in own}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    shown = [group.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    views = settings.more_views if frames == 1 or len(g) <= settings.few else settings.views
    return measure(shown, cameras, views)
