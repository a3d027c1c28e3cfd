"""Rig: a skeleton that predicts the motion of nodes by linear blend skinning.

`Rig` is the user's input, for all frames of a sequence. `RigMotion` is the part of it for one group: poses of its
frames, the pose in which it rests, and the weights of the joints for each node. The prediction is native and the same
as in the stream (spec 13.3). A pose gives each joint a rotation vector and a translation, relative to its parent, along
the world axes in the rest pose: x -> R (x - joint) + joint + translation, then the same of the parent, up to the root.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from .. import _native
from .rotations import quat_conjugate, quat_multiply, quat_to_rotvec, rotate, rotvec_to_quat


@dataclass(frozen=True)
class RigMotion:
    """Rig that predicts the motion of M nodes over T frames.

    Attributes:
        joints: [J, 3] f32 positions in the rest pose of the skeleton, world units.
        parents: [J] u8, parent of each joint, which precedes it; a root has its own index.
        bind: [J, 6] f32, pose in which the group rests: rotation vector in radians, translation in world units.
        poses: [T, J, 6] f32, pose of each frame.
        weights: [M, J] u8, 0 to 64, weight of each joint for each node; all 0: the node is not predicted.
    """

    joints: np.ndarray
    parents: np.ndarray
    bind: np.ndarray
    poses: np.ndarray
    weights: np.ndarray

    def at(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predicted positions [T, M, 3] f32 and rotations [T, M, 4] f32 wxyz of nodes that rest at [M, 3]."""
        f32 = lambda a: np.ascontiguousarray(a, np.float32)  # noqa: E731
        skeleton = f32(self.joints), np.ascontiguousarray(self.parents, np.uint8), f32(self.bind)
        weights = np.ascontiguousarray(self.weights, np.uint8)
        return _native.rig_motion(skeleton, f32(self.poses), f32(nodes), weights)

    def residual(
        self, nodes: np.ndarray, rotations: np.ndarray, translations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rotation vectors [T, M, 3] and translations [T, M, 3] of nodes [M, 3] less their prediction, in the local
        frame that the rig moves."""
        places, turned = self.at(nodes)
        left = quat_multiply(quat_conjugate(turned), rotvec_to_quat(rotations.astype(np.float32)))
        turns, near = np.empty_like(rotations, np.float32), None
        for t, q in enumerate(left):
            near = turns[t] = quat_to_rotvec(q, near)
        return turns, rotate(quat_conjugate(turned), nodes + translations - places).astype(np.float32)

    def total(
        self, nodes: np.ndarray, rotations: np.ndarray, translations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of `residual`."""
        places, turned = self.at(nodes)
        whole = quat_multiply(turned, rotvec_to_quat(rotations.astype(np.float32)))
        turns, near = np.empty_like(rotations, np.float32), None
        for t, q in enumerate(whole):
            near = turns[t] = quat_to_rotvec(q, near)
        return turns, (places + rotate(turned, translations.astype(np.float32)) - nodes).astype(np.float32)

    def take_nodes(self, index: np.ndarray) -> RigMotion:
        """The motion of the nodes at `index`."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        return RigMotion(**{**own, "weights": self.weights[index]})


@dataclass(frozen=True)
class Rig:
    """A skeleton and its poses in all F frames of a sequence.

    Attributes:
        joints, parents: as in `RigMotion`.
        poses: [F, J, 6] f32.
        vertices: [V, 3] f32, vertices of the skin in the rest pose; None: joints move nodes near their bones.
        weights: [V, J] f32, weight of each joint for each vertex.
    """

    joints: np.ndarray
    parents: np.ndarray
    poses: np.ndarray
    vertices: np.ndarray | None = None
    weights: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def frames(self, chosen: range) -> Rig:
        """The frames of `chosen`."""
        own = self.poses[chosen.start : chosen.stop]
        return Rig(self.joints, self.parents, own, self.vertices, self.weights)

    def posed(self, frame: int, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Positions [V, 3] in a frame of points [V, 3] of the rest pose of the skeleton; weights [V, J] u8."""
        rest, now = np.zeros_like(self.poses[0]), self.poses[frame : frame + 1]
        return RigMotion(self.joints, self.parents, rest, now, weights).at(points)[0][0]

    def motion(self, weights: np.ndarray, rest: int, frames: range) -> RigMotion:
        """Motion in `frames` of nodes with `weights` [M, J] u8 that rest at their positions of frame `rest`."""
        return RigMotion(self.joints, self.parents, self.poses[rest], self.poses[frames.start : frames.stop], weights)
