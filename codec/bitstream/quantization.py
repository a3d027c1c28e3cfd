"""Quantization steps: chosen by the encoder, simulated in training, sent in the group header.

One number, `quality`, scales all steps. Geometry steps are proportional to the size of the subject, so that captures in
millimetres and in metres give the same image. Ratios between attributes: equal slopes of rendered error against bits,
measured on the statue's middle frame (halving one step at a time). These steps are nominal; encoder and training
measure the steps that each scene needs for the same error (render/sensitivity.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model.attributes import ATTRIBUTES

QUALITY_DEFAULT = 50.0
QUALITY_HALVES = 12.0  # points of quality that halve every step (6 dB)
PSNR_DEFAULT = 41.0  # against the input, at QUALITY_DEFAULT
MODEL = 2.4  # ratio of the measured error to the predicted sum of independent small errors
RADIUS_MAX = 2.5  # times the median distance from the middle; a filled shape has about 2


@dataclass(frozen=True)
class Steps:
    """Uniform quantization steps: `steps["sh0"]` is in the attribute's own units (means: world units).

    Attributes:
        by_attribute: attribute -> step.
        node_translation: step of node translations, world units.
    """

    by_attribute: dict[str, float]
    node_translation: float

    def __getitem__(self, attribute: str) -> float:
        return self.by_attribute[attribute]


def steps_for(quality: float, radius: float) -> Steps:
    """Steps for `quality` (0 coarse .. 100 fine) and a subject of bounding radius `radius` (world units)."""
    f = 2.0 ** ((QUALITY_DEFAULT - quality) / QUALITY_HALVES)
    steps = {a.name: a.nominal_step * f * (radius if a.name == "means" else 1.0) for a in ATTRIBUTES}
    return Steps(steps, node_translation=steps["means"])


def error_for(quality: float) -> float:
    """Mean squared error of the image (pixels 0 to 1) at `quality`, as predicted from sensitivities."""
    return 10 ** (-PSNR_DEFAULT / 10) / MODEL * 4.0 ** ((QUALITY_DEFAULT - quality) / QUALITY_HALVES)


def trajectory_step(step: float, frames: int) -> float:
    """Step of temporal DCT coefficients where the canonical value has `step`.

    An error of the canonical value counts in all T frames, an error of an orthonormal coefficient counts once: at equal
    slopes of rate against distortion the coefficient's step is sqrt(T) times as large.
    """
    return float(np.float32(step * np.sqrt(frames)))


def subject_radius(means: np.ndarray) -> float:
    """Radius of the sphere around the 1-99 % box of `means` ([N, 3]), world units, but at most `RADIUS_MAX` times their
    median distance from the middle, so that a far background does not count; 1 for a single point."""
    if len(means) == 0:
        return 1.0
    low, middle, high = np.percentile(means, [1, 50, 99], axis=0)
    away = float(np.median(np.linalg.norm(means - middle, axis=1)))
    return min(float(np.linalg.norm(high - low) / 2), RADIUS_MAX * away or np.inf) or 1.0
