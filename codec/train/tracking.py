"""Tracking: the Gaussians of one frame -> those of the next, the same ones moved.

Optimised together against the views: the rigid motions of the nodes, which carry all Gaussians, and the Gaussians' own
attributes (frame_fit.py). Colours must be free while nodes move: shading changes on a rotating surface, and with fixed
colours the motion follows the shading instead of the surface (lumberjack after 6 frames: 22.5 dB, with free colours
26.1). The first half of the first round uses small images, in which large motion is few pixels and a step cheap.

Gaussians behind pixels that do not change (change_detection.py) stay as they are, to the bit, and so do their nodes.
New Gaussians (densification.py) have nodes of their own, unless they lie beside others. A search finds motion too fast
for the gradient: of new Gaussians (relocalization.py), of the subject and its parts (motion_search.py). Gaussians that
have faded, or lie outside of the masks, are removed. What no camera sees any more coasts: its nodes go on as they
moved last, around a curve, too, until a camera sees it again.

A hash grid and an MLP move the nodes beside their own variables (motion_field.py), so that large motion is reached in
fewer steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..bitstream.quantization import subject_radius
from ..model.rig import Rig
from ..model.rotations import quat_conjugate, rotate, rotvec_to_quat
from ..render.backend import TURNS
from .change_detection import Changes
from .deformation_graph import NodeGraph, Pose
from .densification import error_masks, spawn
from .frame_fit import FrameFit
from .keyframe import Statistics
from .model import NAMES, REMOVED_LOGIT, Model, harmonics_turned, quat_product
from .motion_search import search
from .relocalization import relocalize
from .rig_prediction import RigPrediction
from .settings import TrainSettings
from .views import Views, view_losses

if TYPE_CHECKING:
    from .finetune import GroupModel

OnStep = Callable[[int, float], None] | None  # called with (step, loss)


class Tracker:
    """Tracks the Gaussians of a keyframe through the frames after it; `start` makes one.

    Args:
        graph: nodes, at rest in the keyframe.
        own: see below.
        numbers: radius of the moving Gaussians in world units; `loss`, see below; `keyframe_gradient`, the reference
            of screen gradients (`gradient_quantile` of those in the keyframe).
        changes: reference images, as fitted so far.

    Attributes:
        own: the Gaussians in the pose of the keyframe; `means` are the offsets from where the nodes carry them.
        pose: of the nodes in the last frame.
        moving: [N] bool, Gaussians that were optimised in the last frame.
        coasting: [M] bool, nodes that moved on in the last frame though no camera saw what they carry.
        shown: [M], largest mean blending weight so far of what each node carries (`NodeGraph.mean_of_carried`).
        loss: image loss of the last frame with changes, without the mask term.
        masks: changed pixels of the last frame, from `Changes.advance`.
        screen_gradient: [N], mean screen gradient in the last frame.
        rig: predicts the nodes' step to the next frame; None: constant velocity.
        searched: the motion to the last frame was out of reach of the gradient, and a search has found it.
    """

    def __init__(
        self, graph: NodeGraph, own: Model, views: Views, settings: TrainSettings, numbers: np.ndarray, changes: Changes
    ):
        self.graph, self.own, self.pose, self.views = graph, own, Pose.rest(graph), views
        self.settings = replace(settings, mask_lambda=settings.tracking.mask_factor * settings.mask_lambda)
        self.radius, self.loss, self.keyframe_gradient = numbers.tolist()
        self.changes = changes
        self.moving = torch.zeros(len(own), dtype=torch.bool)
        self.coasting, self.shown = torch.zeros(len(graph), dtype=torch.bool), torch.zeros(len(graph))
        self.rig: RigPrediction | None = None
        self.searched = False

    @staticmethod
    def start(
        key: Model, views: Views, settings: TrainSettings, loss: float, frames: range, rig: Rig | None = None
    ) -> Tracker:
        """Tracks `key`, the keyframe of frames[0] with image loss `loss`; nodes are dense where frames[1] changes.
        `rig`: predicts their motion."""
        s, changes = settings.tracking, Changes.since(views, frames[0], settings.change_detection)
        stats, visible = Statistics(len(key), settings.keyframe.mse_min), []
        for result in view_losses(key.params, views, frames[0], settings):
            stats.add(result)
            visible.append(result.max_weight > s.visible_weight)
        means = key.params["means"]
        moving = np.ones(len(key), bool)
        if len(frames) > 1:
            changed = changes.behind(frames[1], changes.copy().advance(frames[1]), means.numpy(), visible)
            moving = changed if changed.any() else moving
        radius = subject_radius(means[moving].numpy())
        sizes = torch.ones(len(key))
        if not views.capture.has_alpha:  # there is a background
            sizes = key.params["log_scales"].sort(1).values[:, 1:].mean(1).exp()  # without the thin axis
        far = torch.from_numpy(changes.far(means.numpy()))
        graph = NodeGraph.of(means, sizes, radius, torch.from_numpy(moving), settings.graph, far)
        own = Model({**key.params, "means": torch.zeros_like(means)})
        gradient = float(torch.quantile(stats.mean_screen_gradient(), s.gradient_quantile))
        tracker = Tracker(graph, own, views, settings, np.array([radius, loss, gradient]), changes)
        tracker.rig = rig and RigPrediction(rig, frames[0], graph)
        weights = tracker._visible(tracker.model, frames[0])[1]
        tracker.shown = graph.mean_of_carried(weights, key.alive).nan_to_num(posinf=0.0)
        return tracker

    def carried(self, own: Model, pose: Pose) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Attributes of `own` carried to `pose`, as they are rendered, and the rotation of each Gaussian by the nodes,
        [N, 4]."""
        means, rotations = self.graph.carry(self.graph.means, pose)
        carried = {**own.params, "means": means + own.params["means"]}
        carried["quats"] = quat_product(rotations, own.params["quats"])
        if self.settings.turned_harmonics:
            carried[TURNS] = rotations
        return carried, rotations

    def _model(self, pose: Pose) -> Model:
        """The Gaussians in `pose`."""
        params, rotations = self.carried(self.own, pose)
        if TURNS in params:
            params["shN"] = harmonics_turned(params["shN"], rotations)
        return Model(params)

    @property
    def model(self) -> Model:
        """The Gaussians in the last frame."""
        return self._model(self.pose)

    @property
    def alive(self) -> torch.Tensor:
        """[N] bool: Gaussians that have not been removed."""
        return self.own.alive

    def advance(self, frame: int, on_step: OnStep = None) -> float | None:
        """Tracks on to `frame`, the next one.

        Returns:
            Image loss at the end, without the mask term. None: nothing has changed, or no Gaussian is left and no pixel
            needs one. Infinity: no Gaussian is left, and pixels need some.
        """
        if self.rig is not None:
            self.pose = self.rig.step(self.pose, self.graph, frame)
        self.searched = False
        self._look(frame)
        self.screen_gradient = torch.zeros(len(self.own))
        if not self.alive.any():
            return self._missing(frame)
        if self.moving.any():
            self._relocalize(frame)
            found = search(self, frame, self.settings.motion_search.ratio)
            self.pose, self.searched = found or self.pose, found is not None
            self._fit(frame, on_step)
        else:
            self.pose = self._coasted(self.coasting)
        faded = torch.sigmoid(self.own.params["logit_opacities"]) < self.settings.keyframe.prune_opacity
        outside = self.changes.outside(frame, self.model.params["means"].numpy())
        self._remove(torch.from_numpy(outside) | (self.moving & faded))
        if not self.alive.any():
            return self._missing(frame)
        return self.loss if self._changed else None

    @property
    def _changed(self) -> bool:
        """Whether the last frame differs from the one before."""
        return any(m.any() for m in self.masks)

    def _missing(self, frame: int) -> float | None:
        """Result of `advance` where no Gaussian is left."""
        return np.inf if self._changed and self.views.show(frame) else None

    def _fit(self, frame: int, on_step: OnStep) -> None:
        """Rounds of `motion_steps`, until the loss is near that of the frame before or falls no more. Stiff rounds come
        first if the velocity is unknown or from a search. After a search the nodes have another round before the
        Gaussians follow: otherwise colours change in place of the motion."""
        fit = FrameFit(self, np.random.default_rng([self.settings.seed, frame, 1]))
        s = self.settings.tracking
        bound, loss = s.loss_ratio * self.loss + s.loss_floor, np.inf
        small = self._of_usual(s.small_scale)
        stiff = [self._of_usual(s.searched_scale)] if self.searched else []
        stiff += [small] if self.searched or not self.pose.velocity.any() else []
        for scale in stiff:
            self._round(fit, frame, on_step, scale, stiff=True)
        if self.searched:
            self._round(fit, frame, on_step, 1.0, slow=True)
        for i in range(s.rounds_max):
            before, loss = loss, self._round(fit, frame, on_step, small if i == 0 else 1.0)
            if loss < bound or loss > s.progress_ratio * before:
                break
        self.own, self.pose = fit.result()
        self.loss = loss
        self.screen_gradient = fit.statistics.mean_screen_gradient()

    def _of_usual(self, scale: float) -> float:
        """`scale` for images of the usual size; less for larger images, by a power of 1/2 that makes them as small."""
        return scale * 0.5 ** max(0, round(math.log2(self.views.largest_side / self.settings.tracking.usual_side)))

    def _round(
        self, fit: FrameFit, frame: int, on_step: OnStep, scale: float, *, stiff: bool = False, slow: bool = False
    ) -> float:
        """`motion_steps` views at `scale` times their size in the first half, or, if `stiff`, in all steps; returns the
        image loss at the end. `stiff`, `slow`: see `FrameFit.step`."""
        s, steps = self.settings.tracking, self.settings.motion_steps
        losses = []
        for step in range(steps):
            now = scale if stiff or step < steps / 2 else 1.0
            decay = s.rate_decay ** (step / steps)
            losses.append(fit.step(self.views.draw(frame, now), decay, full=now == 1, stiff=stiff, slow=stiff or slow))
            if on_step:
                on_step(step, losses[-1])
        return float(np.mean(losses[-s.loss_window :]))

    def _relocalize(self, frame: int) -> None:
        """Moves each batch of new Gaussians that is lost to where `frame` shows it, or removes it."""
        batch, next_pose = self.graph.batch_of(), self.pose.next()
        for k in np.setdiff1d(batch[(self.moving & self.alive).numpy()], [0]):
            some = torch.from_numpy(batch == k) & self.alive
            model = self._model(next_pose)
            shift = relocalize(model, some, frame, self.changes, self.masks, self.settings)
            if shift is None:
                self._remove(some)
            else:
                self.moving |= some
                self.pose.velocity[torch.from_numpy(self.graph.batch == k)] += shift

    def _remove(self, removed: torch.Tensor) -> None:
        """Removes Gaussians ([N] bool) for good; they keep their index until the group ends."""
        self.own.params["logit_opacities"][removed] = REMOVED_LOGIT
        self.moving &= ~removed

    def select(self, chosen: torch.Tensor) -> None:
        """Keeps the Gaussians of `chosen` ([N] bool)."""
        self.graph.select(chosen)
        self.own.select(chosen)
        self.moving = self.moving[chosen]

    def adopt(self, group: GroupModel) -> None:
        """Continues from the last frame of the fine-tuned group. Moving Gaussians continue with smaller coefficients:
        coefficients that no picture needs would grow from group to group, and each group would pay again."""
        backend, last = self.views.backend, group.frames - 1
        frame, smaller = group.frame(last, backend), group.frame(last, backend, shrinkage=group.settings.shrinkage)
        new = group.origin < 0
        self.moving = torch.where(new, True, self.moving[group.origin])
        params = dict(frame.params)
        for n, p in params.items():
            params[n] = torch.where(self.moving.view(-1, *[1] * (p.dim() - 1)), smaller.params[n], p)
        rest = group.key.params["means"]
        self.graph, self.pose = group.graph.resting_at(rest), frame.pose
        self.own = self._own(params, *self.graph.carry(rest, frame.pose))

    def densify(self, frame: int, on_step: OnStep = None) -> None:
        """Adds new Gaussians that `frame` needs, after `advance`."""
        s, most = self.settings, self.settings.gaussians_max
        room = min(most - int(self.alive.sum()), s.tracking.stored_factor * most - len(self.own))
        gradient = self.screen_gradient / self.keyframe_gradient
        wrong = error_masks(self.model, self.masks, frame, self.views, s.densification)
        spawned = spawn(self.model, gradient, wrong, frame, self.views, s, room, on_step)
        if spawned is not None:
            self._add(spawned)

    def _add(self, spawned: Model) -> None:
        """Adds Gaussians that were made in the pose of the last frame."""
        params = spawned.params
        self.graph.extend(self._rest_positions(params["means"]))
        means, rotations = (x[len(self.own) :] for x in self.graph.carry(self.graph.means, self.pose))
        own = self._own(params, means, rotations)
        if self.settings.turned_harmonics:
            own.params["shN"] = harmonics_turned(own.params["shN"], rotations, back=True)
        self.own.append(own.params)
        self.moving = torch.cat([self.moving, torch.ones(len(spawned), dtype=torch.bool)])

    def _own(self, params: dict[str, torch.Tensor], means: torch.Tensor, rotations: torch.Tensor) -> Model:
        """Inverse of `carried`: the own attributes of Gaussians that the nodes carry to `means` by `rotations`;
        harmonics are not changed."""
        own = {**params, "means": params["means"] - means}
        own["quats"] = quat_product(rotations, params["quats"], inverse_a=True)
        return Model(own)

    def _rest_positions(self, means: torch.Tensor) -> torch.Tensor:
        """Rest positions [K, 3] of new Gaussians at `means` [K, 3]: beside the nearest Gaussian, whose nodes carry
        them, too.

        Gaussians far from all others get nodes of their own, which also carry the new Gaussians nearest to them.
        """
        from scipy.spatial import cKDTree

        s = self.settings.tracking
        params, rotations = self.carried(self.own, self.pose)
        old, rotations, rest = params["means"][self.alive], rotations[self.alive], self.graph.means[self.alive]
        spacing = np.median(cKDTree(means.numpy()).query(means.numpy(), 2)[0][:, 1])
        separate = torch.from_numpy(cKDTree(old.numpy()).query(means.numpy())[0] > s.separate_distance * spacing)
        first = len(self.graph)
        shift = self.graph.add_nodes(means[separate]) if separate.sum() >= s.separate_min else None
        if shift is not None:
            self.pose = self.pose.extended(self.graph.nodes[first:] - shift)
            added = torch.zeros(len(self.graph) - first)
            self.coasting, self.shown = torch.cat([self.coasting, added.bool()]), torch.cat([self.shown, added])
            old, rest = torch.cat([old, means[separate]]), torch.cat([rest, means[separate] + shift])
            rotations = torch.cat([rotations, rotvec_to_quat(torch.zeros(int(separate.sum()), 3))])
        near = torch.from_numpy(cKDTree(old.numpy()).query(means.numpy())[1])
        return rest[near] + rotate(quat_conjugate(rotations[near]), means - old[near])

    def changed_fraction(self, frame: int, before: torch.Tensor) -> float:
        """Fraction of the Gaussians that `frame`, the next one, changes, beyond those of `before` ([N] bool)."""
        masks, model = self.changes.copy().advance(frame), self.model
        if not (len(model) and any(m.any() for m in masks)):
            return 0.0
        behind = self.changes.behind(frame, masks, model.params["means"].numpy(), self._visible(model, frame)[0])
        return float((behind & ~before.numpy()).mean())

    def jumps(self, frame: int) -> bool:
        """Whether the moving Gaussians of the last frame are far from where their velocity leads them in `frame`, the
        next one, and a search finds them. False with a rig."""
        return self.rig is None and search(self, frame, self.settings.motion_search.jump_ratio) is not None

    def _look(self, frame: int) -> None:
        """Sets what `frame` changes: `masks`, `moving`, and `coasting` with the velocity of these nodes."""
        self.masks = self.changes.advance(frame)
        if not (self._changed or self.moving.any() or self.coasting.any()):
            self.moving = torch.zeros(len(self.own), dtype=torch.bool)
            return
        s, before = self.settings.tracking, self.coasting
        self._turn(before)
        model = self._model(self._coasted(before))
        visible, weights = self._visible(model, frame)
        self.moving = torch.from_numpy(self.changes.behind(frame, self.masks, model.params["means"].numpy(), visible))
        shown = self.graph.mean_of_carried(weights, self.alive)
        self.shown = torch.maximum(self.shown, shown.nan_to_num(posinf=0.0))
        lost = (self.pose.velocity.any(1) | self.pose.angular_velocity.any(1)) & (shown < s.leaving_share * self.shown)
        if lost.any():
            there, share = self.pose.next(), torch.where(before, s.leaving_share, s.hidden_share)
            ahead = self._visible(self._model(there), frame)[1]
            lost &= self.graph.mean_of_carried(ahead, self.alive) < share * self.shown
            lost &= torch.from_numpy(self.changes.within(frame, there.nodes.numpy()))  # else they would never be found
        lost = self.graph.among(lost)  # others are at the rim of what is hidden, or behind a fold of their own surface
        nearest = torch.from_numpy(self.graph.neighbors[:, 0].astype(np.int64))
        found = (before & ~lost)[nearest]  # must fit the pictures, even if they have not changed here
        self.moving = (self.moving | found) & ~lost[nearest]
        self.coasting = lost & ~self.graph.carriers(self.moving)
        self._turn(self.coasting & ~before)

    def _turn(self, nodes: torch.Tensor) -> None:
        """Turns the velocity of `nodes` ([M] bool) by a frame of their rotation, so that they go around a curve. A rig
        knows their velocity."""
        if self.rig is None:
            turned = rotate(rotvec_to_quat(self.pose.angular_velocity), self.pose.velocity)
            self.pose = replace(self.pose, velocity=torch.where(nodes[:, None], turned, self.pose.velocity))

    def _coasted(self, nodes: torch.Tensor) -> Pose:
        """The pose a frame later, in which `nodes` ([M] bool) have their velocity and others stand still."""
        velocity = {n: nodes[:, None] * getattr(self.pose, n) for n in ("angular_velocity", "velocity")}
        return replace(self.pose, **velocity).next()

    def _visible(self, model: Model, frame: int) -> tuple[list[np.ndarray], torch.Tensor]:
        """Gaussians of `model` that each training camera sees at `frame`, [N] bool, and the largest blending weight of
        each Gaussian in any of them, [N]."""
        s = self.settings.tracking
        visible, weights = [], np.zeros(len(model), np.float32)
        for result in view_losses(model.params, self.views, frame, self.settings, self._of_usual(s.small_scale)):
            visible.append(result.max_weight > s.visible_weight)
            weights = np.maximum(weights, result.max_weight)
        return visible, torch.from_numpy(weights)

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint."""
        own = {f"own.{n}": p.numpy() for n, p in self.own.params.items()}
        pose = {f"pose.{f.name}": getattr(self.pose, f.name).numpy() for f in fields(Pose)}
        fitted = {f"fitted.{i}": image for i, image in enumerate(self.changes.fitted)}
        graph = {f"graph.{n}": a for n, a in self.graph.state().items()}
        numbers = np.array([self.radius, self.loss, self.keyframe_gradient])
        rig = {} if self.rig is None else {"at_rest": np.array(self.rig.at_rest)}
        last = {n: getattr(self, n).numpy() for n in ("moving", "coasting", "shown")}
        return {"numbers": numbers, **last, **rig, **graph, **own, **pose, **fitted}

    @staticmethod
    def restored(
        state: dict[str, np.ndarray], views: Views, settings: TrainSettings, rig: Rig | None = None
    ) -> Tracker:
        """Inverse of `state`."""
        own = Model({n: torch.from_numpy(state[f"own.{n}"]) for n in NAMES})
        graph = {n.removeprefix("graph."): a for n, a in state.items() if n.startswith("graph.")}
        fitted = [state[f"fitted.{i}"] for i in range(len(views.train_cameras))]
        changes = Changes(views, fitted, settings.change_detection)
        tracker = Tracker(NodeGraph.restored(graph, settings.graph), own, views, settings, state["numbers"], changes)
        tracker.pose = Pose(*(torch.from_numpy(state[f"pose.{f.name}"]) for f in fields(Pose)))
        for n in ("moving", "coasting", "shown"):
            setattr(tracker, n, torch.from_numpy(state[n]))
        tracker.rig = rig and RigPrediction(rig, int(state["at_rest"]), tracker.graph)
        return tracker
