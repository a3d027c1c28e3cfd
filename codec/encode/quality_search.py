"""Quality search, for streams without a given quality: finds the quality at which coding costs the allowed decibels.

The error is measured against the pictures of the capture, so that a clean capture gets finer steps than a noisy one.
The excess is the error of a try relative to the error of the model before coding, or to the error of very fine steps,
whichever is smaller: refinement by the pictures lowers the error of fine steps below the model's, which would hide the
cost of coarse ones. The log of the excess falls with the quality: by log 4 for `QUALITY_HALVES` points as a first guess
(refined steps lose less), and by linear interpolation between two tries on either side. A try is refined by a share of
the pictures of the final refinement. The first group with Gaussians decides for all.
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
from .quantize import Quantized


def choose_quality(coder: GroupCoder, group: ParametricGroup, importance: Importance, first_frame: int) -> float | None:
    """Quality for a stream whose first group is `group`, which has pictures (`GroupCoder.has_pictures`); None: the
    group has no Gaussians.

    Raises:
        CaptureError: a picture cannot be read.
    """
    s = coder.settings.quality_search
    finest = coder.quantized(group, importance, s.finest)
    if not len(finest.integers):
        return None
    wanted = 10 ** (coder.settings.loss / 10) - 1
    least = min(_errors(coder, group, finest, first_frame))
    tried: dict[float, float] = {}  # quality -> log of the excess over the wanted one
    quality = s.start
    while len(tried) < s.tries and quality not in tried:
        model, decoded = _errors(coder, group, coder.quantized(group, importance, quality), first_frame)
        excess = decoded / max(min(model, least), 1e-12) - 1
        tried[quality] = math.log(max(excess, s.excess_min) / wanted)
        if abs(tried[quality]) < s.tolerance:
            break
        quality = min(max(_next(tried), s.lowest), s.highest)
    return min(tried, key=lambda q: abs(tried[q]))


def _next(tried: dict[float, float]) -> float:
    """The quality to try next."""
    coarse = max((q for q, log_excess in tried.items() if log_excess > 0), default=None)
    fine = min((q for q, log_excess in tried.items() if log_excess <= 0), default=None)
    if coarse is None or fine is None:
        quality = fine if coarse is None else coarse
        return quality + QUALITY_HALVES * tried[quality] / math.log(4)
    share = tried[coarse] / (tried[coarse] - tried[fine])
    return coarse + (fine - coarse) * share


def _errors(coder: GroupCoder, group: ParametricGroup, quantized: Quantized, first_frame: int) -> tuple[float, float]:
    """Mean squared error against the pictures, of the frames before coding and of those decoded from `quantized`, at
    pixels where the former do not contradict the mask."""
    s, backend, errors = coder.settings.quality_search, CpuBackend(), np.zeros(2)
    rounding = AdaptiveRounding(quantized, coder.settings)
    coder.refine_by_pictures(group, first_frame, rounding, s.frame_pictures * len(group))
    count = max(s.judged, len(group))
    pictures = coder.refine_by_pictures.masked_pictures(group, first_frame, count, s.seed)
    for (t, camera, background, picture), mask in pictures:
        rendered = [backend.render(params_of(g), camera, background) for g in (rounding.source(t), rounding.frame(t))]
        agreed = slice(None)
        if mask is not None:
            agreed = np.abs(rendered[0][1] - mask / 255) <= s.mask_error_max
        for i, (image, _) in enumerate(rendered):
            difference = (np.clip(image, 0, 1) - picture)[agreed]
            errors[i] += float(np.square(difference).sum()) / max(difference.size, 1) / count
    return errors[0], errors[1]
