"""Tracking: the Gaussians of one frame -> those of the next, the same ones moved.

Two things are optimised together against the views: the rigid motions of a node graph, which carry everything, and the
Gaussians' own attributes. The colours must be free while the nodes move: shading changes on a turning surface, and
with fixed colours the motion follows the shading instead of the surface (lumberjack: 22.5 dB after 6 frames, with free
colours 26.1). The first half of the steps looks at small pictures, where large motion is near and a step is cheap.

What does not change in the pictures (changes.py) does not move: its Gaussians and nodes stay as they are, to the bit.
What comes in (births.py) has nodes of its own, unless it is beside what is there, and is looked for where it moves too
fast to be followed (lost.py). What has faded away, or lies outside of the masks, is dead.

A hash grid and MLP (V3) on top of the nodes gave nothing here, so that there is none: the nodes are what the stream can
carry. V3's recipe, with the grid, is a baseline in bench/baselines/v3.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import torch

from ..bitstream.quantization import subject_radius
from ..model.rotations import quat_conjugate, quat_multiply, rotvec_to_quat
from ..render.optimizer import Adam
from .change_detection import Changes
from .deformation_graph import NodeGraph, Pose
from .densification import born, wrong_pixels
from .keyframe import Statistics, rotate
from .model import HIDDEN, NAMES, Model
from .relocalization import whereabouts
from .settings import TrainSettings
from .views import Views, photometric_loss, view_losses


class Tracker:
    """Follows the Gaussians of a keyframe through the frames after it; `start` makes one.

    Args:
        graph: nodes in the keyframe; own: see below.
        radius: of what moves, world units.
        loss: see below; calm: pull on a Gaussian (`Statistics.mean_pull`) that hardly any has in the keyframe.
        changes: what has been fitted so far.

    Attributes:
        own: the Gaussians as they would be in the keyframe's pose; `means` is what they moved besides the nodes.
        pose: the nodes in the last frame.
        moving: [N] bool, Gaussians that were free to change in the last frame.
        loss: image loss of the last frame that had changed, without the mask's.
        masks: what has changed in the last frame's pictures, as of `Changes.advance`.
        pull: [N], mean pull of the last frame's pictures on each Gaussian.
    """

    def __init__(
        self, graph: NodeGraph, own: Model, views: Views, settings: TrainSettings, numbers: np.ndarray, changes: Changes
    ):
        self.graph, self.own, self.pose, self.views = graph, own, Pose.rest(graph), views
        self.settings = replace(settings, mask_lambda=settings.tracking.mask_factor * settings.mask_lambda)
        self.radius, self.loss, self.calm = numbers.tolist()
        self.changes = changes
        self.moving = torch.zeros(len(own), dtype=torch.bool)

    @staticmethod
    def start(key: Model, views: Views, settings: TrainSettings, loss: float, frames: range) -> Tracker:
        """Follows `key`, the keyframe of frames[0] with image loss `loss`; most nodes go where frames[1] differs."""
        changes = Changes.since(views, frames[0], settings.change_detection)
        stats, visible = Statistics(len(key), settings.keyframe.mse_min), []
        for result in view_losses(key.params, views, frames[0], settings):
            stats.add(result)
            visible.append(result.max_weight > settings.tracking.visible_weight)
        means = key.params["means"]
        moving = np.ones(len(key), bool)
        if len(frames) > 1:
            seen = changes.behind(frames[1], changes.copy().advance(frames[1]), means.numpy(), visible)
            moving = seen if seen.any() else moving
        radius = subject_radius(means[moving].numpy())
        sizes = torch.ones(len(key))
        if not views.capture.has_alpha:  # there is a background
            sizes = key.params["log_scales"].sort(1).values[:, 1:].mean(1).exp()  # without the thin axis
        graph = NodeGraph.of(means, sizes, radius, torch.from_numpy(moving), settings.graph)
        own = Model({**key.params, "means": torch.zeros_like(means)})
        calm = float(torch.quantile(stats.mean_pull(), settings.tracking.gradient_quantile))
        return Tracker(graph, own, views, settings, np.array([radius, loss, calm]), changes)

    def carried(self, own: Model, pose: Pose) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Attributes in the frame of `pose`, and how far the nodes have turned each Gaussian, [N, 4]."""
        means, turned = self.graph.carry(self.graph.means, pose)
        quats = quat_multiply(turned, own.params["quats"])
        return {**own.params, "means": means + own.params["means"], "quats": quats}, turned

    @property
    def model(self) -> Model:
        """The Gaussians in the last frame."""
        return Model(self.carried(self.own, self.pose)[0])

    def advance(self, frame: int, on_step: Callable[[int, float], None] | None = None) -> float | None:
        """Moves model and pose on to `frame`, the next one; returns the image loss at the end, without the mask's, or
        None where nothing has changed or nothing is left; infinity if something comes after that."""
        self.moving = torch.from_numpy(self._moving(frame))
        self.pull = torch.zeros(len(self.own))
        changed = any(m.any() for m in self.masks)
        if not self.alive.any():
            return np.inf if changed else None
        if self.moving.any():
            self._find(frame)
            self._fit(frame, on_step)
        else:
            self.pose = replace(self.pose, turn=0 * self.pose.turn, move=0 * self.pose.move)
        outside = self.changes.outside(frame, self.model.params["means"].numpy())
        self._bury(torch.from_numpy(outside) | (self.moving & self._faded))
        return self.loss if changed and self.alive.any() else None

    def _fit(self, frame: int, on_step) -> None:
        fit = _Fit(self, np.random.default_rng([self.settings.seed, frame, 1]))
        s = self.settings.tracking
        bound, loss = s.loss_ratio * self.loss + s.loss_floor, np.inf
        if not self.pose.move.any():
            self._round(fit, frame, 1.0, on_step)
        for turn in range(s.rounds_max):
            before, loss = loss, self._round(fit, frame, 0.5 if turn == 0 else 0.0, on_step)
            if loss < bound or loss > s.progress_ratio * before:
                break
        self.own, self.pose = fit.result()
        self.loss = loss
        self.pull = fit.pull.mean_pull()

    def _find(self, frame: int) -> None:
        """Newcomers that are lost go to where `frame` shows them, with that speed, or die."""
        family, next_pose = self.graph.family_of(), self.pose.ahead()
        for k in np.setdiff1d(family[(self.moving & self.alive).numpy()], [0]):
            some = torch.from_numpy(family == k) & self.alive
            model = Model(self.carried(self.own, next_pose)[0])
            shift = whereabouts(model, some, frame, self.changes, self.masks, self.settings)
            if shift is None:
                self._bury(some)
            else:
                self.moving |= some
                self.pose.move[torch.from_numpy(self.graph.family == k)] += shift

    @property
    def _faded(self) -> torch.Tensor:
        return torch.sigmoid(self.own.params["logit_opacities"]) < self.settings.keyframe.prune_opacity

    def _bury(self, dead: torch.Tensor) -> None:
        """Gaussians of `dead` ([N] bool) do not come back."""
        self.own.params["logit_opacities"][dead] = HIDDEN
        self.moving &= ~dead

    @property
    def alive(self) -> torch.Tensor:
        """[N] bool: Gaussians that have not died."""
        return self.own.params["logit_opacities"] > HIDDEN

    def keep(self, chosen: torch.Tensor) -> None:
        """Forgets the Gaussians outside of `chosen` ([N] bool)."""
        self.graph.keep(chosen)
        self.own.select(chosen)
        self.moving = self.moving[chosen]

    def bear(self, frame: int, on_step: Callable[[int, float], None] | None = None) -> None:
        """Adds the Gaussians that `frame` needs besides, after `advance`."""
        most = self.settings.gaussians_max
        room = min(most - int(self.alive.sum()), self.settings.tracking.stored_factor * most - len(self.own))
        pull = self.pull / self.calm
        wrong = wrong_pixels(self.model, self.masks, frame, self.views, self.settings.densification)
        young = born(self.model, pull, wrong, frame, self.views, self.settings, room, on_step)
        if young is not None:
            self._add(young)

    def _add(self, young: Model) -> None:
        """Takes in Gaussians that were born in the pose of the last frame."""
        self.graph.extend(self._rest(young.params["means"]))
        means, turned = (x[len(self.own) :] for x in self.graph.carry(self.graph.means, self.pose))
        quats = quat_multiply(quat_conjugate(turned), young.params["quats"])
        self.own.append({**young.params, "means": young.params["means"] - means, "quats": quats})
        self.moving = torch.cat([self.moving, torch.ones(len(young), dtype=torch.bool)])

    def _rest(self, means: torch.Tensor) -> torch.Tensor:
        """[K, 3] where Gaussians rest that are born at `means`: beside the nearest one that there is, whose nodes carry
        them, too. Strangers, away from all, have nodes of their own, and what is nearest to these goes with them."""
        from scipy.spatial import cKDTree

        s = self.settings.tracking
        params, turned = self.carried(self.own, self.pose)
        there, turned, rest = params["means"][self.alive], turned[self.alive], self.graph.means[self.alive]
        among = np.median(cKDTree(means.numpy()).query(means.numpy(), 2)[0][:, 1])
        strange = torch.from_numpy(cKDTree(there.numpy()).query(means.numpy())[0] > s.separate_distance * among)
        first = len(self.graph)
        shift = self.graph.settle(means[strange]) if strange.sum() >= s.separate_min else None
        if shift is not None:
            self.pose = self.pose.joined(self.graph.nodes[first:] - shift)
            there, rest = torch.cat([there, means[strange]]), torch.cat([rest, means[strange] + shift])
            turned = torch.cat([turned, rotvec_to_quat(torch.zeros(int(strange.sum()), 3))])
        near = torch.from_numpy(cKDTree(there.numpy()).query(means.numpy())[1])
        return rest[near] + rotate(quat_conjugate(turned[near]), means - there[near])

    def _round(self, fit: _Fit, frame: int, coarse: float, on_step) -> float:
        """`motion_steps` views, the first share of them, `coarse`, small; returns the image loss at the end."""
        s = self.settings.tracking
        losses, steps = [], self.settings.motion_steps
        for step in range(steps):
            full = step >= coarse * steps
            target = self.views.draw(frame, 1.0 if full else s.small_scale)
            losses.append(fit.step(target, s.rate_decay ** (step / steps), full, stiff=coarse == 1))
            if on_step:
                on_step(step, losses[-1])
        return float(np.mean(losses[-s.loss_window :]))

    def stirred(self, frame: int, before: torch.Tensor) -> float:
        """Share of the Gaussians that `frame`, the next one, shows otherwise, beyond those of `before` ([N] bool)."""
        new = self._behind(self.changes.copy().advance(frame), frame) & ~before.numpy()
        return float(new.mean()) if len(new) else 0.0

    def _moving(self, frame: int) -> np.ndarray:
        """[N] bool: Gaussians that `frame` shows otherwise."""
        self.masks = self.changes.advance(frame)
        return self._behind(self.masks, frame)

    def _behind(self, masks: list[np.ndarray], frame: int) -> np.ndarray:
        """[N] bool: Gaussians behind the changed pixels of `frame` (`masks`)."""
        model = self.model
        if not any(m.any() for m in masks):
            return np.zeros(len(model), bool)
        s = self.settings.tracking
        looks = view_losses(model.params, self.views, frame, self.settings, s.small_scale)
        visible = [result.max_weight > s.visible_weight for result in looks]
        return self.changes.behind(frame, masks, model.params["means"].numpy(), visible)

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint."""
        own = {f"own.{n}": p.numpy() for n, p in self.own.params.items()}
        pose = {f"pose.{f.name}": getattr(self.pose, f.name).numpy() for f in fields(Pose)}
        fitted = {f"fitted.{i}": picture for i, picture in enumerate(self.changes.fitted)}
        graph = {f"graph.{n}": a for n, a in self.graph.state().items()}
        numbers = np.array([self.radius, self.loss, self.calm])
        return {"numbers": numbers, **graph, **own, **pose, **fitted}

    @staticmethod
    def restored(state: dict[str, np.ndarray], views: Views, settings: TrainSettings) -> Tracker:
        """Inverse of `state`."""
        own = Model({n: torch.from_numpy(state[f"own.{n}"]) for n in NAMES})
        graph = NodeGraph.restored({n[6:]: a for n, a in state.items() if n.startswith("graph.")}, settings.graph)
        fitted = [state[f"fitted.{i}"] for i in range(len(views.train_cameras))]
        changes = Changes(views, fitted, settings.change_detection)
        tracker = Tracker(graph, own, views, settings, state["numbers"], changes)
        tracker.pose = Pose(*(torch.from_numpy(state[f"pose.{f.name}"]) for f in fields(Pose)))
        return tracker


class _Fit:
    """The optimisation of one frame, from constant velocity, of the Gaussians that are moving and their nodes.

    Means are always the keyframe's, carried by the whole motion since, plus what each Gaussian moved besides: what the
    stream can say with nodes is said with nodes, and does not creep into the Gaussians step by step.
    """

    def __init__(self, tracker: Tracker, rng: np.random.Generator):
        self.t, self.rng = tracker, rng
        self.moving = tracker.moving.float()
        self.carriers = tracker.graph.carriers(tracker.moving).float()[:, None]
        self.turn = (tracker.pose.turn * self.carriers).requires_grad_()
        self.move = (tracker.pose.move * self.carriers).requires_grad_()
        s = tracker.settings.tracking
        self.node_rates = {"rotation": s.node_rotation_rate, "translation": s.node_translation_rate * tracker.radius}
        self.node_adam = Adam(tracker.views.backend, s.node_adam)
        self.own = Model(tracker.own.params)
        self.own.start_optimizer(tracker.views.backend, tracker.settings.adam)
        self.pull = Statistics(len(self.own), tracker.settings.keyframe.mse_min)

    def _pose(self) -> Pose:
        return replace(self.t.pose, turn=self.turn, move=self.move).ahead()

    def step(self, target, fade: float, full: bool, stiff: bool) -> float:
        """One view; rates times `fade`; a `full` one counts for what pulls at the Gaussians; `stiff`: see
        `first_round_rigidity`."""
        t, pose, s = self.t, self._pose(), self.t.settings.tracking
        params, turned = t.carried(self.own, pose)
        result = photometric_loss(params, target, t.settings, self.rng, t.views.backend)
        if full:
            self.pull.add(result)
        grads = result.grads
        rigid = (s.first_round_rigidity if stiff else 1.0) * t.settings.rigidity * t.graph.rigidity(pose)
        self.turn.grad = self.move.grad = None
        heads, seeds = [params["means"], params["quats"], rigid], [grads["means"], grads["quats"], torch.ones(())]
        torch.autograd.backward(heads, seeds)
        nodes = {"rotation": self.turn, "translation": self.move}
        by_nodes = {n: p.grad * self.carriers for n, p in nodes.items()}
        self.node_adam.step(nodes, by_nodes, {n: r * fade for n, r in self.node_rates.items()})
        back = quat_multiply(quat_conjugate(turned.detach()), grads["quats"])
        fade *= s.first_round_rates if stiff else 1.0
        own = {n: g * self.moving.view(-1, *[1] * (g.dim() - 1)) for n, g in {**grads, "quats": back}.items()}
        self.own.step(own, s.rates.scaled(t.radius, fade))
        return result.loss - t.settings.mask_lambda * result.mask

    @torch.no_grad()
    def result(self) -> tuple[Model, Pose]:
        """The Gaussians' own attributes and the nodes."""
        quats = torch.nn.functional.normalize(self.own.params["quats"], dim=1)
        pose = self._pose()
        return Model({**self.own.params, "quats": quats}), Pose(*(getattr(pose, f.name).detach() for f in fields(Pose)))
