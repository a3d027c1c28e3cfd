"""Motion search: finds a subject that has moved out of reach of the gradient.

In: a tracker before it fits a frame. Out: its pose with another velocity, if one fits that frame much better than
constant velocity. Small pictures of some views are compared. First the whole subject is one rigid body, then each of
some parts is one. From several rotations (the starts) a few gradient steps bring all parts to the nearest fit; each
part takes the one of these motions with which the pictures fit best.

If a large error remains, limbs have swung out of reach, which the gradient hides behind the rest. Small cells are lost
if the pictures fit better without them. Lost cells beside each other are one limb, which is rotated about either end of
its longest axis to all directions. Other motion is left to the fit of the frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..farthest_point_sampling import farthest_points
from ..model.camera import fibonacci_directions
from ..model.rotations import quat_multiply, quat_to_rotvec, rotate, rotvec_to_quat
from ..render.optimizer import Adam
from .deformation_graph import Pose
from .model import REMOVED_LOGIT, quat_product
from .views import Target, photometric_loss_value, start_photometric_loss

if TYPE_CHECKING:
    from .tracking import Tracker

END = 1.5  # standard deviations from the middle of a limb to its end: sqrt(3) for a rod


def search(tracker: Tracker, frame: int, ratio: float) -> Pose | None:
    """The pose of `tracker`, in the frame before `frame`, with the velocity that fits `frame` best. None: constant
    velocity fits well enough (its loss is less than `ratio` times that of the frame before), or the best motion lowers
    the loss by little: with few views, any frame is fitted far better than the next one, however slow the motion is."""
    if not tracker.moving.any() or not tracker.views.show(frame):  # no moving Gaussians or no subject
        return None
    s, whole = tracker.settings.motion_search, _Bodies(tracker, tracker.pose, frame, 1)
    usual, before = whole.loss(whole.still), whole.loss_before()
    if usual < ratio * before:
        return None
    rigid = whole.best_pose(usual) or tracker.pose
    parts = _Bodies(tracker, rigid, frame, s.parts)
    found = parts.best_pose(parts.loss(parts.still)) or rigid
    least = _loss(tracker, found, frame)
    if least > s.limb_ratio * before:
        limbs = _with_limbs(tracker, rigid, frame)
        if (loss := _loss(tracker, limbs, frame)) < s.gain * least:
            found, least = limbs, loss
    return found if usual - least > s.gain_min * before else None


def _loss(tracker: Tracker, pose: Pose, frame: int) -> float:
    """Loss after the step of `pose`."""
    there = _Bodies(tracker, pose, frame, 1)
    return there.loss(there.still)


def _with_limbs(tracker: Tracker, pose: Pose, frame: int) -> Pose:
    """`pose` with another velocity, which moves lost limbs to where they fit best."""
    s = tracker.settings.motion_search
    for _ in range(s.limb_rounds):
        cells = _Bodies(tracker, pose, frame, s.cells)
        cells.join(cells.limbs())
        motion = cells.still
        for limb in range(1, len(motion)):
            motion = cells.with_limb(motion, limb)
        pose = cells.pose(motion)
    parts = _Bodies(tracker, pose, frame, s.parts)
    fitted = parts.fitted(parts.still)
    return parts.pose(fitted) if parts.loss(fitted) < parts.loss(parts.still) else pose


def _starts(turn: float) -> np.ndarray:
    """Motions [7, 6] of one part: none, and rotations by `turn` radians either way about each axis."""
    turns = np.concatenate([np.zeros((1, 3)), turn * np.eye(3), -turn * np.eye(3)])
    return np.pad(turns, ((0, 0), (0, 3))).astype(np.float32)


class _Bodies:
    """The moving Gaussians of a tracker, one frame after `pose` at its velocity and without far background, as `parts`
    rigid bodies; and small views of `frame`. A motion [parts, 6] has for each part a rotation vector about its center
    and a translation in radii; `still` is 0."""

    def __init__(self, tracker: Tracker, pose: Pose, frame: int, parts: int):
        self.tracker, self.settings, self._pose, self._frame = tracker, tracker.settings.motion_search, pose, frame
        views = tracker.views
        places = np.stack([views.camera(i, frame).center for i in views.train_cameras])
        chosen = sorted(farthest_points(places, min(self.settings.views, len(places))))
        self._cameras = [views.train_cameras[i] for i in chosen]
        self._scale = min(1.0, self.settings.side / views.largest_side)
        self._params = tracker.carried(tracker.own, pose.next())[0]
        means = self._params["means"]
        self._middle = means[tracker.moving].median(0).values
        self._reach = self.settings.reach * float((means[tracker.moving] - self._middle).norm(dim=1).median())
        self._moving = tracker.moving & self._near(means)
        self._means = means[self._moving]
        self._seeds = self._means[torch.from_numpy(farthest_points(self._means.numpy(), parts)).long()]
        self.join(np.arange(len(self._seeds)))

    def join(self, part: np.ndarray) -> None:
        """Merges parts: `part` is the new index of each part."""
        self._of_seed, count = torch.from_numpy(part), int(part.max()) + 1
        self._part = self._nearest(self._params["means"])
        of_moving = self._part[self._moving]
        members = torch.bincount(of_moving, minlength=count).clamp(min=1)[:, None]
        self._centers = torch.zeros(count, 3).index_add(0, of_moving, self._means) / members
        self.still = np.zeros((count, 6), np.float32)

    def limbs(self) -> np.ndarray:
        """[parts] int, limb of each part, from 1, if the pictures fit better without the part; else 0. Limbs lie apart
        from each other."""
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        part, limb = self._part[self._moving].numpy(), np.zeros(len(self.still), int)
        present = self._loss(self._params, self._frame)
        worth = [self._loss(self._without(k), self._frame) - present for k in range(len(limb))]
        lost = sorted((k for k in range(len(limb)) if worth[k] < 0 and (part == k).any()), key=worth.__getitem__)
        if lost:
            means = self._means.numpy()
            link = self.settings.link * np.median(cKDTree(means).query(means, 2)[0][:, 1])
            points = [means[part == k] for k in lost]
            beside = [[tree.query(p)[0].min() < link for p in points] for tree in map(cKDTree, points)]
            label = connected_components(np.array(beside), directed=False)[1]
            limb[lost] = np.where(label < self.settings.limbs_max, label + 1, 0)
        return limb

    def with_limb(self, motion: np.ndarray, limb: int) -> np.ndarray:
        """`motion`, with part `limb` in its best direction if that lowers the loss."""
        least, s = self.loss(motion), self.settings
        best, only = motion, np.zeros((len(motion), 1), np.float32)
        only[limb] = 1
        tried = [motion + only * turn for turn in self._turns(limb)]
        for start in sorted(tried, key=self.loss)[: s.limb_starts]:
            found = self.fitted(start, only)
            if (loss := self.loss(found)) < least:
                best, least = found, loss
        return best

    def _turns(self, part: int) -> list[np.ndarray]:
        """Motions [6] of a part: none, and about either end of its longest axis to directions within `limb_turn`."""
        center, turns = self._centers[part].numpy().astype(float), [np.zeros(6, np.float32)]
        points = self._means[self._part[self._moving] == part].numpy() - center
        _, sizes, axes = np.linalg.svd(points, full_matrices=False)
        half = END * sizes[0] / np.sqrt(len(points))
        directions = fibonacci_directions(self.settings.directions) * (1, -1, 1)  # mirrored, as in the measurements
        for arm in (half * axes[0], -half * axes[0]):  # from the end to the center
            for direction in half * directions:
                axis = np.cross(arm, direction)
                angle = np.arctan2(np.linalg.norm(axis), arm @ direction)
                if 0 < angle < self.settings.limb_turn:
                    turn = angle / np.linalg.norm(axis) * axis
                    turns.append(np.r_[turn, (direction - arm) / self.tracker.radius].astype(np.float32))
        return turns

    def _without(self, part: int) -> dict[str, torch.Tensor]:
        """The Gaussians without those of a part."""
        gone = self._moving & (self._part == part)
        opacities = torch.where(gone, REMOVED_LOGIT, self._params["logit_opacities"])
        return {**self._params, "logit_opacities": opacities}

    def _near(self, points: torch.Tensor) -> torch.Tensor:
        """[P] bool: `points` [P, 3] that are not far background."""
        return (points - self._middle).norm(dim=1) <= self._reach

    def _nearest(self, points: torch.Tensor) -> torch.Tensor:
        """[P] int, part of each of `points` [P, 3]."""
        return self._of_seed[torch.cdist(points, self._seeds).argmin(1)]

    def _targets(self, frame: int) -> list[Target]:
        return [self.tracker.views.target(i, frame, self._scale) for i in self._cameras]

    def _loss(self, params: dict, frame: int) -> float:
        """Loss of the small views of `frame`."""
        t, rng = self.tracker, np.random.default_rng(0)
        return photometric_loss_value(params, self._targets(frame), t.settings, rng, t.views.backend)

    def loss_before(self) -> float:
        """Loss of the frame before, as it was fitted."""
        return self._loss(self.tracker.model.params, self._frame - 1)

    def loss(self, motion: np.ndarray) -> float:
        """Loss after a motion."""
        return self._loss(self._moved(motion), self._frame)

    def _turned(self, motion: np.ndarray, points: torch.Tensor, part: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """`points` [P, 3] of the parts `part` [P] after a motion, and their rotations [P, 4]."""
        values = torch.from_numpy(motion)
        turn, shift = rotvec_to_quat(values[:, :3])[part], self.tracker.radius * values[part, 3:]
        center = self._centers[part]
        return rotate(turn, points - center) + center + shift, turn

    def _moved(self, motion: np.ndarray) -> dict[str, torch.Tensor]:
        p = self._params
        means, turn = self._turned(motion, p["means"], self._part)
        moved = {"means": means, "quats": quat_product(turn.contiguous(), p["quats"])}
        return {**p, **{n: torch.where(self._moving[:, None], x, p[n]) for n, x in moved.items()}}

    def fitted(self, motion: np.ndarray, only: np.ndarray | float = 1.0) -> np.ndarray:
        """The motion that some gradient steps reach from `motion`; `only`: [parts, 1], 1 for parts that may move."""
        t, s = self.tracker, self.settings
        values, adam = {"motion": motion.copy()}, Adam(t.views.backend, t.settings.tracking.node_adam)
        targets = self._targets(self._frame)
        for step in range(s.steps):
            params = self._moved(values["motion"])
            rng = np.random.default_rng(0)  # the backgrounds of all trials are the same
            grads = start_photometric_loss(params, targets, t.settings, rng, t.views.backend)().grads
            by_means, by_quats = (grads[n] * self._moving[:, None] for n in ("means", "quats"))
            arm = params["means"] - self._centers[self._part]
            arm = arm - t.radius * torch.from_numpy(values["motion"])[self._part, 3:]
            torque = torch.linalg.cross(arm, by_means)
            torque += 0.5 * quat_product(by_quats, params["quats"], inverse_b=True)[:, 1:]
            by = torch.zeros(len(motion), 6).index_add(0, self._part, torch.cat([torque, t.radius * by_means], 1))
            adam.step(values, {"motion": only * by.numpy()}, {"motion": s.rate * s.rate_decay ** (step / s.steps)})
        return values["motion"]

    def chosen(self, start: float, found: list[np.ndarray]) -> np.ndarray:
        """The best motion found: each part moves as in one of `found` or in `still`, whose loss is `start`."""
        s, still = self.settings, self.still
        losses = [self.loss(m) for m in found]
        best, least = min(zip(found, losses, strict=True), key=lambda x: x[1])
        if least > s.gain * start:
            best, least = still, start
        if len(still) == 1:
            return best
        changed = False
        for part in range(len(still)):
            for other in [*found, still]:
                tried = best.copy()
                tried[part] = other[part]
                if (loss := self.loss(tried)) < least:
                    best, least, changed = tried, loss, True
        return self.fitted(best) if changed and least < s.gain * start else best

    def best_pose(self, start: float) -> Pose | None:
        """The pose with the motion that fits best; None: that is `still`, whose loss is `start`."""
        found = [self.fitted(self.still + motion) for motion in _starts(self.settings.turn)]
        best = self.chosen(start, found)
        return None if best is self.still else self.pose(best)

    def pose(self, motion: np.ndarray) -> Pose:
        """The pose of the tracker with a velocity that includes `motion`."""
        there = self._pose.next()
        nodes, turn = self._turned(motion, there.nodes, self._nearest(there.nodes))
        whole = quat_multiply(turn, rotvec_to_quat(self._pose.angular_velocity))
        carriers = (self.tracker.graph.carriers(self._moving) & self._near(there.nodes))[:, None]
        return replace(
            self._pose,
            angular_velocity=torch.where(carriers, quat_to_rotvec(whole), self._pose.angular_velocity),
            velocity=torch.where(carriers, nodes - self._pose.nodes, self._pose.velocity),
        )
