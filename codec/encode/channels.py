"""Values of Gaussians <-> channels: the integers of each attribute and how they are dequantized, for `encode_group`."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from gscodec.encode import curves as curved
from gscodec.encode import rdo

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


def refined_channels(
    refine: Callable[..., dict], values: dict, channels: dict, shifts: dict, weights: dict, layers: list, price: float
) -> dict:
    """`channels` of a single frame with refined integers; `values`: what they were quantized from, `shifts`: [N]; the
    others as in `quantize_channels`."""
    unit = {n: 2.0 ** shifts[n][:, None].astype(np.float32) for n in channels}
    step = {n: np.array(c["steps"], np.float32) * unit[n] for n, c in channels.items()}
    offset = {n: np.array(c["offsets"], np.float32) for n, c in channels.items()}
    curves = {n: curves_of(c) for n, c in channels.items()}

    def decode(q):
        coded = {n: offset[n] + step[n] * v for n, v in q.items()}
        slopes = {n: step[n] * curved.rises(coded[n], curves[n]) if curves[n] else step[n] for n in coded}
        return {n: curved.back(v, curves[n]) for n, v in coded.items()}, slopes

    latents = {n: (values[n] - offset[n]) / step[n] for n in channels}
    q = {n: c["values"].T / unit[n] for n, c in channels.items()}
    margins = {n: [np.zeros(v.shape, np.float32) for _ in range(2)] for n, v in q.items()}
    for n, v in q.items():
        for (own, near), c in product(layers, range(v.shape[1])):
            found = rdo.margins(v[own, c], weights[n][own, c] * step[n][own, c] ** 2, near, price)
            margins[n][0][own, c], margins[n][1][own, c] = found
    q = refine(latents, q, margins, decode)
    return {n: c | {"values": (q[n] << shifts[n][:, None]).T.astype(np.int32)} for n, c in channels.items()}
