"""A figure of 16 joints that walks, bends and waves, as splats with its rig, like a scan of a person with a skeleton.

The skin is capsules around bones. Each point blends the joints smoothly (linear blend skinning), and also breathes and
sways by a few millimetres, independently of the joints. Equal arguments give equal values.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.rig import Rig, RigMotion
from gscodec.model.rotations import quat_multiply, quat_normalize
from gscodec.model.skin_weights import integer_weights

# joint: (parent, place in metres, radius of the skin around the bone to its parent)
SKELETON = {
    "pelvis": (None, (0, 1.0, 0), 0.13),
    "spine": ("pelvis", (0, 1.2, 0), 0.13),
    "chest": ("spine", (0, 1.42, 0), 0.15),
    "head": ("chest", (0, 1.72, 0), 0.10),
    "shoulder.l": ("chest", (0.2, 1.45, 0), 0.07),
    "elbow.l": ("shoulder.l", (0.46, 1.45, 0), 0.055),
    "hand.l": ("elbow.l", (0.7, 1.45, 0), 0.045),
    "shoulder.r": ("chest", (-0.2, 1.45, 0), 0.07),
    "elbow.r": ("shoulder.r", (-0.46, 1.45, 0), 0.055),
    "hand.r": ("elbow.r", (-0.7, 1.45, 0), 0.045),
    "hip.l": ("pelvis", (0.11, 0.92, 0), 0.1),
    "knee.l": ("hip.l", (0.12, 0.5, 0), 0.08),
    "foot.l": ("knee.l", (0.12, 0.08, 0), 0.06),
    "hip.r": ("pelvis", (-0.11, 0.92, 0), 0.1),
    "knee.r": ("hip.r", (-0.12, 0.5, 0), 0.08),
    "foot.r": ("knee.r", (-0.12, 0.08, 0), 0.06),
}
NAMES = list(SKELETON)
JOINTS = np.array([place for _, place, _ in SKELETON.values()], np.float32)
PARENTS = np.array([NAMES.index(p or "pelvis") for p, _, _ in SKELETON.values()], np.uint8)
SWAY = 0.004  # metres, motion of the skin that no joint causes


@dataclass(frozen=True)
class Figure:
    """A sequence of splats and its rig."""

    sequence: GaussianSequence
    rig: Rig


def walk(frames: int, fps: float = 25.0) -> np.ndarray:
    """[T, J, 6] poses: a step a second, arms that swing, a bow."""
    t = np.arange(frames) / fps
    phase, poses = 2 * np.pi * t, np.zeros((frames, len(NAMES), 6), np.float32)

    def turn(name: str, axis: int, angle: np.ndarray) -> None:
        poses[:, NAMES.index(name), axis] += angle.astype(np.float32)

    for side, sign in (("l", 1.0), ("r", -1.0)):
        swing = sign * np.sin(phase)
        turn(f"hip.{side}", 0, -0.6 * swing)
        turn(f"knee.{side}", 0, 0.5 + 0.5 * np.cos(phase + sign * np.pi / 2))
        turn(f"shoulder.{side}", 2, sign * -1.2 + 0 * t)  # arms hang
        turn(f"shoulder.{side}", 0, 0.6 * swing)
        turn(f"elbow.{side}", 1, sign * (-0.6 + 0.4 * np.sin(phase + 1)))
    turn("spine", 0, 0.35 * (1 - np.cos(phase / 2)) / 2)
    turn("chest", 1, 0.25 * np.sin(phase))
    turn("head", 1, 0.5 * np.sin(phase / 2 + 1))
    turn("pelvis", 1, 0.3 * np.sin(phase / 4))
    poses[:, 0, 3:] = np.stack([0.1 * np.sin(phase), 0.03 * np.cos(2 * phase), 0.5 * t], 1)
    return poses


def wave(frames: int, fps: float = 25.0) -> np.ndarray:
    """[T, J, 6] other poses: arms up and waving, on the spot, turning round."""
    t = np.arange(frames) / fps
    phase, poses = 2 * np.pi * t, np.zeros((frames, len(NAMES), 6), np.float32)
    for side, sign in (("l", 1.0), ("r", -1.0)):
        poses[:, NAMES.index(f"shoulder.{side}"), 2] = sign * (0.7 + 0.3 * np.sin(phase))
        poses[:, NAMES.index(f"elbow.{side}"), 2] = sign * (0.5 + 0.4 * np.sin(2 * phase))
        poses[:, NAMES.index(f"hip.{side}"), 2] = sign * 0.25
    poses[:, NAMES.index("spine"), 2] = 0.2 * np.sin(phase)
    poses[:, 0, 1] = np.pi * t / 2
    return poses


def skin(count: int, seed: int = 0) -> tuple[Gaussians, np.ndarray]:
    """`count` Gaussians on capsules around the bones in the rest pose, and their weights [N, J]."""
    rng = np.random.default_rng(seed)
    bones = [(j, int(p)) for j, p in enumerate(PARENTS) if p != j]
    radius = np.array([SKELETON[NAMES[j]][2] for j, _ in bones])
    length = np.linalg.norm(JOINTS[[j for j, _ in bones]] - JOINTS[[p for _, p in bones]], axis=1)
    area = radius * (length + 2 * radius)
    own = rng.choice(len(bones), count, p=area / area.sum())
    a, b = JOINTS[[p for _, p in bones]][own], JOINTS[[j for j, _ in bones]][own]
    reach = 2 * radius[own] / length[own]
    along = np.clip(rng.uniform(-reach / 2, 1 + reach / 2), 0, 1)
    normal = rng.standard_normal((count, 3))
    axis = (b - a) / length[own][:, None]
    inside = (along > 0) & (along < 1)
    normal[inside] -= (normal[inside] * axis[inside]).sum(1, keepdims=True) * axis[inside]
    outward = np.where(along == 0, -1.0, 1.0)[:, None] * axis
    back = ~inside & ((normal * outward).sum(1) < 0)
    normal[back] -= 2 * (normal[back] * outward[back]).sum(1, keepdims=True) * outward[back]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    means = a + along[:, None] * (b - a) + radius[own][:, None] * normal
    stripes = np.sin(40 * means[:, 1]) * np.sin(25 * means[:, 0] + 9 * means[:, 2])
    tint = np.random.default_rng(3).uniform(-1, 1, (len(bones), 3))[own]
    size = np.log(0.9 * np.sqrt(area.sum() * np.pi * 2 / count))
    flat = np.stack([np.full(count, size), np.full(count, size), np.full(count, size - 1.5)], 1)
    g = Gaussians(
        means=means.astype(np.float32),
        quats=_facing(normal),
        log_scales=(flat + 0.15 * rng.standard_normal((count, 3))).astype(np.float32),
        logit_opacities=(2.5 + 0.5 * rng.standard_normal(count)).astype(np.float32),
        sh0=(tint + 0.5 * stripes[:, None] + 0.05 * rng.standard_normal((count, 3))).astype(np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    return g, _weights(means, bones, radius)


def _facing(normal: np.ndarray) -> np.ndarray:
    """[N, 4] f32 rotations that turn z to `normal` [N, 3]."""
    q = np.concatenate([1 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], np.zeros((len(normal), 1))], 1)
    q[q[:, 0] < 1e-6] = (0, 1, 0, 0)
    return quat_normalize(q).astype(np.float32)


def _weights(places: np.ndarray, bones: list, radius: np.ndarray) -> np.ndarray:
    """[N, J]: the joint at the upper end moves a bone; near its ends bones blend over about their radius."""
    depth = np.full((len(places), len(NAMES)), np.inf)
    for (j, p), r in zip(bones, radius, strict=True):
        along = JOINTS[j] - JOINTS[p]
        share = np.clip((places - JOINTS[p]) @ along / (along @ along), 0, 1)
        distance = np.linalg.norm(places - JOINTS[p] - share[:, None] * along, axis=1)
        depth[:, p] = np.minimum(depth[:, p], distance / r)
    weights = np.exp(-4 * (depth - depth.min(1, keepdims=True)))
    return weights / weights.sum(1, keepdims=True)


def pose(g: Gaussians, weights: np.ndarray, poses: np.ndarray, *, sway: float = SWAY, fps: float = 25.0) -> list:
    """The frames of a skin in `poses` [T, J, 6]."""
    still = np.zeros_like(poses[0])
    means, turned = RigMotion(JOINTS, PARENTS, still, poses, integer_weights(weights)).at(g.means)
    t = np.arange(len(poses))[:, None] / fps
    wobble = sway * np.sin(2 * np.pi * (0.9 * t + 1.5 * g.means[:, 1] + 2 * g.means[:, 0]))
    normal = np.stack([1 - 2 * (g.quats[:, 2] ** 2), g.quats[:, 1], g.quats[:, 2]], 1)
    return [
        Gaussians(
            (m + w[:, None] * normal).astype(np.float32),
            quat_normalize(quat_multiply(q, g.quats)).astype(np.float32),
            g.log_scales,
            g.logit_opacities,
            g.sh0,
            g.shN,
        )
        for m, q, w in zip(means, turned, wobble, strict=True)
    ]


def figure(count: int = 6000, frames: int = 60, gop: int = 30, fps: float = 25.0) -> Figure:
    """The walking figure in groups of `gop` frames; each group continues the previous one."""
    g, weights = skin(count)
    poses = walk(frames, fps)
    posed = pose(g, weights, poses, fps=fps)
    same = np.arange(count, dtype=np.int32)
    groups = [DenseGroup(posed[a : a + gop], None, same if a else None) for a in range(0, frames, gop)]
    vertices, own = g.means[::4], weights[::4].astype(np.float32)
    return Figure(GaussianSequence(fps, groups), Rig(JOINTS, PARENTS, poses, vertices, own))


def write_rig(rig: Rig, path: Path) -> None:
    """Writes the .npz that `encode --rig` reads."""
    parents = np.where(rig.parents == np.arange(len(rig.parents)), -1, rig.parents.astype(int))
    np.savez_compressed(
        path,
        joints_rest=rig.joints,
        parents=parents,
        rotations=rig.poses[..., :3],
        translations=rig.poses[:, 0, 3:],
        vertices=rig.vertices,
        weights=rig.weights,
    )
