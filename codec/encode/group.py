"""Floats to integers: one group of Gaussians -> the integer maps that `_native.encode_group` turns into bytes.

Stages: prune what nobody sees, choose each Gaussian's canonical form, quantize the canonical frame (its positions give
the order), fit the motion to the *decoded* canonical frame, quantize what motion leaves over. Every later stage works
on the values that the decoder will have, so errors do not add up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gscodec import _native
from gscodec.bitstream.color import STEP_WEIGHTS, decorrelate
from gscodec.bitstream.quantization import Steps, steps_for, subject_radius, trajectory_step
from gscodec.bitstream.transform import dct_basis
from gscodec.encode.canonical import canonical_axes, quat_conjugate, quat_multiply
from gscodec.encode.motion import NEIGHBORS, NodeMotion, choose_nodes, quantize_trajectory, trim
from gscodec.gaussians import Group

GRID_BITS_MAX = 21
ALPHA_MIN = 1 / 255  # what the renderer does not draw (spec: "The picture")
PRUNE_SHARE = 5e-4  # share of opacity x area that may go; 8 % of the statue's Gaussians hold less
DEAD_ZONE = 0.6  # in steps; jitter of a trainer stays below it


@dataclass(frozen=True)
class Stack:
    """All frames of a group as arrays, T first; values outside a lifetime repeat the nearest frame inside."""

    means: np.ndarray  # [T, N, 3]
    quats: np.ndarray  # [T, N, 4]
    log_scales: np.ndarray  # [T, N, 3]
    logit_opacities: np.ndarray  # [T, N]
    sh0: np.ndarray  # [T, N, 3]
    shN: np.ndarray  # [T, N, K, 3]
    lifetimes: np.ndarray | None  # [N, 2]

    def take(self, index: np.ndarray) -> Stack:
        """The Gaussians at `index`, in that order."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Stack(*(a[:, index] for a in arrays), None if self.lifetimes is None else self.lifetimes[index])


def stack_group(group: Group) -> Stack:
    """Loads all frames of `group` (f32)."""
    frames = [group.frames[t] for t in range(len(group))]
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    arrays = [np.stack([getattr(f, n) for f in frames]) for n in names]
    life = group.lifetimes
    if life is not None:
        held = np.clip(np.arange(len(frames))[:, None], life[:, 0], life[:, 1] - 1)  # [T, N]
        arrays = [a[held, np.arange(len(life))] for a in arrays]
    return Stack(*arrays, life)


def importance(s: Stack) -> np.ndarray:
    """[N] f64, opacity times the area of the two longest axes, in the frame where it is largest."""
    opacity = 1 / (1 + np.exp(-s.logit_opacities))
    largest_two = s.log_scales.sum(2) - s.log_scales.min(2)
    return (opacity * np.exp(largest_two)).max(0).astype(np.float64)


def ever_drawn(s: Stack) -> np.ndarray:
    """[N] bool: in some frame opaque enough for the renderer."""
    return 1 / (1 + np.exp(-s.logit_opacities.max(0))) >= ALPHA_MIN


def visible_enough(s: Stack, share: float = PRUNE_SHARE) -> np.ndarray:
    """[N] bool: false for Gaussians that are never drawn, and for the least important that together hold `share`."""
    weight = importance(s)
    order = weight.argsort()
    spent = np.cumsum(weight[order])
    keep = np.empty(len(order), bool)
    keep[order] = spent > share * spent[-1] if len(order) else True
    return keep & ever_drawn(s)


def align_axes(s: Stack, middle: int, turn: np.ndarray, order: np.ndarray) -> Stack:
    """Every Gaussian in the form that `canonical_axes` chose, in all frames, quaternions continuous in time."""
    quats = quat_multiply(s.quats, turn[None].astype(np.float32))
    quats[middle] *= np.where(quats[middle, :, :1] < 0, -1, 1)
    for t in [*range(middle + 1, len(quats)), *range(middle - 1, -1, -1)]:
        before = quats[t - 1] if t > middle else quats[t + 1]
        quats[t] *= np.where(np.einsum("nc,nc->n", quats[t], before) < 0, -1, 1).astype(np.float32)[:, None]
    scales = np.take_along_axis(s.log_scales, order[None], 2)
    return Stack(s.means, quats, scales, s.logit_opacities, s.sh0, s.shN, s.lifetimes)


