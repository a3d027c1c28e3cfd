"""What Gaussians that do not move cost after the first keyframe.

They are those whose place stays within `WITHIN` of the subject's radius while the first group lasts. The group is coded
with and without them; the difference in bytes, but for positions, channels and header, which are the keyframe, is
theirs.
"""

from __future__ import annotations

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantization import subject_radius
from gscodec.encode.intra_group import code_group
from gscodec.encode.stack import stack_group
from gscodec.model.camera import Camera
from gscodec.model.gaussian_sequence import DenseGroup

WITHIN = 1e-3
KEYFRAME = ("group_header", "positions", "channels")


def still_share(group: DenseGroup, quality: float, cameras: list[Camera]) -> tuple[float, float]:
    """(share of the Gaussians that do not move, their share of the bytes behind the keyframe), 0 to 1 each."""
    coded = code_group(group, quality, cameras=cameras)
    means = stack_group(group).means[:, coded.source]
    still = np.ptp(means, 0).max(1) < WITHIN * subject_radius(means[0])
    whole, rest = _behind(coded.integers), _behind(_without(coded.integers, still))
    return float(still.mean()), 1 - rest / whole if whole else 0.0


def _behind(integers: dict) -> int:
    return sum(u["bytes"] for u in _native.encode_group(integers)[1] if u["type"] not in KEYFRAME)


def _without(integers: dict, gone: np.ndarray) -> dict:
    """A group in integers without the Gaussians that are `gone`, [N] bool."""
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
