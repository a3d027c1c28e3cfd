"""Fit of one tracked frame: nodes and the Gaussians' own attributes are optimised together, from constant velocity.

In: a tracker in the pose of the frame before. Out: the Gaussians' own attributes and the pose of the nodes. Means are
those of the keyframe, carried by the nodes' motion since then, plus an own offset. So the nodes hold all motion that
they can express, and it does not accumulate in the Gaussians frame by frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..render.optimizer import Adam
from .deformation_graph import Pose
from .keyframe import Statistics
from .model import Model, quat_product
from .motion_field import FieldMotion, MotionField
from .views import Target, photometric_loss

if TYPE_CHECKING:
    from .tracking import Tracker


class FrameFit:
    """Optimisation of the moving Gaussians of `tracker` and of the nodes that carry them.

    Attributes:
        own: the Gaussians' own attributes (`Tracker.own`).
        statistics: of the views at full size.
    """

    def __init__(self, tracker: Tracker, rng: np.random.Generator):
        s, backend = tracker.settings.tracking, tracker.views.backend
        self.tracker, self._rng = tracker, rng
        self._moving, self._all_move = tracker.moving.float(), bool(tracker.moving.all())
        carriers = tracker.graph.carriers(tracker.moving).float()[:, None]
        going = carriers + tracker.coasting.float()[:, None]  # coasting nodes keep their velocity
        self._nodes = {
            "angular_velocity": tracker.pose.angular_velocity * going,
            "velocity": tracker.pose.velocity * going,
        }
        self._carriers, self._adam = carriers, Adam(backend, s.node_adam)
        self._rates = {"angular_velocity": s.node_rotation_rate, "velocity": s.node_translation_rate * tracker.radius}
        self._field, f = None, tracker.settings.motion_field
        if f.tracking:
            nodes, seed = tracker.graph.nodes, tracker.settings.seed
            self._field = MotionField(nodes, tracker.radius, 1, f, seed, backend, s.node_adam)
        self.own = Model(tracker.own.params)
        self.own.start_optimizer(backend, tracker.settings.adam)
        self._largest = None  # [N, 1], natural logs of the largest scales, where there is a bound
        if (bound := tracker.views.size_bound) is not None:
            self._largest = bound.log_scales(tracker.carried(tracker.own, tracker.pose)[0]["means"])
        self.statistics = Statistics(len(self.own), tracker.settings.keyframe.mse_min)

    def _pose(self) -> tuple[Pose, FieldMotion | None]:
        """Pose of the nodes, and the motion from the field."""
        turn, shift, by_field = self._nodes["angular_velocity"], self._nodes["velocity"], None
        if self._field is not None:
            by_field = self._field()
            turn, shift = turn + self._carriers * by_field.turn, shift + self._carriers * by_field.shift
        return replace(self.tracker.pose, angular_velocity=turn, velocity=shift).next(), by_field

    def step(self, target: Target, decay: float, *, full: bool, stiff: bool, slow: bool) -> float:
        """One step on one view; returns its image loss without the mask term.

        Args:
            decay: multiplies all learning rates.
            full: the view has its full size, and counts in the statistics.
            stiff: high rigidity of the nodes, where the velocity is not known (`TrackingSettings.stiff_rigidity`).
            slow: low rates of the Gaussians' own attributes, there too (`slow_rates`, `searched_slow_rates`).
        """
        t, s = self.tracker, self.tracker.settings.tracking
        pose, by_field = self._pose()
        params, rotations = t.carried(self.own, pose)
        result = photometric_loss(params, target, t.settings, self._rng, t.views.backend)
        if full:
            self.statistics.add(result)
        grads = result.grads
        by_rotations = quat_product(grads["quats"], self.own.params["quats"], inverse_b=True)
        rigidity = (s.stiff_rigidity if stiff else 1.0) * t.settings.rigidity
        self._step_nodes(pose, by_field, (grads["means"], by_rotations), rigidity, decay)
        grads = {**grads, "quats": quat_product(rotations, grads["quats"], inverse_a=True)}  # before rotation
        free = grads
        if not self._all_move:
            free = {n: g * self._moving.view(-1, *[1] * (g.dim() - 1)) for n, g in grads.items()}
        slow_rates = s.searched_slow_rates if t.searched else s.slow_rates
        self.own.step(free, s.rates.scaled(t.radius, decay * (slow_rates if slow else 1.0)))
        if self._largest is not None:
            self.own.limit_sizes(self._largest)
        return result.image_loss

    def _step_nodes(
        self, pose: Pose, by_field: FieldMotion | None, by_carried: tuple, rigidity: float, decay: float
    ) -> None:
        """One step of the nodes along the gradients by the carried Gaussians and along that of the rigidity term."""
        graph, base = self.tracker.graph, (self.tracker.pose.rotations, pose.angular_velocity)
        by = graph.gradients(graph.means, base, pose, by_carried, rigidity)
        by = [g * self._carriers for g in by]
        self._adam.step(self._nodes, dict(zip(self._nodes, by, strict=True)), self._scaled(decay))
        if by_field is not None:
            searched = self.tracker.settings.motion_field.searched_rates if self.tracker.searched else 1.0
            self._field.step(by_field, *by, decay * searched)

    def _scaled(self, decay: float) -> dict[str, float]:
        return {n: r * decay for n, r in self._rates.items()}

    def result(self) -> tuple[Model, Pose]:
        """The Gaussians' own attributes and the pose of the nodes."""
        quats = torch.nn.functional.normalize(self.own.params["quats"], dim=1)
        return Model({**self.own.params, "quats": quats}), self._pose()[0]
