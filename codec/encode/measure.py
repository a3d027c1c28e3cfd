"""Stage measure: how much each Gaussian of a group shows. It does not depend on quality, and is done once a group."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..model.attributes import ATTRIBUTES
from ..model.camera import Camera
from ..model.gaussians import Gaussians, living
from ..model.parametric_group import ParametricGroup
from ..render.sensitivity import Importance, measure
from .settings import PlanSettings

HIDDEN = -30.0  # logit opacity that no view shows
GOLDEN = (5**0.5 - 1) / 2  # steps of this share of a range visit it evenly, in an order of no other sequence of views


def measure_group(group: ParametricGroup, cameras: list[Camera], settings: PlanSettings) -> Importance:
    """Importance of the N Gaussians, from the first, the middle and the last frame. Where Gaussians come and go, every
    frame that shows some is seen, in a capture by one of its cameras and by another one: what lives in one frame shows
    in few views.

    Args:
        cameras: from which the subject was captured, if it was.
    """
    g, frames = group.canonical, group.frame_count
    if not len(g):
        own = [a for a in ATTRIBUTES if a.name != "shN" or g.sh_degree]
        sizes = {a.name: a.channels * (g.shN.shape[1] if a.name == "shN" else 1) for a in own}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    few = [group.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    around = np.concatenate([f.means for f in few])
    views = settings.more_views if frames == 1 or len(g) <= settings.few else settings.views
    if group.lifetimes is not None:
        each = 2 if cameras else 1
        times = _living_frames(group.lifetimes, frames)
        times = [times[i] for i in _spread(len(times), max(views, each * len(times)) // each)]
        some = [cameras[i] for i in _spread(len(cameras), len(times))] if cameras else []
        return measure(lambda i: _shown(group, times[i % len(times)]), around, some, each * len(times))
    return measure(lambda i: few[i % len(few)], around, cameras, views)


def _spread(items: int, count: int) -> list[int]:
    """`count` of so many items; each comes once before any comes again, where `count` is a multiple of `items`."""
    order = np.argsort([(i + 0.5) * GOLDEN % 1 for i in range(items)]).tolist()
    return [order[i % items] for i in range(count)]


def _living_frames(lifetimes: np.ndarray, frames: int) -> list[int]:
    """Frames that show something; all of them if none does."""
    shown = [t for t in range(frames) if living(lifetimes, t).any()]
    return shown or list(range(frames))


def _shown(group: ParametricGroup, t: int) -> Gaussians:
    """All Gaussians at frame `t`; those outside of their lifetime are transparent."""
    g, shown = group.frame(t), living(group.lifetimes, t)
    return replace(g, logit_opacities=np.where(shown, g.logit_opacities, np.float32(HIDDEN)))
