"""Stage measure: importance of each Gaussian of a group. It does not depend on quality: once a group."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ..model.attributes import ATTRIBUTES
from ..model.camera import Camera
from ..model.gaussians import Gaussians, living
from ..model.parametric_group import ParametricGroup
from ..render.sensitivity import Importance, measure, of_width, sensitivity_cameras
from .settings import PlanSettings

HIDDEN = -30.0  # logit opacity that no view shows
SHORT_LIFE = 0.5  # of the frames of a group; Gaussians that live shorter are in few of the views
SMALL = 128  # pixels, width of the images that measure Gaussians with a short life
GOLDEN = (5**0.5 - 1) / 2  # steps of this share visit a range evenly, in an order that no other sequence of views has


def measure_group(group: ParametricGroup, cameras: list[Camera], settings: PlanSettings) -> Importance:
    """Importance of the N Gaussians, from the first, the middle and the last frame. With lifetimes, every frame that
    shows Gaussians is measured: in a capture by one of its cameras and by another one. These views are too few to call
    a Gaussian with a short life unimportant: all cameras, with small images, measure the frames of such Gaussians.

    Args:
        cameras: of the capture, if there is one.
    """
    g, frames = group.canonical, group.frame_count
    if not len(g):
        own = [a for a in ATTRIBUTES if a.name != "shN" or g.sh_degree]
        sizes = {a.name: a.channels * (g.shN.shape[1] if a.name == "shN" else 1) for a in own}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    few = [group.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    around = np.concatenate([f.means for f in few])
    views = settings.more_views if frames == 1 or len(g) <= settings.few else settings.views
    if group.lifetimes is None:
        return measure(lambda i: few[i % len(few)], sensitivity_cameras(around, cameras, views))
    each = 2 if cameras else 1
    times = _living_frames(group.lifetimes, frames) or list(range(frames))
    times = [times[i] for i in _spread(len(times), max(views, each * len(times)) // each)]
    some = [cameras[i] for i in _spread(len(cameras), len(times))] if cameras else []
    placed = sensitivity_cameras(around, some, each * len(times))
    return _with_short_lived(measure(lambda i: _shown(group, times[i % len(times)]), placed), group, cameras)


def _with_short_lived(found: Importance, group: ParametricGroup, cameras: list[Camera]) -> Importance:
    """`found`; Gaussians with a short life have at least the importance that all `cameras` measure in their frames."""
    lived = np.diff(group.lifetimes, axis=1)[:, 0]
    short = (lived > 0) & (lived < SHORT_LIFE * group.frame_count)
    times = _living_frames(group.lifetimes[short], group.frame_count)
    if not times or not cameras:
        return found
    small = [of_width(c, SMALL) for c in cameras]
    shown = lru_cache(maxsize=1)(lambda t: _shown(group, t))  # one frame for all cameras
    seen = measure(lambda i: shown(times[i // len(small)]), small * len(times))
    return found.at_least(seen, len(times) / group.frame_count, short)


def _spread(items: int, count: int) -> list[int]:
    """`count` indices of `items` items: each once before any comes again; equally often if `items` divides `count`."""
    order = np.argsort([(i + 0.5) * GOLDEN % 1 for i in range(items)]).tolist()
    return [order[i % items] for i in range(count)]


def _living_frames(lifetimes: np.ndarray, frames: int) -> list[int]:
    """Frames in which a Gaussian lives."""
    return [t for t in range(frames) if living(lifetimes, t).any()]


def _shown(group: ParametricGroup, t: int) -> Gaussians:
    """All Gaussians at frame `t`; those outside of their lifetime are transparent."""
    g, shown = group.frame(t), living(group.lifetimes, t)
    return replace(g, logit_opacities=np.where(shown, g.logit_opacities, np.float32(HIDDEN)))
