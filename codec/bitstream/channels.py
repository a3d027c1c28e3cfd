"""Gaussians -> the values of their coded channels (spec 3.2)."""

from __future__ import annotations

import numpy as np

from ..model.attributes import ATTRIBUTES
from ..model.gaussians import Gaussians
from .color import decorrelate


def channel_values(g: Gaussians) -> dict[str, np.ndarray]:
    """attribute -> [N, C]: colours as Y, Co, Cg; quats as their vector part; shN only if the SH degree is above 0."""
    out = {}
    for a in ATTRIBUTES:
        values = getattr(g, a.name)
        if a.name == "quats":
            values = values[:, 1:]
        if a.decorrelated:
            values = decorrelate(values)
        if values.size or a.name != "shN":
            out[a.name] = values.reshape(len(g), int(np.prod(values.shape[1:])))
    return out
