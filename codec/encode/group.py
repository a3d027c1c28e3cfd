"""Floats to integers: one group of Gaussians -> the integer maps that `_native.encode_group` turns into bytes.

Stages: prune what nobody sees, choose each Gaussian's canonical form, quantize the canonical frame (its positions give
the order), fit the motion to the *decoded* canonical frame, quantize what motion leaves over. Every later stage works
on the values that the decoder will have, so errors do not add up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gscodec import _native
from gscodec.bitstream.color import decorrelate
from gscodec.bitstream.quantization import error_for, steps_for, subject_radius, trajectory_step
from gscodec.camera import Camera
from gscodec.encode import rdo
from gscodec.encode.canonical import canonical_axes, quat_conjugate, quat_multiply
from gscodec.encode.importance import Importance, measure, steps_for_error
from gscodec.encode.motion import NEIGHBORS, NodeMotion, carry, choose_nodes
from gscodec.gaussians import Gaussians, Group

GRID_BITS_MAX = 21
PRUNE = 0.3  # a Gaussian goes if the picture without it errs by less than this share of the error per coded Gaussian


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

    def frame(self, t: int) -> Gaussians:
        """All Gaussians as they are at frame `t`."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Gaussians(*(a[t] for a in arrays))


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


def align_axes(s: Stack, middle: int) -> Stack:
    """Every Gaussian in the form of `canonical_axes`, the same choice in all frames, quaternions continuous in time."""
    turn, order = canonical_axes(s.quats[middle], s.log_scales[middle])
    quats = quat_multiply(s.quats, turn[None].astype(np.float32))
    quats[middle] *= np.where(quats[middle, :, :1] < 0, -1, 1)
    for t in [*range(middle + 1, len(quats)), *range(middle - 1, -1, -1)]:
        before = quats[t - 1] if t > middle else quats[t + 1]
        quats[t] *= np.where(np.einsum("nc,nc->n", quats[t], before) < 0, -1, 1).astype(np.float32)[:, None]
    scales = np.take_along_axis(s.log_scales, order[None], 2)
    return Stack(s.means, quats, scales, s.logit_opacities, s.sh0, s.shN, s.lifetimes)


def quantize_channels(
    values: np.ndarray, steps: np.ndarray, weights: np.ndarray, near: np.ndarray, price: float
) -> dict:
    """[N, C] floats -> channels of `encode_group`; offsets are the medians, so that small integers are common."""
    offsets = np.median(values, axis=0) if len(values) else np.zeros(values.shape[1])
    offsets = offsets.astype(np.float32)
    x = (values - offsets) / steps
    q = [rdo.keyframe(x[:, c], weights[:, c] * steps[c] ** 2, near, price) for c in range(len(steps))]
    return {"values": np.array(q).astype(np.int32), "steps": steps.tolist(), "offsets": offsets.tolist()}


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


