"""Bytes of still Gaussians after the first keyframe.

A Gaussian is still if its position changes by less than `WITHIN` radii of the subject during the first group. The group
is coded with and without the still Gaussians, and the difference in bytes is their cost. Positions, channels and header
do not count: they are the keyframe.
"""

from __future__ import annotations

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantization import subject_radius
from gscodec.encode.intra_group import code_group
from gscodec.encode.stack import stack_group
from gscodec.model.camera import Camera
from gscodec.model.gaussian_sequence import DenseGroup

WITHIN = 1e-3  # radii
KEYFRAME = ("group_header", "positions", "channels")


def still_share(group: DenseGroup, quality: float, cameras: list[Camera]) -> tuple[float, float]:
    """Share of the still Gaussians in the count and in the bytes after the keyframe, each 0 to 1."""
    coded = code_group(group, quality, cameras=cameras)
    means = stack_group(group).means[:, coded.source]
    still = np.ptp(means, 0).max(1) < WITHIN * subject_radius(means[0])
    whole, rest = _bytes_after_keyframe(coded.integers), _bytes_after_keyframe(_without(coded.integers, still))
    return float(still.mean()), 1 - rest / whole if whole else 0.0


def _bytes_after_keyframe(integers: dict) -> int:
    return sum(u["bytes"] for u in _native.encode_group(integers)[1] if u["type"] not in KEYFRAME)


def _without(integers: dict, gone: np.ndarray) -> dict:
    """The integers of a group without the Gaussians `gone`, [N] bool."""
    kept = ~gone
    layer = np.repeat(np.arange(len(integers["layers"])), integers["layers"])[kept]
    cut = lambda parts, name: {n: p | {name: np.ascontiguousarray(p[name][..., kept])} for n, p in parts.items()}  # noqa: E731
    out = integers | {
        "layers": np.bincount(layer, minlength=len(integers["layers"])).tolist(),
        "positions": integers["positions"][kept],
        "channels": cut(integers["channels"], "values"),
        "trajectories": cut(integers["trajectories"], "coefficients"),
    }
    lifetimes = integers.get("lifetimes")
    return out if lifetimes is None else out | {"lifetimes": lifetimes[kept]}
