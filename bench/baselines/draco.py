"""Draco's point cloud coder on each frame alone: positions quantized by Draco, the other attributes 8-bit integers.

Points are in Morton order, which is kept: with this many attributes, Draco's sequential coder is smaller and much
faster than its kd-tree coder. The range of an attribute is that of the frame; compression level 10, the highest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.errors import require
from gscodec.model.gaussians import Gaussians

from .grid import morton_order

SETTINGS = {f"{p}/{a} bit": {"position": p, "attribute": a} for p, a in ((11, 5), (12, 6), (13, 7), (14, 8), (16, 8))}
ATTRIBUTES = ("quats", "log_scales", "logit_opacities", "sh0", "shN")


def encode(frames: Sequence[Gaussians], position: int, attribute: int) -> dict[str, bytes]:
    """Codes frames with `position` and `attribute` bits; returns their files."""
    draco, files = require("DracoPy", "the Draco baseline"), {}
    for t, frame in enumerate(frames):
        g, ranges, codes = frame.take(morton_order(frame.means)), [], {}
        for name in ATTRIBUTES:
            values = getattr(g, name).reshape(len(g), -1)
            if not values.shape[1]:
                continue
            low, high = values.min(0), values.max(0)
            unit = (values - low) / np.where(high > low, high - low, 1)
            codes[name] = np.rint(unit * (2**attribute - 1)).astype(np.uint8)
            ranges.append(np.stack([low, high]))
        files[f"{t}.drc"] = draco.encode(
            g.means,
            quantization_bits=position,
            compression_level=10,
            preserve_order=True,
            generic_attributes=codes,
        )
        files[f"{t}.ranges"] = np.concatenate(ranges, 1).astype(np.float32).tobytes()
    return files | {"bits": bytes([attribute])}


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames."""
    draco, frames = require("DracoPy", "the Draco baseline"), []
    for t in range(len(files) // 2):
        cloud = draco.decode(files[f"{t}.drc"])
        low, high = np.frombuffer(files[f"{t}.ranges"], np.float32).reshape(2, -1)
        stored = {a["name"]: a["data"].reshape(len(cloud.points), -1) for a in cloud.attributes if a.get("name")}
        code = np.concatenate([stored[name] for name in ATTRIBUTES if name in stored], 1)
        v = code / (2.0 ** files["bits"][0] - 1) * (high - low) + low
        quats = np.where(v[:, :4].any(1, keepdims=True), v[:, :4], (1, 0, 0, 0))
        shN = v[:, 11:].reshape(len(v), -1, 3)
        frames.append(Gaussians(cloud.points, quats, v[:, 4:7], v[:, 7], v[:, 8:11], shN).validate("Draco"))
    return frames
