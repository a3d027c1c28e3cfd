"""A rig in training: predicts the nodes' step to the next frame, from which tracking starts.

So tracking reaches fast articulated motion and optimises the residual: a node keeps its offset from the prediction.
Nodes that the rig does not move, among them nodes of Gaussians added later, keep their constant velocity.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..model.rig import Rig, RigMotion
from ..model.rotations import quat_conjugate, quat_multiply, quat_to_rotvec, rotate
from ..model.skin_weights import skin_weights
from .deformation_graph import NodeGraph, Pose


class RigPrediction:
    """Motion of the nodes of a keyframe.

    Args:
        rig: with poses of all frames of the capture.
        at_rest: frame of the keyframe.
        graph: its nodes.
    """

    def __init__(self, rig: Rig, at_rest: int, graph: NodeGraph):
        self.rig, self.at_rest = rig, at_rest
        self._weights = skin_weights(rig, at_rest, graph.nodes[torch.from_numpy(graph.batch == 0)].numpy())

    def motion(self, nodes: int, frames: range) -> RigMotion:
        """Predicted motion of the first `nodes` nodes of the graph over `frames`."""
        added = nodes - len(self._weights)
        return self.rig.motion(np.pad(self._weights, ((0, added), (0, 0))), self.at_rest, frames)

    def step(self, pose: Pose, graph: NodeGraph, frame: int) -> Pose:
        """The pose of the frame before `frame`, with the predicted step to `frame` as velocity."""
        motion = self.motion(len(graph), range(frame - 1, frame + 1))
        places, turned = (torch.from_numpy(a) for a in motion.at(graph.nodes.numpy()))
        turn = quat_multiply(turned[1], quat_conjugate(turned[0]))
        beside = rotate(turn, pose.nodes - places[0])  # offset from the prediction, turned with it
        shift = places[1] + beside - pose.nodes
        moved = torch.from_numpy(motion.weights.any(1))[:, None]
        return replace(
            pose,
            angular_velocity=torch.where(moved, quat_to_rotvec(turn), pose.angular_velocity),
            velocity=torch.where(moved, shift, pose.velocity),
        )
