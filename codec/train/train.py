"""Capture -> groups of tracked Gaussians: keyframe, tracking, fine-tuning, group after group.

Each group is yielded when it is done, so that it is encoded and safe on disk while the next one trains. A checkpoint
after each group holds the state that the next one starts from; a run that was stopped continues from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path

import numpy as np
import torch

from ..bitstream.quantization import steps_for
from ..model.gaussians import Gaussians
from ..model.parametric_group import ParametricGroup
from ..model.rig import Rig
from ..render.backend import Backend
from ..render.cpu import CpuBackend
from ..render.sensitivity import measured_steps
from .budget import keyframe_budget, with_frame_budget
from .checkpoint import Checkpoint
from .deformation_graph import Pose
from .finetune import GroupModel
from .initialization import initial_model
from .joint_optimization import finetune, views_to_draw
from .keyframe import train_keyframe
from .model import Model
from .settings import TrainSettings
from .subject import Subject
from .tracking import Tracker
from .views import Views


@dataclass
class Progress:
    """Progress of a run.

    Attributes:
        total, done: optimisation steps; the total is an estimate while groups may be cut.
        stage: a word and the frames, such as "track 7".
        loss: of the last step.
    """

    total: int
    done: int = 0
    stage: str = ""
    loss: float = 0.0


def train_groups(
    capture,
    settings: TrainSettings,
    *,
    first_frame: int = 0,
    random_access: int = 0,
    rig: Rig | None = None,
    checkpoints: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    backend: Backend | None = None,
) -> Iterator[ParametricGroup]:
    """Trains `capture` from `first_frame` on and yields each group when it is done.

    A group continues the Gaussians of the one before (`parents`). It ends early before a frame whose image loss is
    `cut_ratio` times that of the tracked frame before, or `drift_ratio` times that of the keyframe (unless few frames
    are left), or which shows `shown_ratio` times as many pixels of the scene as the keyframe; then the next group
    starts with a keyframe.
    It also ends before a frame in which a large fraction of the Gaussians begins to change, or the moving ones jump.
    Frames in which no camera sees a subject, up to the next frame with one, are a group without Gaussians.
    Every segment of `random_access` frames starts with a keyframe: a segment depends on no frames but its own.

    Args:
        first_frame: where an earlier run stopped, the first frame of a group.
        random_access: see `segments`.
        rig: predicts the motion in all frames of the capture.
        checkpoints: folder of the states that groups start from; None: nothing is written.
        on_progress: called after every step.
        backend: device that renders and optimises; a new CpuBackend if None.

    Raises:
        CaptureError: a frame cannot be read, or no view overlaps another.
    """
    store = Checkpoint(checkpoints)
    run = _Run(capture, settings, backend or CpuBackend(), on_progress, rig)
    if not first_frame:
        store.clear()  # an earlier run with other settings may have left states
    state = store.load(first_frame) if first_frame else None  # absent after a cut, too
    if state is not None:
        run.subject = Subject.restored(state, run.views, run.settings, rig)
    start = first_frame
    for segment in segments(capture.frame_count, settings.gop, random_access):
        while start < segment.stop:
            run.estimate(capture.frame_count - start)
            group = run.group(range(start, min(start + settings.gop, segment.stop)), segment.stop)
            calibration = run.views.calibration(range(start, start + len(group)))
            start += len(group)
            if start == segment.stop:
                run.subject = None
            store.save(start, run.subject.state() if run.subject else None)
            yield replace(group, calibration=calibration)


def segments(frame_count: int, gop: int, random_access: int) -> list[range]:
    """Ranges of frames that are trained independently of each other: `random_access` frames each, or `gop` if that is
    longer; 0: all frames in one."""
    length = max(random_access, gop) if random_access else max(frame_count, 1)
    return [range(a, min(a + length, frame_count)) for a in range(0, frame_count, length)]


class _Run:
    """State that the groups of one run share. `subject` is None where the next frame needs a keyframe."""

    def __init__(self, capture, settings: TrainSettings, backend: Backend, on_progress, rig: Rig | None):
        self.capture, self.on_progress, self.rig = capture, on_progress, rig
        self.views = Views(capture, settings, backend)
        first = next((t for t in range(capture.frame_count) if self.views.show(t)), 0)  # the same in every segment
        self.settings = with_frame_budget(settings.of_capture(capture), self.views, first)
        self.progress = Progress(0)
        self.subject: Subject | None = None

    def estimate(self, frames: int) -> None:
        """Sets the total of the progress; `frames`: left to train, if no group is cut."""
        s = self.settings
        key = s.keyframe.in_all(s.keyframe_steps) if self.subject is None else 0
        finetune = s.finetune_steps if s.gop > 1 else 0
        self.progress.total = self.progress.done + key + frames * (s.motion_steps + finetune)

    def _report(self, stage: str) -> Callable[[int, float], None]:
        """Callback of a stage, called with (step, loss)."""

        def on_step(_, loss):
            p = self.progress
            p.done, p.stage, p.loss = p.done + 1, stage, float(loss)
            p.total = max(p.total, p.done)
            if self.on_progress:
                self.on_progress(p)

        return on_step

    def group(self, frames: range, stop: int) -> ParametricGroup:
        """Trains one group, of all `frames` or of the first ones; Gaussians are followed up to frame `stop` at most."""
        track = _TrackedFrames()
        self.views.restart_order()
        ended = "" if self.subject is None else self._track(frames, stop, track)
        parents = self.subject.parents if track.models else None
        if parents is None:  # no Gaussians to track, or cut at once
            self.subject = None
            if empty := len(list(takewhile(lambda frame: not self.views.show(frame), frames))):
                return ParametricGroup(empty, Gaussians.none(), ended="empty" if empty < len(frames) else "")
            self.subject = self._keyframe(frames)
            track.add(self.subject.tracker)
            ended = self._track(frames[1:], stop, track)
        subject, done = self.subject, frames[: len(track.models)]
        if ended not in ("", "change", "jump"):
            self.subject = None
        if len(done) == 1 and parents is None:
            subject.canonical = track.models[0]
            subject.parents = np.arange(len(subject.canonical))
            turned = self.settings.turned_harmonics
            return ParametricGroup(1, subject.canonical.gaussians(), ended=ended, turned_harmonics=turned)
        model = self._finetuned(subject, done, track)
        subject.tracker.adopt(model)
        known = len(model.key) if parents is None else len(parents)
        new = np.full(len(model.key) - known, -1)
        group = model.group(None if parents is None else np.append(parents, new).astype(np.int32))
        if subject.tracker.rig is not None:
            predicted = subject.tracker.rig.motion(len(group.nodes.positions), done)
            group = replace(group, nodes=replace(group.nodes, rig=predicted))
        group = replace(group, ended=ended)
        subject.start_next_group(model.key)
        if not len(subject.parents):
            self.subject = None
        return group

    def _keyframe(self, frames: range) -> Subject:
        """A new subject from the first of `frames`."""
        s = self.settings
        budget = keyframe_budget(self.views, frames[0], s)
        steps, before = s.keyframe.in_all(budget.steps), self.progress.done
        self.progress.total += steps - s.keyframe.in_all(s.keyframe_steps)
        model, radius = initial_model(self.capture, frames[0], budget.points, s, self.views.view)
        on_step = self._report(f"keyframe {frames[0]}")
        loss = train_keyframe(model, self.views, frames[0], s, steps=budget.steps, radius=radius, on_step=on_step)
        self.progress.total -= steps - (self.progress.done - before)  # without neighbours there are no teachers
        tracker = Tracker.start(model, self.views, s, loss, frames, self.rig)
        return Subject(tracker, frames[0], loss, radius, self._shown(frames[0]))

    def _shown(self, frame: int) -> float:
        """Pixels of the scene in the pictures of a frame, the median of the views."""
        return float(np.median(self.views.covered(frame)))

    def _track(self, frames: range, stop: int, track: _TrackedFrames) -> str:
        """Tracks `frames` up to the end of the group and adds them to `track`; returns why the group ended early
        (`ParametricGroup.ended`). After all reasons except "change" and "jump" the next group needs a keyframe.

        The group ends where a large fraction of resting Gaussians changes at once: with few temporal frequencies, a
        light that is switched on would show in all frames of the group, and Gaussians that were frozen without it show
        it badly. A jump after frames that were tracked without a search would show in all frames, too. Where a keyframe
        has lasted long, the few frames left before `stop` lose little more by drift, and do not pay for another
        keyframe.
        """
        subject, g = self.subject, self.settings.group
        for frame in frames:
            if self._shown(frame) > g.shown_ratio * subject.shown:
                return "more"
            long_enough = len(track.models) >= g.changed_frames_min
            followed = not any(track.searched[-g.changed_frames_min :])
            if long_enough and subject.tracker.changed_fraction(frame, track.moved()) > g.changed_fraction_max:
                return "change"
            if long_enough and followed and subject.tracker.jumps(frame):
                return "jump"
            near, far = self.settings.cut_ratio * subject.tracker.loss, g.drift_ratio * subject.loss
            if subject.tracker.loss == subject.loss:  # the keyframe's own loss, which no tracked frame comes near
                near = far
            if stop - frame < g.drift_share * (frame - subject.first):
                far = np.inf
            loss = subject.tracker.advance(frame, self._report(f"track {frame}"))
            if loss is not None and loss > min(near, far) + g.cut_loss_floor:
                return "cut" if near <= far else "drift"
            if loss is not None:
                subject.tracker.densify(frame, self._report(f"densify {frame}"))
            track.add(subject.tracker)
        return ""

    def _finetuned(self, subject: Subject, frames: range, track: _TrackedFrames) -> GroupModel:
        """The fine-tuned model of a group."""
        quality = self.settings.quality
        if subject.steps is None:
            t = track.fullest()
            cameras = [self.capture.camera(i, frames[t]) for i in self.views.train_cameras]
            nominal, g = steps_for(quality, subject.radius), track.models[t].gaussians()
            subject.steps = measured_steps(g, quality, nominal, cameras, backend=self.views.backend)
        graph, steps = subject.tracker.graph, subject.steps
        settings = self.settings.of_fast_motion(float(np.mean(track.searched)))
        model = GroupModel(graph, subject.canonical, track.models, track.poses, steps, track.moved(), settings)
        self.progress.total += views_to_draw(model, settings) - self.settings.finetune_steps * len(frames)
        on_step = self._report(f"fine-tune {frames[0]}-{frames[-1]}")
        finetune(model, self.views, frames, settings, radius=subject.tracker.radius, on_step=on_step)
        return model


@dataclass
class _TrackedFrames:
    """For each frame of a group the Gaussians, the pose of the nodes, the moving Gaussians ([N] bool), and whether a
    search has found them (`Tracker.searched`)."""

    models: list[Model] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    moving: list[torch.Tensor] = field(default_factory=list)
    searched: list[bool] = field(default_factory=list)

    def add(self, tracker: Tracker) -> None:
        """Adds the last frame of `tracker`."""
        self.models.append(tracker.model)
        self.poses.append(tracker.pose)
        self.moving.append(tracker.moving)
        self.searched.append(tracker.searched)

    def fullest(self) -> int:
        """The frame in which most Gaussians live; of several frames the one nearest to the middle."""
        living = [int(m.alive.sum()) for m in self.models]
        return max(range(len(living)), key=lambda t: (living[t], -abs(t - len(living) // 2)))

    def moved(self) -> torch.Tensor:
        """Gaussians that have moved in any frame, [N] bool."""
        moved = torch.ones(len(self.moving[-1]), dtype=torch.bool)  # new Gaussians move
        moved[: len(self.moving[0])] = False
        for moving in self.moving:
            moved[: len(moving)] |= moving
        return moved
