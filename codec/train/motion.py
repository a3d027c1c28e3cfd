"""Tracking: the Gaussians of one frame -> those of the next, the same ones moved.

Two things are optimised together against the views: the rigid motions of a node graph, which carry everything, and the
Gaussians' own attributes. The colours must be free while the nodes move: shading changes on a turning surface, and
with fixed colours the motion follows the shading instead of the surface (lumberjack: 22.5 dB after 6 frames, with free
colours 26.1). The first half of the steps looks at small pictures, where large motion is near and a step is cheap.

A hash grid and MLP (V3) on top of the nodes gave nothing here, so that there is none: the nodes are what the stream can
carry. V3's recipe, with the grid, is a baseline in bench/baselines/v3.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import torch

from gscodec.render.workspace import Workspace
from gscodec.train.graph import NodeGraph, Pose, quat_conjugate, quat_multiply, rotvec_to_quat
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
MEANS_RATE = 3e-5  # radii


class Tracker:
    """Follows the Gaussians of a keyframe through the frames after it.

    Args:
        key: the keyframe's Gaussians.
        radius: of the subject, world units.

    Attributes:
        own: the Gaussians as they would be in the keyframe's pose; `means` is what they moved besides the nodes.
        pose: the nodes in the last frame.
    """

    def __init__(self, key: Model, views: Views, settings: TrainSettings, radius: float):
        self.views, self.radius = views, radius
        self.settings = replace(settings, mask_lambda=MASK_LAMBDA * settings.mask_lambda)
        self.graph = NodeGraph(key.params["means"], radius)
        self.pose = Pose.rest(self.graph)
        self.own = Model({**key.params, "means": torch.zeros_like(key.params["means"])})
        self.workspace = Workspace()

    def carried(self, own: Model, pose: Pose) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Attributes in the frame of `pose`, and how far the nodes have turned each Gaussian, [N, 4]."""
        means, turned = self.graph.carry(self.graph.means, pose)
        quats = quat_multiply(turned, own.params["quats"])
        return {**own.params, "means": means + own.params["means"], "quats": quats}, turned

    @property
    def model(self) -> Model:
        """The Gaussians in the last frame."""
        return Model(self.carried(self.own, self.pose)[0])

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
        self.own, self.pose = fit.result()
        return float(np.mean(losses[-LOSS_WINDOW:]))

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint."""
        own = {f"own.{n}": p.numpy() for n, p in self.own.params.items()}
        pose = {f"pose.{f.name}": getattr(self.pose, f.name).numpy() for f in fields(Pose)}
        return {"radius": np.array(self.radius), "key_means": self.graph.means.numpy(), **own, **pose}

    @staticmethod
    def restored(state: dict[str, np.ndarray], views: Views, settings: TrainSettings) -> Tracker:
        """Inverse of `state`."""
        own = Model({n: torch.from_numpy(state[f"own.{n}"]) for n in NAMES})
        tracker = Tracker(
            Model({**own.params, "means": torch.from_numpy(state["key_means"])}),
            views,
            settings,
            float(state["radius"]),
        )
        tracker.own = own
        tracker.pose = Pose(*(torch.from_numpy(state[f"pose.{f.name}"]) for f in fields(Pose)))
        return tracker


class _Fit:
    """The optimisation of one frame, from constant velocity.

    Means are always the keyframe's, carried by the whole motion since, plus what each Gaussian moved besides: what the
    stream can say with nodes is said with nodes, and does not creep into the Gaussians step by step.
    """

    def __init__(self, tracker: Tracker, rng: np.random.Generator):
        self.t, self.rng = tracker, rng
        self.turn = tracker.pose.turn.clone().requires_grad_()
        self.move = tracker.pose.move.clone().requires_grad_()
        rates = [(self.turn, TURN_RATE), (self.move, MOVE_RATE * tracker.radius)]
        self.optimizer = torch.optim.Adam([{"params": [p], "base": r} for p, r in rates], betas=(0.9, 0.99), fused=True)
        self.own = Model(tracker.own.params)

    def _pose(self) -> Pose:
        pose, turn = self.t.pose, rotvec_to_quat(self.turn)
        turned = torch.nn.functional.normalize(quat_multiply(turn, pose.turned), dim=1)
        return Pose(pose.nodes + self.move, turned, self.turn, self.move)

    def step(self, target, fade: float) -> float:
        """One view; rates times `fade`."""
        t, pose = self.t, self._pose()
        params, turned = t.carried(self.own, pose)
        result = compare(params, target, t.settings, self.rng, t.workspace)
        grads = result.grads
        rigid = t.settings.rigidity * t.graph.rigidity(pose)
        for g in self.optimizer.param_groups:
            g["lr"] = g["base"] * fade
        self.optimizer.zero_grad()
        heads, seeds = [params["means"], params["quats"], rigid], [grads["means"], grads["quats"], torch.ones(())]
        torch.autograd.backward(heads, seeds)
        self.optimizer.step()
        back = quat_multiply(quat_conjugate(turned.detach()), grads["quats"])
        rates = {"means": MEANS_RATE * t.radius, **RATES}
        self.own.adam({**grads, "quats": back}, {n: r * fade for n, r in rates.items()})
        return result.loss - t.settings.mask_lambda * result.mask

    @torch.no_grad()
    def result(self) -> tuple[Model, Pose]:
        """The Gaussians' own attributes and the nodes."""
        quats = torch.nn.functional.normalize(self.own.params["quats"], dim=1)
        pose = self._pose()
        return Model({**self.own.params, "quats": quats}), Pose(*(getattr(pose, f.name).detach() for f in fields(Pose)))
