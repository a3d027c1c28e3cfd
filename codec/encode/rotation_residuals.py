"""Rotations: each is coded as the turn from the decoded one of its nearest neighbour (spec 13.1), about its own axes.

Where a surface is smooth its Gaussians lie alike, so turns are small where rotations are not. About the longest axis a
turn hardly shows, and about the others the more the longer the Gaussian is: the steps of a Gaussian follow from its
decoded sizes, by levers that are fitted to the measured sensitivities of the group.
"""

from __future__ import annotations

import numpy as np

from .. import _native
from . import rdo
from .axis_order import quat_conjugate, quat_multiply

LEVER_UNIT = 32  # of the bitstream
FARTHEST = 64.0  # octaves
SHARE = 0.5  # of the sensitivity's octaves that steps follow
LEAST = 100  # Gaussians from which levers can be fitted
DOUBT = 0.02  # of the mean sensitivity that all have: few views say little of one


def fit_levers(log_scales: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[3, 3] i32, how much the step of each channel falls with each size: log_scales and sensitivities are [N, 3]."""
    if len(weights) < LEAST:
        return np.zeros((3, 3), np.int32)
    sizes = np.column_stack([np.ones(len(log_scales)), log_scales])
    octaves = np.log2(weights + DOUBT * weights.mean(0) + 1e-30)
    slopes = np.linalg.lstsq(sizes, octaves, rcond=None)[0][1:].T
    return np.rint(LEVER_UNIT * SHARE * slopes).clip(-128, 127).astype(np.int32)


def widths(log_scales: np.ndarray, levers: np.ndarray) -> np.ndarray:
    """[N, 3] by what the steps of the channels are multiplied for each Gaussian."""
    octaves = -(log_scales @ (np.asarray(levers, np.float32).T / LEVER_UNIT))
    return np.exp2(octaves.clip(-FARTHEST, FARTHEST))


def code_turns(
    quats: np.ndarray,
    log_scales: np.ndarray,
    positions: np.ndarray,
    channel: dict,
    layers: list[tuple],
    shifts: np.ndarray,
    weights: np.ndarray | None = None,
    price: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Integers of quats [3, N] i32, and the form [N] of each Gaussian (`in_form`).

    Args:
        quats: [N, 4] with axes by falling scale. log_scales: [N, 3] decoded. positions: [N, 3] u32.
        channel: "steps" and "levers" of the channels.
        layers: of each its Gaussians, in Morton order, and their neighbours (`rdo.neighbours`; not without weights).
        shifts: [N] low bits that are left out.
        weights: [N, 3] sensitivities by turns about the own axes; None: integers are the nearest.
        price: of a bit.
    """
    steps = np.minimum(np.array(channel["steps"]) * widths(log_scales, channel["levers"]), 1) * 2.0 ** shifts[:, None]
    steps, quats = np.ascontiguousarray(steps, np.float32), np.ascontiguousarray(quats, np.float32)
    values, forms = np.zeros((3, len(quats)), np.int32), np.zeros(len(quats), np.uint8)
    for own, near in layers:
        given = (quats[own], steps[own], positions[own])
        worth, lengths = np.zeros_like(steps[own]), np.zeros(0, np.float32)
        if weights is not None and len(given[0]):
            first = _native.code_turns(*given, worth, lengths)[0]
            lengths = np.stack([rdo.code_lengths(q, near) for q in first.T]).astype(np.float32).ravel()
            worth = np.stack([rdo.worth(w, price) for w in (weights[own] * steps[own] ** 2).T], 1).astype(np.float32)
        integers, forms[own] = _native.code_turns(*given, worth, lengths)
        values[:, own] = integers.T << shifts[own]
    return values, forms


def in_form(quats: np.ndarray, forms: np.ndarray) -> np.ndarray:
    """Quaternions [..., N, 4] in the forms [N] that were coded."""
    return quat_multiply(quats, quat_conjugate(np.eye(4, dtype=quats.dtype))[forms])