def channel_steps(name: str, steps: Steps, channels: int) -> np.ndarray:
    """[C] f32 step of each channel of an attribute."""
    step = np.full(channels, getattr(steps, name))
    if name in ("sh0", "shN"):
        step *= np.tile(STEP_WEIGHTS, channels // 3)
    return step.astype(np.float32)


def quantize_channels(values: np.ndarray, steps: np.ndarray) -> dict:
    """[N, C] floats -> channels of `encode_group`; offsets are the medians, so that small integers are common."""
    offsets = np.median(values, axis=0) if len(values) else np.zeros(values.shape[1])
    offsets = offsets.astype(np.float32)
    q = np.rint((values - offsets) / steps).astype(np.int32)
    return {"values": np.ascontiguousarray(q.T), "steps": steps.tolist(), "offsets": offsets.tolist()}


def dequantize_channels(channels: dict) -> np.ndarray:
    """[N, C] f64, what the decoder makes of `quantize_channels`."""
    steps, offsets = (np.array(channels[k], np.float32) for k in ("steps", "offsets"))
    return (offsets + steps * channels["values"].T.astype(np.float32)).astype(np.float64)


class Grid:
    """The integer lattice of positions: origin and step of the group."""

    def __init__(self, means: np.ndarray, step: float):
        low = means.min(0) if len(means) else np.zeros(3)
        extent = float((means.max(0) - low).max()) if len(means) else 0.0
        step = max(step, extent / (2**GRID_BITS_MAX - 2))  # far floaters: coarser rather than an error
        self.step = float(np.float32(step))
        self.origin = low.astype(np.float32)
        self.bits = max(1, int(np.ceil(extent / self.step + 1)).bit_length())

    def to_integers(self, means: np.ndarray) -> np.ndarray:
        """[N, 3] world -> [N, 3] u32."""
        q = np.rint((means - self.origin) / self.step)
        return np.clip(q, 0, 2**self.bits - 1).astype(np.uint32)

    def to_world(self, integers: np.ndarray) -> np.ndarray:
        """[N, 3] u32 -> [N, 3] f64 world."""
        return self.origin.astype(np.float64) + self.step * integers.astype(np.float64)


def _appearance(s: Stack) -> dict[str, np.ndarray]:
    """[T, N, C] f32 of each attribute that only adds up over time."""
    frames, n, k, _ = s.shN.shape
    arrays = {
        "log_scales": s.log_scales,
        "logit_opacities": s.logit_opacities[..., None],
        "sh0": decorrelate(s.sh0),
    }
    if k:
        arrays["shN"] = decorrelate(s.shN).reshape(frames, n, 3 * k)
    return arrays


def _rotation_residual(quats: np.ndarray, canonical: np.ndarray, motion: NodeMotion | None) -> np.ndarray:
    """[T, N, 3] f32, vector part of what is left after nodes and canonical: dq = q(t) (q_blend(t) q_canonical)^-1."""
    dq = quat_multiply(quats, quat_conjugate(canonical[None].astype(np.float32)))
    if motion is not None:
        dq = quat_multiply(dq, quat_conjugate(motion.turned))
    return np.copysign(1, dq[..., :1]) * dq[..., 1:]


def _trajectories(s: Stack, channels: dict, steps: Steps, x: np.ndarray, motion: NodeMotion | None) -> dict:
    basis = dct_basis(len(s.means))
    canonical_v = dequantize_channels(channels["quats"])
    w = np.sqrt(np.maximum(0, 1 - (canonical_v**2).sum(1, keepdims=True)))
    canonical = np.concatenate([w, canonical_v], 1)
    residual = {
        "means": s.means - (x[None].astype(np.float32) if motion is None else motion.carried),
        "quats": _rotation_residual(s.quats, canonical, motion),
    }
    for name, values in _appearance(s).items():
        residual[name] = values - dequantize_channels(channels[name])[None].astype(np.float32)
    out = {}
    for name, values in residual.items():
        size = trajectory_step(channel_steps(name, steps, values.shape[2])[0], len(basis))
        c = trim(quantize_trajectory(values, basis, size, DEAD_ZONE)).transpose(0, 2, 1)  # [K, C, N]
        if c.any():
            out[name] = {"coefficients": np.ascontiguousarray(c), "step": size}
    return out


@dataclass(frozen=True)
class Coded:
    """A group in integers, with what is needed to predict another from it.

    Attributes:
        integers: the input of `_native.encode_group`.
        source: [N] int, index in the group of each Gaussian that is coded, in the order of the integers.
        turn, order: [N, 4], [N, 3], the form of each (`canonical_axes`).
    """

    integers: dict
    source: np.ndarray
    turn: np.ndarray
    order: np.ndarray
    grid: Grid
    steps: Steps


def code_group(
    group: Group, quality: float, *, keep_all: bool = False, steps: Steps | None = None, layers: int = 1
) -> Coded:
    """An independent group in integers.

    Args:
        group: T >= 1 frames of N Gaussians.
        quality: 0 to 100.
        keep_all: code every Gaussian, also the invisible ones.
        steps: instead of those that follow from `quality`.
        layers: number of layers of falling importance, each as large as all before it together.
    """
    s = stack_group(group)
    kept = np.arange(len(s.means[0]))
    if not keep_all and len(kept):
        kept = np.flatnonzero(visible_enough(s))
        s = s.take(kept)
    middle = len(s.means) // 2
    steps = steps or steps_for(quality, subject_radius(s.means[middle]))
    grid = Grid(s.means[middle], steps.means)
    positions = grid.to_integers(s.means[middle])
    order = _native.morton_order(positions)
    layer = layer_of(importance(s)[order], layers)
    order = order[layer.argsort(kind="stable")]
    positions, s = positions[order], s.take(order)
    turn, axes = canonical_axes(s.quats[middle], s.log_scales[middle])
    s = align_axes(s, middle, turn, axes)
    values = canonical_appearance(s)
    values["quats"] = s.quats[middle, :, 1:]
    channels = {n: quantize_channels(v, channel_steps(n, steps, v.shape[1])) for n, v in values.items()}
    channels["quats"] = inside_unit_ball(channels["quats"])
    out = {
        "frames": len(s.means),
        "origin": grid.origin.tolist(),
        "grid_step": grid.step,
        "grid_bits": grid.bits,
        "layers": np.bincount(layer, minlength=layers).tolist(),
        "positions": positions,
        "channels": channels,
        "trajectories": {},
    }
    if s.lifetimes is not None:
        out["lifetimes"] = s.lifetimes.astype(np.uint16)
    if len(s.means) > 1 and len(positions):
        x = grid.to_world(positions)
        out |= motion_integers(s, channels, steps, x, choose_nodes(positions, x, s.means, steps, grid.to_world))
    return Coded(out, kept[order], turn, axes, grid, steps)


def group_integers(group: Group, quality: float, **options) -> dict:
    """The integers of `code_group`."""
    return code_group(group, quality, **options).integers


def layer_of(weight: np.ndarray, layers: int) -> np.ndarray:
    """[N] int, layer of each Gaussian of importance `weight` [N]: the most important 1 / 2^(layers - 1) are layer 0."""
    share = np.empty(len(weight))  # of Gaussians that are more important
    share[weight.argsort()[::-1]] = np.arange(len(weight)) / max(len(weight), 1)
    return np.searchsorted(0.5 ** np.arange(layers - 1, 0, -1), share, side="right")


def canonical_appearance(s: Stack) -> dict[str, np.ndarray]:
    """[N, C] f64 of each attribute that only adds up over time: the mean over the frames."""
    return {n: v.mean(0, dtype=np.float64) for n, v in _appearance(s).items()}


def motion_integers(s: Stack, channels: dict, steps: Steps, x: np.ndarray, motion: NodeMotion | None) -> dict:
    """ "nodes" and "trajectories" of a group with canonical positions x [N, 3] and channels."""
    out = {"trajectories": _trajectories(s, channels, steps, x, motion)}
    if motion is not None:
        out["nodes"] = {
            "positions": motion.nodes.positions,
            "coefficients": motion.nodes.coefficients,
            "rotation_step": motion.nodes.rotation_step,
            "translation_step": motion.nodes.translation_step,
            "neighbors": min(NEIGHBORS, len(motion.nodes.positions)),
        }
    return out


def inside_unit_ball(channels: dict) -> dict:
    """Rounding may leave the unit ball; pull such vector parts back by one step per component, towards zero."""
    v = dequantize_channels(channels)
    outside = (v**2).sum(1) > 1
    values = channels["values"].copy()
    values[:, outside] -= np.sign(v[outside].T).astype(np.int32)
    return {**channels, "values": values}
