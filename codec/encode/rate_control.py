"""Bits per second -> a quality for each group: tries until a group fits the bits that earlier groups have left.

There is no look-ahead, so a live encoder can do the same; if a group takes too many or too few bits, the next one gets
fewer or more. The logarithm of the size is nearly linear in quality, so that two or three tries are enough. A group is
measured once; a try repeats only the stages that depend on quality.
"""

from __future__ import annotations

import math

from ..model.parametric_group import ParametricGroup
from .coder import CodedGroup, CoderState, GroupCoder
from .settings import RateControlSettings


def code_at_rate(
    coder: GroupCoder, state: CoderState | None, group: ParametricGroup, start: tuple[int, int, float]
) -> tuple[CodedGroup, CoderState | None, float]:
    """Codes `group` so that the file has the bit rate of the settings.

    Args:
        start: frames and bytes of the file so far, and the quality of the group before.

    Returns:
        The group, the coder's state after it, and its quality.
    """
    frames, size, quality = start
    s, per_frame = coder.settings.rate_control, coder.settings.bitrate / 8 / coder.fps
    budget = max(per_frame * (frames + len(group)) - size, s.least_budget * per_frame * len(group))
    importance, tried = coder.measure(group, frames), []  # of (distance, quality, log of size over budget, result)
    while len(tried) < s.tries:
        result = coder.code(state, group, importance, quality, frames)
        off = math.log(len(result[0].payload) / budget)
        tried.append((abs(off), quality, off, result))
        if abs(off) < s.tolerance:
            break
        quality = min(max(_next_quality(tried, s), 0.0), 100.0)
        if any(quality == t[1] for t in tried):
            break
    _, quality, _, (coded, state) = min(tried, key=lambda t: t[0])
    return coded, state, quality


def _next_quality(tried: list, settings: RateControlSettings) -> float:
    """The secant through the last two tries, or the usual slope through the last one."""
    _, quality, off, *_ = tried[-1]
    slope = settings.slope
    if len(tried) > 1 and tried[-2][1] != quality:
        slope = (off - tried[-2][2]) / (quality - tried[-2][1])
        slope = min(max(slope, settings.slope / 4), settings.slope * 4)
    return quality - off / slope
