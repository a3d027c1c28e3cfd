"""Attribute maps of a group for video codecs: the packing of x265_anchor.py and svt_av1.py.

As in GSCodec Studio: one order for the whole group (that of its first frame, by grid.py), ranges over all frames;
means 16 bit in two lossless planes, all else 8 bit; log scales and logit opacities, as trained. Spare cells repeat the
Gaussian with the lowest opacity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.model.gaussians import Gaussians

from .grid import grid_order

CHANNELS = {"means": 3, "sh0": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1}
LOSSLESS = ("means_low", "means_high")
_orders: dict[bytes, np.ndarray] = {}  # means -> order, which is the same at each point of a curve


def order_of(g: Gaussians) -> np.ndarray:
    """[side, side] Gaussian of each cell."""
    key = g.means.tobytes()
    if key not in _orders:
        order = grid_order(g)
        _orders[key] = np.where(order < 0, g.logit_opacities.argmin(), order)
    return _orders[key]


def pack(frames: Sequence[Gaussians]) -> tuple[dict[str, np.ndarray], bytes]:
    """Name -> [T, channels, side, side] u8, and the ranges [14, 2] f32.

    Raises:
        ValueError: the Gaussians have more than SH degree 0.
    """
    if frames[0].sh_degree:
        raise ValueError("the video baselines pack SH degree 0")
    order, ranges, maps = order_of(frames[0]), [], {}
    for name, channels in CHANNELS.items():
        values = np.stack([getattr(g, name).reshape(len(g), channels)[order] for g in frames])  # [T, side, side, c]
        low, high = values.min((0, 1, 2)), values.max((0, 1, 2))
        ranges.append(np.stack([low, high], 1))
        unit = np.moveaxis((values - low) / np.where(high > low, high - low, 1), 3, 1)
        if name == "means":
            code = np.rint(unit * 65535).astype(np.uint16)
            maps |= {"means_low": (code & 255).astype(np.uint8), "means_high": (code >> 8).astype(np.uint8)}
        else:
            maps[name] = np.rint(unit * 255).astype(np.uint8)
    return maps, np.concatenate(ranges).astype(np.float32).tobytes()


def unpack(maps: dict[str, np.ndarray], ranges: bytes) -> list[Gaussians]:
    """The mirror of `pack`; the Gaussians are in grid order and include those of the spare cells."""
    limits, parts, start = np.frombuffer(ranges, np.float32).reshape(-1, 2), {}, 0
    for name, channels in CHANNELS.items():
        low, high = limits[start : start + channels].T
        if name == "means":
            unit = (maps["means_low"] + 256.0 * maps["means_high"]) / 65535
        else:
            unit = maps[name] / 255
        parts[name] = np.moveaxis(unit, 1, 3).reshape(len(unit), -1, channels) * (high - low) + low  # [T, cells, c]
        start += channels
    parts["logit_opacities"] = parts["logit_opacities"][..., 0]
    parts["quats"][~parts["quats"].any(2)] = (1, 0, 0, 0)
    empty = np.zeros((parts["means"].shape[1], 0, 3))
    return [Gaussians(shN=empty, **{k: v[t] for k, v in parts.items()}).validate("maps") for t in range(len(unit))]
