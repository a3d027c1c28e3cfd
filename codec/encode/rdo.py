"""Rate-distortion optimised quantization: integers that cost fewer bits where the picture hardly notices.

All choices minimise error + price * bits, where the error is the picture's mean squared error by the measured
sensitivities (render/sensitivity.py), and the price is the error that a bit saves where steps are right. Bits are
estimates: code lengths given the neighbours' prediction for keyframes, a fixed table for trajectories.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..bitstream.quantization import QUALITY_DEFAULT, error_for
from ..bitstream.transform import dct_basis

BIT_PRICE = 0.05  # of a bit, in units of the picture's error per Gaussian
TRAINED = 0.6  # of that where gscodec has trained the group: test views of stage and lumberjack say so
FLOOR = 0.2  # share of the mean sensitivity that all have: few views say little of one, and errors that agree add up
ZERO_BITS, NONZERO_BITS, LENGTH_BITS = (
    0.5,
    3.0,
    0.7,
)  # of a trajectory: coefficients 0 and +-1, one more temporal frequency
RANGE = 15  # integers and predictions beyond are counted together
NEAR, WINDOW = 4, 32  # contexts: so many nearest among so many before (spec 7.3)
NEAR_WEIGHT = np.array([4, 3, 2, 2])


def bit_price(error: float, count: int, trained: bool) -> float:
    """Mean squared error that one bit is worth in a group of `count` Gaussians whose target is `error`.

    Where gscodec has `trained` the group, and hands over its nodes, a rate term has dropped what is not worth its bits
    already: the finer the steps are, the less there is for a second look (lumberjack, quality 60: 4 % of the bytes).
    """
    left = TRAINED * min(1.0, error / error_for(QUALITY_DEFAULT)) if trained else 1.0
    return BIT_PRICE * left * error / max(count, 1)


def trajectory(values: np.ndarray, weights: np.ndarray, step: float, price: float) -> np.ndarray:
    """DCT coefficients of [T, N, C] floats that are worth their bits: [K, C, N] i32, K >= 1.

    Args:
        weights: [N, C] sensitivities. step: of the coefficients. price: of a bit.
    """
    frames, count, channels = values.shape
    c = ((dct_basis(frames) / step).astype(np.float32) @ values.reshape(frames, -1)).reshape(values.shape)
    # An error of one coefficient spreads over T frames.
    worth = (weights * (step * step / frames / price)).astype(np.float32)  # bits per squared unit
    least = np.sqrt((NONZERO_BITS - ZERO_BITS) / np.maximum(worth, 1e-12))
    some = np.flatnonzero((np.abs(c) > np.maximum(least, 0.5)).any((0, 2)))
    c, worth = c[:, some], worth[some]
    q = np.rint(c)
    gain = worth * q * (2 * c - q) - (NONZERO_BITS - ZERO_BITS) - 2 * np.log2(np.maximum(np.abs(q), 1))
    q[gain <= 0] = 0
    net = np.where(q != 0, gain, 0).sum(2) - channels * ZERO_BITS - LENGTH_BITS  # [T, n]
    total = np.cumsum(net, 0)
    length = np.where(total.max(0) > 0, total.argmax(0) + 1, 0)
    q[np.arange(frames)[:, None] >= length] = 0
    used = max(1, length.max(initial=0))
    out = np.zeros((used, channels, count), np.int32)
    out[:, :, some] = q[:used].transpose(0, 2, 1)
    return out


def trajectory_margins(q: np.ndarray, weights: np.ndarray, step: float, frames: int, price: float) -> np.ndarray:
    """[2, M, C], as of `margins`, of coefficients [M, C] of trajectories over so many frames, of sensitivities [M, C];
    step, price: as in `trajectory`."""
    bits = lambda q: np.where(q == 0, ZERO_BITS, NONZERO_BITS + 2 * np.log2(np.maximum(np.abs(q), 1)))  # noqa: E731
    worth = np.maximum(weights * (step * step / frames / price), 1e-12)
    return np.stack([np.clip((bits(q + d) - bits(q)) / (2 * worth), -0.4, 9) for d in (1, -1)]).astype(np.float32)


def layers_of(positions: np.ndarray, counts: list[int]) -> list[tuple[slice, np.ndarray]]:
    """Of each layer of so many Gaussians its span, and its `neighbours` ([n, 4], counted from its first)."""
    ends = np.cumsum([0, *counts])
    spans = [slice(a, b) for a, b in pairwise(ends)]
    return [(own, neighbours(positions[own])) for own in spans]


def neighbours(positions: np.ndarray) -> np.ndarray:
    """[N, 4] the nearest in space among the 32 Gaussians before each, as contexts see them; itself where none is."""
    p = positions.astype(np.float32)
    index = np.arange(len(p))
    distance = np.full((WINDOW, len(p)), np.inf, np.float32)
    for back in range(1, min(WINDOW, len(p) - 1) + 1):
        d = p[back:] - p[:-back]
        distance[back - 1, back:] = np.einsum("nc,nc->n", d, d)
    near = distance.argpartition(NEAR, 0)[:NEAR]
    near = np.take_along_axis(near, np.take_along_axis(distance, near, 0).argsort(0, kind="stable"), 0)
    return np.where(index - near - 1 >= 0, index - near - 1, index).T


def keyframe(x: np.ndarray, weights: np.ndarray, near: np.ndarray, price: float, passes: int = 2) -> np.ndarray:
    """Integers for `x` [N] floats in steps.

    Args:
        weights: [N] sensitivities, of an error of one step. near: of `neighbours`.
        price: of a bit.
    """
    q = np.rint(x)
    if not len(x):
        return q
    bits_worth = worth(weights, price)
    for _ in range(passes):
        context = _contexts(q, near)
        bits = _code_lengths(context, q)
        best, cost = q, np.full(len(x), np.inf)
        toward = np.sign(context - np.rint(x))
        for candidate in (np.rint(x), np.rint(x) + toward, np.rint(x) - np.sign(np.rint(x)), context, 0 * x):
            level = np.clip(candidate, -RANGE, RANGE).astype(int)
            c = bits_worth * (x - candidate) ** 2 + bits[context + RANGE, level + RANGE]
            c += 2 * np.log2(1 + np.maximum(np.abs(candidate) - RANGE, 0))
            best, cost = np.where(c < cost, candidate, best), np.minimum(c, cost)
        q = best
    return q


def margins(q: np.ndarray, weights: np.ndarray, near: np.ndarray, price: float) -> tuple[np.ndarray, np.ndarray]:
    """[N] how much farther than half a step above, and below, `q` ([N], of `keyframe`) still is the better integer,
    in steps: what the next one costs more. Other arguments are those of `keyframe`."""
    if not len(q):
        return q, q
    context = _contexts(q, near)
    bits = _code_lengths(context, q)[context + RANGE]
    level = np.clip(q, -RANGE, RANGE).astype(int) + RANGE
    each = np.arange(len(q))
    more = (bits[each, np.clip(level + d, 0, 2 * RANGE)] - bits[each, level] for d in (1, -1))
    up, down = (np.clip(m / (2 * worth(weights, price)), -0.4, 9) for m in more)
    return up, down


def code_lengths(q: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[2 RANGE + 1, 2 RANGE + 1] bits of an integer (column) in a context (row), each from -RANGE to RANGE, from the
    statistics of `q` [N]."""
    return _code_lengths(_contexts(q, near), q)


def worth(weights: np.ndarray, price: float) -> np.ndarray:
    """[N] bits that an error of one step is worth, squared."""
    return np.maximum(weights + FLOOR * weights.mean(), 1e-30) / price


def _contexts(q: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[N] int, what the neighbours of each say, from -RANGE to RANGE."""
    return np.clip(np.rint(q[near] @ (NEAR_WEIGHT / NEAR_WEIGHT.sum())), -RANGE, RANGE).astype(int)


def _code_lengths(context: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[2 RANGE + 1, 2 RANGE + 1] bits of an integer (column) in a context (row), from their statistics."""
    side = 2 * RANGE + 1
    level = np.clip(q, -RANGE, RANGE).astype(int)
    counts = np.bincount((context + RANGE) * side + level + RANGE, minlength=side * side).reshape(side, side)
    counts = counts + 20 * (counts.sum(0) + 0.02) / (counts.sum() + 1)  # rare contexts: as all of them together
    return -np.log2(counts / counts.sum(1, keepdims=True))
