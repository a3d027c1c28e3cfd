"""Values of Gaussians <-> channels: the integers of each attribute and how they are dequantized, for `encode_group`."""

from __future__ import annotations

from itertools import product

import numpy as np

from gscodec.camera import Camera
from gscodec.encode import curves as curved
from gscodec.encode import rdo
from gscodec.encode.refine import Moving, refine, with_values
from gscodec.gaussians import Gaussians

SHIFTED = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN")


def quantize_channels(
    values: np.ndarray, steps: np.ndarray, weights: np.ndarray, layers: list[tuple], shifts: np.ndarray, price: float
) -> dict:
    """[N, C] floats, along their curves -> channels of `encode_group`; offsets are the medians, so that small integers
    are common.

    Args:
        layers: of each its Gaussians (slice) and their neighbours (`rdo.neighbours`).
        shifts: [L] low bits that each layer leaves out.
    """
    offsets = np.median(values, axis=0) if len(values) else np.zeros(values.shape[1])
    offsets = offsets.astype(np.float32)
    q = np.zeros((len(steps), len(values)), np.int32)
    for (own, near), shift in zip(layers, shifts, strict=True):
        for c, step in enumerate(steps * 2.0**shift):
            x = (values[own, c] - offsets[c]) / step
            q[c, own] = rdo.keyframe(x, weights[own, c] * step**2, near, price).astype(np.int32) << shift
    return {"values": q, "steps": steps.tolist(), "offsets": offsets.tolist()}


def dequantize_channels(channels: dict) -> np.ndarray:
    """[N, C] f64, what the decoder makes of `quantize_channels`."""
    steps, offsets = (np.array(channels[k], np.float32) for k in ("steps", "offsets"))
    coded = (offsets + steps * channels["values"].T.astype(np.float32)).astype(np.float64)
    return curved.back(coded, curves_of(channels))


def curves_of(channels: dict) -> list[curved.Curve]:
    """Of each channel of an attribute; empty if it has none."""
    return [curved.Curve.of(row) for row in channels.get("curves", ())]


def shifts_of(integers: dict) -> dict[str, np.ndarray]:
    """[L] int of each attribute: low bits that the layers of a group in integers leave out."""
    names = [n for n in SHIFTED if n == "means" or n in integers["channels"]]
    shifts = integers["shifts"] or np.zeros((len(integers["layers"]), len(names)), int)
    return dict(zip(names, np.array(shifts, int).T, strict=True))


def margins_of(q: np.ndarray, weights: np.ndarray, step: np.ndarray, layers: list, price: float) -> np.ndarray:
    """[2, N, C], `rdo.margins` of integers [N, C] with sensitivities [N, C] and steps [C] or [N, C]."""
    found, weights = np.zeros((2, *q.shape), np.float32), weights * step**2
    for (own, near), c in product(layers, range(q.shape[1])):
        found[:, own, c] = rdo.margins(q[own, c], weights[own, c], near, price)
    return found


def refined_channels(
    values: dict,
    channels: dict,
    shifts: dict,
    weights: dict,
    layers: list,
    price: float,
    source: Gaussians,
    placed: Gaussians,
    cameras: list[Camera],
) -> dict:
    """`channels` of a single frame with refined integers.

    Args:
        values: what they were quantized from. shifts: [N]. weights, layers, price: as in `quantize_channels`.
        source: as it is to look. placed: the same at decoded positions. cameras: of `refine`.
    """
    unit = {n: 2.0 ** shifts[n][:, None].astype(np.float32) for n in channels}
    step = {n: np.array(c["steps"], np.float32) * unit[n] for n, c in channels.items()}
    offset = {n: np.array(c["offsets"], np.float32) for n, c in channels.items()}
    curves = {n: curves_of(c) for n, c in channels.items()}
    q = {n: c["values"].T / unit[n] for n, c in channels.items()}
    parts = [
        Moving(n, (values[n] - offset[n]) / step[n], v, margins_of(v, weights[n], step[n], layers, price))
        for n, v in q.items()
    ]

    def shown(_):
        coded = {p.attribute: offset[p.attribute] + step[p.attribute] * p.integers for p in parts}
        slopes = [step[n] * curved.rises(v, curves[n]) if curves[n] else step[n] for n, v in coded.items()]
        chain = [lambda d, s=s: d * s for s in slopes]
        return with_values(placed, {n: curved.back(v, curves[n]) for n, v in coded.items()}), chain

    refine(parts, lambda _: source, shown, cameras)
    moved = {p.attribute: p.integers.astype(np.int32) for p in parts}
    return {n: c | {"values": (moved[n] << shifts[n][:, None]).T} for n, c in channels.items()}
