"""Bytes of still Gaussians after the first keyframe.

A Gaussian is still if its position changes by less than `WITHIN` radii of the subject during the first group. The group
is coded with and without the still Gaussians, and the difference in bytes is their cost. Positions, channels and header
do not count: they are the keyframe.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantization import subject_radius
from gscodec.bitstream.quantized_group import QuantizedGroup
from gscodec.encode.coded_form import coded_form
from gscodec.encode.measure import measure_group
from gscodec.encode.quantization_plan import plan_group
from gscodec.encode.quantize import Quantized, quantize
from gscodec.encode.settings import EncodeSettings
from gscodec.model.camera import Camera
from gscodec.model.parametric_group import ParametricGroup

WITHIN = 1e-3  # radii
KEYFRAME = ("group_header", "positions", "channels")


def still_share(group: ParametricGroup, quality: float, cameras: list[Camera]) -> tuple[float, float]:
    """Share of the still Gaussians in the count and in the bytes after the keyframe, each 0 to 1."""
    coded = _quantized(group, quality, cameras)
    means = coded.form.held(coded.form.means)
    still = np.ptp(means, 0).max(1) < WITHIN * subject_radius(means[0])
    whole, rest = _bytes_after_keyframe(coded.integers), _bytes_after_keyframe(_without(coded.integers, still))
    return float(still.mean()), 1 - rest / whole if whole else 0.0


def _quantized(group: ParametricGroup, quality: float, cameras: list[Camera]) -> Quantized:
    """The group in integers, independent and not refined, together with the form that its Gaussians are coded in."""
    settings, form = EncodeSettings(quality), coded_form(group, np.full(len(group.canonical), -1))
    importance = measure_group(group, cameras, settings.plan).with_axes(form.axis_order)
    return quantize(form, plan_group(form, importance, quality, settings), settings.rdo)


def _bytes_after_keyframe(integers: QuantizedGroup) -> int:
    return sum(u["bytes"] for u in _native.encode_group(integers)[1] if u["type"] not in KEYFRAME)


def _without(integers: QuantizedGroup, gone: np.ndarray) -> QuantizedGroup:
    """The integers of a group without the Gaussians `gone`, [N] bool."""
    kept = ~gone
    layer = np.repeat(np.arange(len(integers.layers)), integers.layers)[kept]
    cut = lambda parts, name: {  # noqa: E731
        n: replace(p, **{name: np.ascontiguousarray(getattr(p, name)[..., kept])}) for n, p in parts.items()
    }
    return replace(
        integers,
        layers=tuple(np.bincount(layer, minlength=len(integers.layers)).tolist()),
        positions=integers.positions[kept],
        channels=cut(integers.channels, "values"),
        trajectories=cut(integers.trajectories, "coefficients"),
        lifetimes=None if integers.lifetimes is None else integers.lifetimes[kept],
    )