def _rest_pose(s: Stack, x: np.ndarray, motion: NodeMotion | None) -> tuple[np.ndarray, np.ndarray]:
    """Means [N, 3] and quaternions [N, 4] that the nodes carry nearest to all frames, from positions x [N, 3] that they
    carry already: what jitters in one frame is not the canonical of all."""
    if motion is None:
        turned_back, left = s.quats, s.means - x[None].astype(np.float32)
    else:
        back = quat_conjugate(motion.turned)
        turned_back, left = quat_multiply(back, s.quats), _rotate(back, s.means - motion.carried)
    quats = turned_back.mean(0)
    return x + left.mean(0), quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[..., 3] vectors turned by unit quaternions [..., 4]."""
    u = np.cross(q[..., 1:], v)
    return v + 2 * (q[..., :1] * u + np.cross(q[..., 1:], u))


def _residual(s: Stack, channels: dict, x: np.ndarray, motion: NodeMotion | None) -> dict[str, np.ndarray]:
    """[T, N, C] f32 of each attribute: what canonical values and nodes leave over."""
    v = dequantize_channels(channels["quats"])
    canonical = np.concatenate([np.sqrt(np.maximum(0, 1 - (v**2).sum(1, keepdims=True))), v], 1)
    dq = quat_multiply(s.quats, quat_conjugate(canonical[None].astype(np.float32)))
    if motion is not None:
        dq = quat_multiply(dq, quat_conjugate(motion.turned))
    residual = {
        "means": s.means - (x[None].astype(np.float32) if motion is None else motion.carried),
        "quats": np.copysign(1, dq[..., :1]) * dq[..., 1:],
    }
    for name, values in _appearance(s).items():
        residual[name] = values - dequantize_channels(channels[name])[None].astype(np.float32)
    return residual


def group_integers(group: Group, quality: float, *, keep_all: bool = False, cameras: list[Camera] = ()) -> dict:
    """Integer form of a group, the input of `_native.encode_group`.

    Args:
        group: T >= 1 frames of N Gaussians.
        quality: 0 to 100.
        keep_all: code every Gaussian, also the invisible ones.
        cameras: from which the subject was captured, if it was.
    """
    s = stack_group(group)
    frames, middle = len(s.means), len(s.means) // 2
    s = align_axes(s, middle)
    s, importance, radius = _shown(s, middle, quality, keep_all, cameras)
    steps = _steps(s, importance, middle, quality, radius)
    grid = Grid(s.means[middle], float(steps["means"][0]))
    positions = grid.to_integers(s.means[middle])
    order = _native.morton_order(positions)
    positions, s, importance = positions[order], s.take(order), importance.take(order)
    nodes, quats = None, s.quats[middle]
    if frames > 1 and len(positions):
        x = grid.to_world(positions)
        nodes = choose_nodes(
            positions, x, s.means, grid.step, steps_for(quality, radius).node_translation, grid.to_world
        )
        x, quats = _rest_pose(s, x, nodes and carry(nodes, positions, x, frames))
        positions = grid.to_integers(x)
        order = _native.morton_order(positions)
        positions, s, importance, quats = positions[order], s.take(order), importance.take(order), quats[order]
    near, price = rdo.neighbours(positions), rdo.bit_price(error_for(quality), max(len(positions), 1))
    values = {n: v.mean(0, dtype=np.float64) for n, v in _appearance(s).items()} | {"quats": quats[:, 1:]}
    channels = {n: quantize_channels(v, steps[n], importance.weights[n], near, price) for n, v in values.items()}
    channels["quats"] = _inside_unit_ball(channels["quats"])
    out = {
        "frames": frames,
        "origin": grid.origin.tolist(),
        "grid_step": grid.step,
        "grid_bits": grid.bits,
        "positions": positions,
        "channels": channels,
        "trajectories": {},
    }
    if s.lifetimes is not None:
        out["lifetimes"] = s.lifetimes.astype(np.uint16)
    if frames == 1 or len(positions) == 0:
        return out
    if nodes is not None:
        out["nodes"] = {
            "positions": nodes.positions,
            "coefficients": nodes.coefficients,
            "rotation_step": nodes.rotation_step,
            "translation_step": nodes.translation_step,
            "neighbors": min(NEIGHBORS, len(nodes.positions)),
        }
    x = grid.to_world(positions)
    residual = _residual(s, channels, x, nodes and carry(nodes, positions, x, frames))
    for name, values in residual.items():
        step = trajectory_step(1 / np.sqrt((1 / steps[name].astype(np.float64) ** 2).mean()), frames)
        coefficients = rdo.trajectory(values, importance.weights[name], step, price)
        if coefficients.any():
            out["trajectories"][name] = {"coefficients": coefficients, "step": step}
    return out


def _shown(s: Stack, middle: int, quality: float, keep_all: bool, cameras) -> tuple[Stack, Importance, float]:
    """The Gaussians to code, what each matters, and the radius of the subject."""
    radius, count = subject_radius(s.means[middle]), s.means.shape[1]
    if not count:
        sizes = {"means": 3, "quats": 3} | {n: v.shape[2] for n, v in _appearance(s).items()}
        return s, Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros(0)), radius
    importance = measure([s.frame(t) for t in sorted({0, middle, len(s.means) - 1})], cameras)
    if not keep_all:
        keep = importance.removal * count >= PRUNE * error_for(quality)
        s, importance = s.take(keep), importance.take(keep)
    return s, importance, radius


def _steps(s: Stack, importance: Importance, middle: int, quality: float, radius: float) -> dict[str, np.ndarray]:
    """[C] f32 step of each channel of each attribute."""
    if not len(importance.removal):
        nominal = steps_for(quality, radius)
        return {n: np.full(w.shape[1], getattr(nominal, n), np.float32) for n, w in importance.weights.items()}
    values = {n: v[middle] for n, v in _appearance(s).items()}
    values |= {"means": s.means[middle], "quats": s.quats[middle, :, 1:]}
    return steps_for_error(importance.weights, values, error_for(quality), radius)


def _inside_unit_ball(channels: dict) -> dict:
    """Rounding may leave the unit ball; pull such vector parts back by one step per component, towards zero."""
    v = dequantize_channels(channels)
    outside = (v**2).sum(1) > 1
    values = channels["values"].copy()
    values[:, outside] -= np.sign(v[outside].T).astype(np.int32)
    return {**channels, "values": values}
