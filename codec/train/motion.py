"""Tracking: the Gaussians of one frame -> those of the next, the same ones moved.

Two things are optimised together against the views: the rigid motions of a node graph, which carry everything, and the
Gaussians' own attributes. The colours must be free while the nodes move: shading changes on a turning surface, and
with fixed colours the motion follows the shading instead of the surface (lumberjack: 22.5 dB after 6 frames, with free
colours 26.1). The first half of the steps looks at small pictures, where large motion is near and a step is cheap.

A hash grid and MLP in place of the nodes, or on top of them, gave nothing here (bench/results/ablation.json), so that
there is none: the nodes are what the stream can carry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from gscodec.render.workspace import Workspace
from gscodec.train.graph import NodeGraph, quat_conjugate, quat_multiply, rotvec_to_quat
from gscodec.train.model import NAMES, Model
from gscodec.train.settings import TrainSettings
from gscodec.train.views import Views, compare

FIRST_STEPS = 2  # the first frame after a keyframe has no velocity to start from, and takes so many times the steps
SMALL = 0.5  # scale of the pictures in the first half of the steps
LOSS_WINDOW = 20  # steps over which a loss is averaged: about every view once
TURN_RATE, MOVE_RATE = 2e-2, 3e-3  # of the nodes: radians, radii
MASK_LAMBDA = 3.0  # the silhouette counts more than in a keyframe: it does not depend on light
# The Gaussians' own: what light changes is quick, place and shape are slow, so that the nodes take the motion.
RATES = {"quats": 6e-4, "log_scales": 6e-3, "logit_opacities": 2e-2, "sh0": 5e-2, "shN": 2.5e-3}
MEANS_RATE = 3e-4  # radii


@dataclass
class Pose:
    """Where the nodes are (`nodes` [M, 3]), how far they `turned` since the keyframe ([M, 4]), and their last step."""

    nodes: torch.Tensor
    turned: torch.Tensor
    turn: torch.Tensor  # [M, 3] rotation vector of the last step
    move: torch.Tensor  # [M, 3]

    @staticmethod
    def rest(graph: NodeGraph) -> Pose:
        """The keyframe's."""
        zero = torch.zeros_like(graph.nodes)
        return Pose(graph.nodes, rotvec_to_quat(zero), zero, zero)


class Tracker:
    """Follows the Gaussians of a keyframe through the frames after it.

    Args:
        key: the keyframe's Gaussians.
        radius: of the subject, world units.
    """

    def __init__(self, key: Model, views: Views, settings: TrainSettings, radius: float):
        self.views, self.radius = views, radius
        self.settings = replace(settings, mask_lambda=MASK_LAMBDA * settings.mask_lambda)
        self.graph = NodeGraph(key.params["means"], radius)
        self.pose = Pose.rest(self.graph)
        self.model = Model(key.params)
        self._workspace = Workspace()

    def advance(self, frame: int, on_step: Callable[[int, float], None] | None = None) -> float:
        """Moves model and pose on to `frame`, the next one; returns the image loss at the end, without the mask's."""
        fresh = not self.pose.move.any()
        steps = self.settings.motion_steps * (FIRST_STEPS if fresh else 1)
        fit = _Fit(self, np.random.default_rng([self.settings.seed, frame, 1]))
        losses = []
        for step in range(steps):
            scale = SMALL if 2 * step < steps else 1.0
            losses.append(fit.step(self.views.draw(frame, scale), 0.1 ** (step / steps)))
            if on_step:
                on_step(step, losses[-1])
        self.model, self.pose = fit.result()
        return float(np.mean(losses[-LOSS_WINDOW:]))

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint."""
        model = {f"tracked.{n}": p.numpy() for n, p in self.model.params.items()}
        pose = {f"pose.{f.name}": getattr(self.pose, f.name).numpy() for f in fields(Pose)}
        return {"radius": np.array(self.radius), "key_means": self.graph.means.numpy(), **model, **pose}

    @staticmethod
    def restored(state: dict[str, np.ndarray], views: Views, settings: TrainSettings) -> Tracker:
        """Inverse of `state`."""
        model = Model({n: torch.from_numpy(state[f"tracked.{n}"]) for n in NAMES})
        tracker = Tracker(
            Model({**model.params, "means": torch.from_numpy(state["key_means"])}),
            views,
            settings,
            float(state["radius"]),
        )
        tracker.model = model
        tracker.pose = Pose(*(torch.from_numpy(state[f"pose.{f.name}"]) for f in fields(Pose)))
        return tracker


class _Fit:
    """The optimisation of one frame, from constant velocity."""

    def __init__(self, tracker: Tracker, rng: np.random.Generator):
        self.t, self.rng = tracker, rng
        self.turn = tracker.pose.turn.clone().requires_grad_()
        self.move = tracker.pose.move.clone().requires_grad_()
        rates = [(self.turn, TURN_RATE), (self.move, MOVE_RATE * tracker.radius)]
        self.optimizer = torch.optim.Adam([{"params": [p], "base": r} for p, r in rates], betas=(0.9, 0.99), fused=True)
        self.own = Model(tracker.model.params)  # the Gaussians' own attributes, before they are carried
        self.place = Model({**tracker.model.params, "means": torch.zeros_like(tracker.model.params["means"])})

    def _carried(self):
        means, turned = self.t.graph.carry(
            self.t.model.params["means"], self.t.pose.nodes, rotvec_to_quat(self.turn), self.move
        )
        return means + self.place.params["means"], turned

    def step(self, target, fade: float) -> float:
        """One view; rates times `fade`."""
        t, graph = self.t, self.t.graph
        means, turned = self._carried()
        quats = quat_multiply(turned, self.own.params["quats"])
        params = {**self.own.params, "means": means, "quats": quats}
        result = compare(params, target, t.settings, self.rng, t._workspace)
        grads = result.grads
        rigid = t.settings.rigidity * graph.rigidity(t.pose.nodes, rotvec_to_quat(self.turn), self.move)
        for g in self.optimizer.param_groups:
            g["lr"] = g["base"] * fade
        self.optimizer.zero_grad()
        torch.autograd.backward([means, quats, rigid], [grads["means"], grads["quats"], torch.ones(())])
        self.optimizer.step()
        back = quat_multiply(quat_conjugate(turned.detach()), grads["quats"])
        self.own.adam({**grads, "quats": back}, {n: r * fade for n, r in RATES.items()})
        self.place.adam(grads, {"means": MEANS_RATE * t.radius * fade})
        return result.loss - t.settings.mask_lambda * result.mask

    @torch.no_grad()
    def result(self) -> tuple[Model, Pose]:
        """The moved Gaussians and nodes."""
        means, turned = self._carried()
        quats = quat_multiply(turned, torch.nn.functional.normalize(self.own.params["quats"], dim=1))
        pose, turn = self.t.pose, self.turn.detach()
        moved = Pose(
            pose.nodes + self.move.detach(),
            torch.nn.functional.normalize(quat_multiply(rotvec_to_quat(turn), pose.turned), dim=1),
            turn,
            self.move.detach(),
        )
        return Model({**self.own.params, "means": means, "quats": quats}), moved
