"""Rotations: each is coded as the residual to its nearest neighbour's decoded rotation (spec 13.1), about its own axes.

Gaussians on a smooth surface have similar rotations, so residuals are small where rotations are not. An error about the
longest axis is hardly visible; an error about another axis is the more visible the longer the Gaussian is. So the steps
of a Gaussian follow from its decoded sizes, by exponents that are fitted to the measured sensitivities of the group.
"""

from __future__ import annotations

import numpy as np

from .. import _native
from . import rdo
from .settings import RdoSettings, ScaleExponentSettings

EXPONENT_UNIT = 32  # exponents of the bitstream are multiples of 1/32
FARTHEST = 64.0  # octaves (spec 13.1)


def fit_scale_exponents(log_scales: np.ndarray, weights: np.ndarray, settings: ScaleExponentSettings) -> np.ndarray:
    """[3, 3] i32, how much each channel's step falls with each size; log_scales, weights (sensitivities): [N, 3]."""
    if len(weights) < settings.least:
        return np.zeros((3, 3), np.int32)
    sizes = np.column_stack([np.ones(len(log_scales)), log_scales])
    octaves = np.log2(weights + settings.prior * weights.mean(0) + 1e-30)
    slopes = np.linalg.lstsq(sizes, octaves, rcond=None)[0][1:].T
    return np.rint(EXPONENT_UNIT * settings.share * slopes).clip(-128, 127).astype(np.int32)


def step_factors(log_scales: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """[N, 3] factors on the steps of the channels, for each Gaussian of log_scales [N, 3]."""
    octaves = -(log_scales @ (np.asarray(exponents, np.float32).T / EXPONENT_UNIT))
    return np.exp2(octaves.clip(-FARTHEST, FARTHEST))


def quantize_rotations(
    quats: np.ndarray,
    steps: np.ndarray,
    positions: np.ndarray,
    layers: list[rdo.Layer],
    weights: np.ndarray,
    price: float,
    settings: RdoSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Integers of quats [N, 3] i32 that the layers code themselves (0 for the others), and the form [N] u8 of each: 1,
    i, j or k; the quaternion was multiplied by its inverse from the right.

    Args:
        quats: [N, 4], axes by falling scale.
        steps: [N, 3] of each Gaussian, sines of half an angle.
        positions: [N, 3] u32.
        weights: [N, 3] sensitivities to rotations about the own axes.
        price: of a bit.
    """
    steps, quats = np.ascontiguousarray(steps, np.float32), np.ascontiguousarray(quats, np.float32)
    values, forms = np.zeros((len(quats), 3), np.int32), np.zeros(len(quats), np.uint8)
    for own, near in layers:
        given = (quats[own], steps[own], positions[own])
        if not len(given[0]):
            continue
        plain = _native.quantize_rotations(*given, np.zeros_like(steps[own]), np.zeros(0, np.float32))[0]
        lengths = np.stack([rdo.code_lengths(q, near, settings) for q in plain.T]).astype(np.float32).ravel()
        errors = (weights[own] * steps[own] ** 2).T
        worth = np.stack([rdo.lambda_cost(w, price, settings) for w in errors], 1).astype(np.float32)
        values[own], forms[own] = _native.quantize_rotations(*given, worth, lengths)
    return values, forms
