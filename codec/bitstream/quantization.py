"""Quantization steps: data that the encoder picks, training simulates and the group header carries.

One number, `quality`, scales them all; the geometry steps follow the size of the subject, so that a capture in
millimetres and one in metres get the same picture. Ratios between attributes: measured on statue and lumberjack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

QUALITY_DEFAULT = 50.0
QUALITY_HALVES = 12.0  # so many points of quality halve every step (about 5 dB)


@dataclass(frozen=True)
class Steps:
    """Uniform quantization steps, one per attribute, in the attribute's own units (means: world units)."""

    means: float
    log_scales: float
    quats: float
    logit_opacities: float
    sh0: float
    shN: float
    motion: float  # residual trajectories of means, world units
    node_rotation: float  # radians
    node_translation: float  # world units


def steps_for(quality: float, radius: float) -> Steps:
    """Steps for `quality` (0 coarse .. 100 fine) and a subject of bounding radius `radius` (world units)."""
    f = 2.0 ** ((QUALITY_DEFAULT - quality) / QUALITY_HALVES)
    means = 0.0016 * radius * f
    return Steps(
        means=means,
        log_scales=0.4 * f,
        quats=0.1 * f,
        logit_opacities=1.0 * f,
        sh0=0.2 * f,
        shN=0.2 * f,
        motion=means,
        node_rotation=0.01 * f,
        node_translation=means,
    )


def subject_radius(means: np.ndarray) -> float:
    """Radius of the sphere around the 1-99 % box of `means` ([N, 3]), world units; 1 for a single point."""
    if len(means) == 0:
        return 1.0
    low, high = np.percentile(means, [1, 99], axis=0)
    return float(np.linalg.norm(high - low) / 2) or 1.0
