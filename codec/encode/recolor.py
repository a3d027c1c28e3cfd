"""New colours on the geometry of a coded group: its integers + new colours -> integers.

Positions, sizes, rotations, opacities, motion and lifetimes keep their integers, and so their bytes: each stream of a
tile is coded by itself, in contexts of the nearest positions (spec 7). Colours are quantized again, in the steps and
layers of the group. Survivors of a predicted group have the canonical colours of its reference; the difference is in
the constant part of their trajectories.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..bitstream.quantization import trajectory_step
from ..bitstream.quantized_group import QuantizedChannels, QuantizedGroup, QuantizedTrajectories
from ..model.parametric_group import ParametricGroup
from ..render.sensitivity import Importance
from . import rdo
from .coded_form import CodedForm, appearance
from .quantization_plan import Parameters, Plan
from .quantize import Quantized, ReferenceGroup, canonical_integers, dequantize, grid_of, medians
from .settings import EncodeSettings

COLORS = ("sh0", "shN")


def recolored(
    old: QuantizedGroup,
    group: ParametricGroup,
    importance: Importance,
    settings: EncodeSettings,
    reference: ReferenceGroup | None = None,
) -> Quantized:
    """The integers of `old` with the colours of `group`, not refined.

    Args:
        group: the decoded `old`, in its order, with other sh0 and shN.
        importance: of `group`.
        reference: the recoloured group to which `old` refers; None: it is independent.
    """
    values, trajectories = appearance(group, np.tile(np.arange(3), (len(old), 1)))
    lineage = np.full(len(old), -1) if reference is None else old.parents
    plan = _plan_of(old, importance, settings)
    layers = rdo.coded_layers(old.positions, _counts(old), _births(old, lineage, plan))
    form = _form_of(group, lineage, values, trajectories)
    colors = [n for n in COLORS if n in old.channels]
    channels = dict(old.channels)
    for name in colors:
        channels[name] = _canonical(name, old, values[name], plan, layers, lineage, settings, reference)
    integers = replace(old, channels=channels)
    kept = {n: t for n, t in old.trajectories.items() if n not in COLORS}
    coefficients = {}
    if old.frames > 1 or reference:
        for name in colors:
            left = np.sqrt(old.frames) * (values[name] - dequantize(channels[name], None)).T
            c = np.zeros((1, *left.shape)) if name not in trajectories else trajectories[name].copy()
            c[0] += left
            step = trajectory_step(plan.parameters.trajectory_steps[name], old.frames)
            c = coefficients[name] = (c / step).astype(np.float32)
            weights = importance.weights[name] * step**2
            found = rdo.quantize_trajectories(c, weights, old.frames, plan.price, settings.rdo)
            if found.any():
                kept[name] = QuantizedTrajectories(found, step)
    return Quantized(replace(integers, trajectories=kept), form, plan, layers, coefficients)


def _counts(q: QuantizedGroup) -> tuple[int, ...]:
    return (len(q),) if q.layers is None else tuple(q.layers)


def _births(q: QuantizedGroup, lineage: np.ndarray, plan: Plan) -> list[int]:
    """Number of Gaussians that each layer codes itself."""
    return np.bincount(plan.layer[lineage < 0], minlength=len(_counts(q))).tolist()


def _plan_of(q: QuantizedGroup, importance: Importance, settings: EncodeSettings) -> Plan:
    """The plan by which the colours of `q` were coded, as far as its integers tell."""
    counts, names = _counts(q), ("means", *q.channels)
    shifts = np.zeros((len(counts), len(names)), int) if q.shifts is None else q.shifts.astype(int)
    shifts = dict(zip(names, shifts.T, strict=True))
    layer = np.repeat(np.arange(len(counts)), counts)
    steps = {n: q.channels[n].steps for n in COLORS if n in q.channels}
    errors = [  # mean squared error of the image that the steps of each channel cause
        (importance.weights[n] * 4.0 ** shifts[n][layer][:, None]).sum(0) * s.astype(float) ** 2 / 12
        for n, s in steps.items()
    ]
    channels = 3 + sum(len(c.steps) for c in q.channels.values())  # each has the same share of the error
    error = channels * float(np.median(np.concatenate(errors))) if len(q) else 1.0
    price = rdo.bit_price(max(error, 1e-12), len(q), True, settings.rdo)
    over_time = {n: _step_over_time(q, n, s) for n, s in steps.items()}
    parameters = Parameters(grid_of(q), steps, shifts, {}, q.scale_exponents, over_time, 0.0)
    return Plan(np.arange(len(q)), layer, importance, price, parameters)


def _step_over_time(q: QuantizedGroup, name: str, steps: np.ndarray) -> float:
    """Step of a value in one frame: that of its trajectories; without trajectories, a mean of the canonical steps."""
    if name in q.trajectories:
        return q.trajectories[name].step / float(np.sqrt(q.frames))
    return float(1 / np.sqrt((1 / steps.astype(np.float64) ** 2).mean()))


def _form_of(group: ParametricGroup, lineage: np.ndarray, values: dict, trajectories: dict) -> CodedForm:
    """The group in its coded form; only colours are needed, so axes stay as they are."""
    g, n = group.canonical, len(group.canonical)
    order, turn = np.tile(np.arange(3), (n, 1)), np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    means, quats = group.moved()
    still = g.means.astype(np.float64), g.quats, order, turn
    return CodedForm(group, np.arange(n), lineage, *still, values, trajectories, means, quats)


def _canonical(
    name: str, old: QuantizedGroup, values: np.ndarray, plan: Plan, layers, lineage, settings, reference
) -> QuantizedChannels:
    """Canonical integers of an attribute; survivors have those of the reference."""
    known = reference and reference.integers.channels[name]
    offsets = known.offsets if known else medians(values)
    q = canonical_integers(name, values, offsets, plan, layers, settings.rdo)
    if known:
        survives = lineage >= 0
        q[:, survives] = known.values[:, lineage[survives]]
    return replace(old.channels[name], values=np.ascontiguousarray(q), offsets=offsets)
