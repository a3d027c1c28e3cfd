"""Without a quality that somebody names: the one at which coding costs as many decibels as the preset allows.

What counts is the error against the pictures of the capture, so that a clean capture gets finer steps than a noisy one:
that of a try over that of the model before coding, or over that of very fine steps, whichever is smaller. Refinement by
the pictures lowers the error of fine steps below the model's, and would hide what coarse ones cost. The excess of the
squared error falls by 4 for `QUALITY_HALVES` points of quality, so that a few tries find it. A try is refined by a
share of the pictures that the group will be refined by in the end, and the first group decides for all.
"""

from __future__ import annotations

import math

import numpy as np

from ..bitstream.quantization import QUALITY_HALVES
from ..model.parametric_group import ParametricGroup
from ..render.cpu import CpuBackend
from ..render.sensitivity import Importance, params_of
from .adaptive_rounding import AdaptiveRounding
from .coder import GroupCoder


def choose_quality(coder: GroupCoder, group: ParametricGroup, importance: Importance, first_frame: int) -> float:
    """Quality for a stream whose first group is `group`, which has pictures (`GroupCoder.has_pictures`).

    Raises:
        CaptureError: a picture cannot be read.
    """
    s, quality = coder.settings.quality_search, coder.settings.quality_search.start
    wanted = 10 ** (coder.settings.loss / 10) - 1
    tried: dict[float, float] = {}
    least = min(_errors(coder, group, importance, s.finest, first_frame))
    while len(tried) < s.tries:
        model, decoded = _errors(coder, group, importance, quality, first_frame)
        excess = decoded / max(min(model, least), 1e-12) - 1
        tried[quality] = abs(math.log(max(excess, 1e-6) / wanted))
        if tried[quality] < s.tolerance:
            break
        step = QUALITY_HALVES * math.log(max(excess, s.excess_min) / wanted, 4)
        quality = min(max(quality + step, s.lowest), s.highest)
        if quality in tried:
            break
    return min(tried, key=lambda q: tried[q])


def _errors(
    coder: GroupCoder, group: ParametricGroup, importance: Importance, quality: float, first_frame: int
) -> tuple[float, float]:
    """Mean squared error against the pictures, of the frames before coding and of those decoded with `quality`."""
    s, backend, errors = coder.settings.quality_search, CpuBackend(), np.zeros(2)
    rounding = AdaptiveRounding(coder.quantized(group, importance, quality), coder.settings)
    coder.refine_by_pictures(group, first_frame, rounding, s.frame_pictures * len(group))
    count = max(s.judged, len(group))
    for t, camera, background, picture in coder.refine_by_pictures.pictures(group, first_frame, count, s.seed):
        for i, g in enumerate((rounding.source(t), rounding.frame(t))):
            image, _ = backend.render(params_of(g), camera, background)
            errors[i] += float(np.mean((np.clip(image, 0, 1) - picture) ** 2)) / count
    return errors[0], errors[1]
