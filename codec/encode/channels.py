"""Values of Gaussians <-> channels: the integers of each attribute and how they are dequantized, for `encode_group`."""

from __future__ import annotations

import numpy as np

from . import companding as curved
from . import rdo

SHIFTED = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN")


def quantize_channels(
    values: np.ndarray, steps: np.ndarray, weights: np.ndarray, layers: list[tuple], shifts: np.ndarray, price: float
) -> dict:
    """[N, C] floats, along their curves -> channels of `encode_group`; offsets are the medians, so that small integers
    are common.

    Args:
        layers: of `rdo.layers_of`.
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


def coded_values(channels: dict) -> np.ndarray:
    """[N, C] f64, what the integers stand for along their curves."""
    steps, offsets = (np.array(channels[k], np.float32) for k in ("steps", "offsets"))
    return (offsets + steps * channels["values"].T.astype(np.float32)).astype(np.float64)


def dequantize_channels(channels: dict) -> np.ndarray:
    """[N, C] f64, what the decoder makes of `quantize_channels`."""
    return curved.back(coded_values(channels), curves_of(channels))


def curves_of(channels: dict) -> list[curved.Curve]:
    """Of each channel of an attribute; empty if it has none."""
    return [curved.Curve.of(row) for row in channels.get("curves", ())]


def shifts_of(integers: dict) -> dict[str, np.ndarray]:
    """[L] int of each attribute: low bits that the layers of a group in integers leave out."""
    names = [n for n in SHIFTED if n == "means" or n in integers["channels"]]
    shifts = integers["shifts"] or np.zeros((len(integers["layers"]), len(names)), int)
    return dict(zip(names, np.array(shifts, int).T, strict=True))
