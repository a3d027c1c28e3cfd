"""Rate-distortion optimised quantization: integers that cost fewer bits where the image hardly changes.

All choices minimise error + price * bits. The error is the mean squared error of the image by the measured
sensitivities (render/sensitivity.py); the price is the error that a bit saves where steps are right. Bits are
estimates: code lengths given the neighbours' prediction for canonical integers, a fixed table for trajectories.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from .. import _native
from ..bitstream.quantization import QUALITY_DEFAULT, error_for
from .settings import RdoSettings

RANGE = 15  # larger integers and predictions are counted together; as in `_native.quantize_rotations`
NEAR_WEIGHT = np.array([4, 3, 2, 2])  # weights of the context's neighbours (spec 7.3)

Layer = tuple[slice, np.ndarray]  # span of Gaussians that a layer codes itself, [n, 4] neighbours by index within it


def bit_price(error: float, count: int, rate_optimized: bool, settings: RdoSettings) -> float:
    """Mean squared error that one bit is worth in a group of `count` Gaussians whose target is `error`.

    A rate term in training has already dropped data that is not worth its bits: the finer the steps are, the less
    remains to drop here (lumberjack, quality 60: 4 % of the bytes).
    """
    left = settings.optimized_price * min(1.0, error / error_for(QUALITY_DEFAULT)) if rate_optimized else 1.0
    return settings.bit_price * left * error / max(count, 1)


def quantize_trajectories(
    c: np.ndarray, weights: np.ndarray, frames: int, price: float, settings: RdoSettings
) -> np.ndarray:
    """Integers for DCT coefficients that are worth their bits: [K', C, N] i32, 1 <= K' <= K.

    Args:
        c: [K, C, N] f32 coefficients in steps.
        weights: [N, C] sensitivities to an error of one step in all frames.
        frames: of the group.
        price: of a bit.
    """
    zero, nonzero = settings.zero_bits, settings.nonzero_bits
    worth = (weights.T / frames / price).astype(np.float32)  # [C, N] bits per squared step: an error spreads over T
    least = np.sqrt((nonzero - zero) / np.maximum(worth, 1e-12))
    some = np.flatnonzero((np.abs(c) > np.maximum(least, 0.5)).any((0, 1)))
    c, worth = c[:, :, some], worth[:, some]
    q = np.rint(c)
    gain = worth * q * (2 * c - q) - (nonzero - zero) - 2 * np.log2(np.maximum(np.abs(q), 1))
    q[gain <= 0] = 0
    net = np.where(q != 0, gain, 0).sum(1) - c.shape[1] * zero - settings.length_bits  # [K, n]
    total = np.cumsum(net, 0)
    length = np.where(total.max(0, initial=0) > 0, total.argmax(0) + 1, 0) if len(some) else np.zeros(0, int)
    q *= (np.arange(len(c))[:, None] < length)[:, None]
    used = max(1, length.max(initial=0))
    out = np.zeros((used, c.shape[1], weights.shape[0]), np.int32)
    out[:, :, some] = q[:used]
    return out


def trajectory_thresholds(
    q: np.ndarray, weights: np.ndarray, frames: int, price: float, settings: RdoSettings
) -> np.ndarray:
    """[2, M, C], as `decision_thresholds`, for trajectory coefficients [M, C] with sensitivities [M, C] in steps;
    frames, price: as in `quantize_trajectories`."""

    def bits(q):
        return np.where(q == 0, settings.zero_bits, settings.nonzero_bits + 2 * np.log2(np.maximum(np.abs(q), 1)))

    worth = np.maximum(weights / frames / price, 1e-12)
    found = [np.clip((bits(q + d) - bits(q)) / (2 * worth), *settings.threshold_range) for d in (1, -1)]
    return np.stack(found).astype(np.float32)


def coded_layers(positions: np.ndarray, counts: list[int], births: list[int]) -> list[Layer]:
    """Gaussians that each layer codes itself: the last `births` of its `counts` Gaussians, in Morton order."""
    ends = np.cumsum([0, *counts])
    spans = [slice(b - born, b) for (_, b), born in zip(pairwise(ends), births, strict=True)]
    return [(own, _native.context_neighbors(np.ascontiguousarray(positions[own]))) for own in spans]


def quantize_canonical(
    x: np.ndarray, weights: np.ndarray, near: np.ndarray, price: float, settings: RdoSettings
) -> np.ndarray:
    """Integers for `x` [N] floats in steps.

    Args:
        weights: [N] sensitivities to an error of one step.
        near: [N, 4] neighbours.
        price: of a bit.
    """
    q = np.rint(x)
    if not len(x):
        return q
    bits_worth = lambda_cost(weights, price, settings)
    for _ in range(settings.passes):
        context = _contexts(q, near)
        bits = _code_lengths(context, q, settings)
        best, cost = q, np.full(len(x), np.inf)
        toward = np.sign(context - np.rint(x))
        for candidate in (np.rint(x), np.rint(x) + toward, np.rint(x) - np.sign(np.rint(x)), context, 0 * x):
            level = np.clip(candidate, -RANGE, RANGE).astype(int)
            c = bits_worth * (x - candidate) ** 2 + bits[context + RANGE, level + RANGE]
            c += 2 * np.log2(1 + np.maximum(np.abs(candidate) - RANGE, 0))
            best, cost = np.where(c < cost, candidate, best), np.minimum(c, cost)
        q = best
    return q


def decision_thresholds(
    q: np.ndarray, weights: np.ndarray, near: np.ndarray, price: float, settings: RdoSettings
) -> tuple[np.ndarray, np.ndarray]:
    """[N] each: distance beyond half a step, above and below, up to which `q` ([N]) still is the better integer, in
    steps, since the next one costs more bits. Other arguments are those of `quantize_canonical`."""
    if not len(q):
        return q, q
    context = _contexts(q, near)
    bits = _code_lengths(context, q, settings)[context + RANGE]
    level = np.clip(q, -RANGE, RANGE).astype(int) + RANGE
    each = np.arange(len(q))
    more = (bits[each, np.clip(level + d, 0, 2 * RANGE)] - bits[each, level] for d in (1, -1))
    cost = 2 * lambda_cost(weights, price, settings)
    up, down = (np.clip(m / cost, *settings.threshold_range) for m in more)
    return up, down


def code_lengths(q: np.ndarray, near: np.ndarray, settings: RdoSettings) -> np.ndarray:
    """[2 RANGE + 1, 2 RANGE + 1] bits of an integer (column) in a context (row), each from -RANGE to RANGE, from the
    statistics of `q` [N]."""
    return _code_lengths(_contexts(q, near), q, settings)


def lambda_cost(weights: np.ndarray, price: float, settings: RdoSettings) -> np.ndarray:
    """[N] bits that a squared error of one step is worth."""
    return np.maximum(weights + settings.floor * weights.mean(), 1e-30) / price


def _contexts(q: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[N] int, prediction of each from its neighbours, from -RANGE to RANGE."""
    return np.clip(np.rint(q[near] @ (NEAR_WEIGHT / NEAR_WEIGHT.sum())), -RANGE, RANGE).astype(int)


def _code_lengths(context: np.ndarray, q: np.ndarray, settings: RdoSettings) -> np.ndarray:
    """[2 RANGE + 1, 2 RANGE + 1] bits of an integer (column) in a context (row), from their statistics."""
    side = 2 * RANGE + 1
    level = np.clip(q, -RANGE, RANGE).astype(int)
    counts = np.bincount((context + RANGE) * side + level + RANGE, minlength=side * side).reshape(side, side)
    # A rare context has the statistics of all contexts together.
    counts = counts + settings.context_prior * (counts.sum(0) + 0.02) / (counts.sum() + 1)
    return -np.log2(counts / counts.sum(1, keepdims=True))
