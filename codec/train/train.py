"""Capture -> groups of tracked Gaussians: keyframe, motion, joint fine-tuning, group after group.

Groups come out one at a time, so that they are encoded and safe on disk while the next one trains. After each, a
checkpoint holds what the next one starts from; a run that stops goes on there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from ..atomic_write import read_arrays, write_arrays
from ..bitstream.quantization import Steps, steps_for, subject_radius
from ..errors import CaptureError
from ..model.parametric_group import ParametricGroup
from ..render.backend import Backend
from ..render.cpu import CpuBackend
from ..render.sensitivity import measured_steps
from .deformation_graph import Pose
from .finetune import GroupModel, finetune
from .keyframe import train_keyframe
from .model import NAMES, Model, from_points
from .plane_sweep import shell, sweep
from .settings import TrainSettings
from .tracking import Tracker
from .views import Views
from .visual_hull import carve, random_box


@dataclass
class Progress:
    """Where a run is: `done` of `total` steps; `stage` in words, `loss` of the last step."""

    total: int
    done: int = 0
    stage: str = ""
    loss: float = 0.0
    started: float = 0.0

    def eta(self) -> float:
        """Seconds left at the pace so far."""
        return (time.monotonic() - self.started) * (self.total - self.done) / max(self.done, 1)


def initial_model(capture, frame: int, settings: TrainSettings) -> Model:
    """Gaussians from the visual hull of the masks, or a plane sweep where there are none, or at random.

    Raises:
        CaptureError: nothing to start from.
    """
    cameras = capture.indices("train")
    if not cameras:
        raise CaptureError(f"{capture.name}: no training camera, expected at least one with split 'train'")
    i, views = settings.initialization, []
    for camera in cameras:
        v = capture.view(camera, frame)
        views.append((capture.camera(camera, frame), v.rgb, v.alpha))
    known = [c for c, _, _ in views]
    if all(alpha is not None for _, _, alpha in views):
        points, colors = carve(known, views, settings.initial_points, settings.visual_hull)
        if len(points):
            return from_points(points, colors, opacity=i.surface_opacity)
    if i.use_plane_sweep:
        points, colors = sweep(views, settings.initial_points, settings.seed, settings.plane_sweep)
        if len(points) >= i.sweep_min_share * settings.initial_points:
            surface = zip((points, colors), shell(views, settings.plane_sweep), strict=True)
            return from_points(*(np.concatenate(pair) for pair in surface), opacity=i.surface_opacity)
    points, colors = random_box(known, views, settings.initial_points, settings.seed, settings.visual_hull)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=i.random_opacity)


class Checkpoint:
    """What the group after the last finished one starts from, on disk."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def _path(self, next_frame: int) -> Path:
        return self.folder / f"before_{next_frame:06d}.npz"

    def save(self, next_frame: int, subject: Subject | None) -> None:
        """Writes the subject as it is before `next_frame`, atomically; None needs no file. Of the older ones the last
        stays, since the stream may not have the group between them yet."""
        if self.folder is None or subject is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        write_arrays(self._path(next_frame), subject.state())
        for path in sorted(p for p in self.folder.glob("before_*.npz") if p < self._path(next_frame))[:-1]:
            path.unlink()

    def load(self, next_frame: int) -> dict | None:
        """The state that `save` wrote for `next_frame`, or None."""
        return None if self.folder is None else read_arrays(self._path(next_frame))

    def clear(self) -> None:
        """Removes the folder: the run is complete, or another one begins."""
        if self.folder is not None and self.folder.is_dir():
            for path in self.folder.glob("before_*"):
                path.unlink()
            self.folder.rmdir()


@dataclass
class Subject:
    """What lasts from group to group: Gaussians that are being followed.

    Attributes:
        tracker: where they are in the last frame.
        loss: image loss of their keyframe, which tells when they no longer serve.
        radius: of all Gaussians in the keyframe, world units.
        canonical: what all groups since the keyframe refer to; None before the first one is fine-tuned.
        parents: [N], where each Gaussian is in the group before.
        steps: of the stream, for all groups since the keyframe; None before the first one is fine-tuned.
    """

    tracker: Tracker
    loss: float
    radius: float
    canonical: Model | None = None
    parents: np.ndarray | None = None
    steps: Steps | None = None

    def bury(self, canonical: Model) -> None:
        """Goes on with `canonical`, all Gaussians of a group, but for the dead."""
        alive = self.tracker.alive
        self.parents = np.flatnonzero(alive.numpy())
        self.tracker.keep(alive)
        self.canonical = Model({n: p[alive] for n, p in canonical.params.items()})

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays."""
        canonical = {f"canonical.{n}": p.numpy() for n, p in self.canonical.params.items()}
        gains, poses = self.tracker.views.exposure, self.tracker.views.extrinsics
        cameras = {"exposure": gains.values, "extrinsics": poses.values, "middle": poses.middle}
        whole = {"loss_radius": np.array([self.loss, self.radius]), "parents": self.parents}
        whole["steps"] = np.array([] if self.steps is None else astuple(self.steps))
        return {**whole, **cameras, **canonical, **self.tracker.state()}

    @staticmethod
    def restored(state: dict[str, np.ndarray], views: Views, settings: TrainSettings) -> Subject:
        """Inverse of `state`."""
        canonical = {n: torch.from_numpy(state[f"canonical.{n}"]) for n in NAMES}
        loss, radius = state["loss_radius"].tolist()
        views.exposure.values, views.extrinsics.values = state["exposure"], state["extrinsics"]
        views.extrinsics.about(state["middle"], radius)
        steps = Steps(*state["steps"].tolist()) if len(state["steps"]) else None
        tracker = Tracker.restored(state, views, settings)
        return Subject(tracker, loss, radius, Model(canonical), state["parents"], steps)


def train_groups(
    capture,
    settings: TrainSettings,
    *,
    first_frame: int = 0,
    random_access: int = 0,
    checkpoints: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    backend: Backend | None = None,
) -> Iterator[ParametricGroup]:
    """Trains `capture` from `first_frame` on and yields each group when it is done.

    A group continues the Gaussians of the one before (`parents`) as long as they serve; where the image loss of a
    tracked frame is `cut_ratio` times the keyframe's, the group ends and the next one starts anew. Where much that
    stood still begins to change at once, it ends, and the next one continues. Every segment of `random_access` frames
    starts anew, too: segments depend on nothing but their own frames.

    Args:
        first_frame: where an earlier run stopped; a group starts there.
        random_access: see `segments`.
        checkpoints: folder for what the next group starts from; None keeps it in memory only.
        on_progress: called after every step.
        backend: device that renders and optimises; a new CpuBackend if None.

    Torch handles only small tensors here, and its threads compete with those of the native kernels: a caller gains by
    `torch.set_num_threads(1)`, as the commands do. The number of threads changes sums in their last bits.

    Raises:
        CaptureError: a frame cannot be read, or no view overlaps another.
    """
    store = Checkpoint(checkpoints)
    run = _Run(capture, settings, backend or CpuBackend(), on_progress)
    if not first_frame:
        store.clear()  # what an earlier run with other settings may have left
    state = store.load(first_frame) if first_frame else None  # absent after a cut, too
    if state is not None:
        run.subject = Subject.restored(state, run.views, settings)
    start = first_frame
    for segment in segments(capture.frame_count, settings.gop, random_access):
        while start < segment.stop:
            run.estimate(capture.frame_count - start)
            group = run.group(range(start, min(start + settings.gop, segment.stop)))
            start += len(group)
            if start == segment.stop:
                run.subject = None
            store.save(start, run.subject)
            yield replace(group, calibration=run.views.calibration())


def segments(frame_count: int, gop: int, random_access: int) -> list[range]:
    """Frames that are trained without a look at others: `random_access` of them, or a group where that is longer, each;
    all in one where it is 0."""
    length = max(random_access, gop) if random_access else max(frame_count, 1)
    return [range(a, min(a + length, frame_count)) for a in range(0, frame_count, length)]


class _Run:
    """What the groups of one run share. `subject` is None where the next frame needs a keyframe."""

    def __init__(self, capture, settings: TrainSettings, backend: Backend, on_progress):
        self.capture, self.settings, self.on_progress = capture, settings, on_progress
        self.views = Views(capture, settings, backend)
        self.progress = Progress(0, started=time.monotonic())
        self.subject: Subject | None = None

    def estimate(self, frames: int) -> None:
        """Sets the total of the progress, if no group is cut."""
        s = self.settings
        key = s.keyframe_steps if self.subject is None else 0
        finetune = s.finetune_steps if s.gop > 1 else 0
        self.progress.total = self.progress.done + key + frames * (s.motion_steps + finetune)

    def _report(self, stage: str) -> Callable:
        def on_step(_, loss):
            p = self.progress
            p.done, p.stage, p.loss = p.done + 1, stage, float(loss)
            p.total = max(p.total, p.done)
            if self.on_progress:
                self.on_progress(p)

        return on_step

    def group(self, frames: range) -> ParametricGroup:
        """Trains one group; it ends before `frames` does where the Gaussians no longer serve."""
        track = _Track()
        self.views.restart()
        lost = self.subject is not None and self._follow(frames, track)
        parents = self.subject.parents if track.models else None
        if parents is None:  # nothing to follow, or lost at once
            self.subject = self._keyframe(frames)
            track.add(self.subject.tracker)
            lost = self._follow(frames[1:], track)
        subject, done = self.subject, frames[: len(track.models)]
        if lost:
            self.subject = None
        if len(done) == 1 and parents is None:
            subject.canonical = track.models[0]
            subject.parents = np.arange(len(subject.canonical))
            return ParametricGroup(1, subject.canonical.gaussians(), rate_optimized=False)
        model = self._finetuned(subject, done, track)
        known = len(model.key) if parents is None else len(parents)
        born = np.full(len(model.key) - known, -1)
        group = model.group(None if parents is None else np.append(parents, born).astype(np.int32))
        subject.bury(model.key)
        if not len(subject.parents):
            self.subject = None
        return group

    def _keyframe(self, frames: range) -> Subject:
        """Of the first of `frames`."""
        s = self.settings
        model = initial_model(self.capture, frames[0], s)
        radius = subject_radius(model.params["means"].numpy())
        on_step = self._report(f"keyframe {frames[0]}")
        loss = train_keyframe(model, self.views, frames[0], s, steps=s.keyframe_steps, radius=radius, on_step=on_step)
        return Subject(Tracker.start(model, self.views, s, loss, frames), loss, radius)

    def _follow(self, frames: range, track: _Track) -> bool:
        """Adds the frames to `track`; True: until the subject was lost. It also ends where much that has stood still
        changes at once: with few temporal frequencies, light that comes on would show in all frames of the group."""
        subject, g = self.subject, self.settings.group
        for frame in frames:
            if (
                len(track.models) >= g.changed_frames_min
                and subject.tracker.stirred(frame, track.moved()) > g.changed_fraction_max
            ):
                return False
            loss = subject.tracker.advance(frame, self._report(f"track {frame}"))
            if loss is not None and loss > self.settings.cut_ratio * subject.loss + g.cut_loss_floor:
                return True
            if loss is not None:
                subject.tracker.bear(frame, self._report(f"births {frame}"))
            track.add(subject.tracker)
        return False

    def _finetuned(self, subject: Subject, frames: range, track: _Track) -> GroupModel:
        quality = self.settings.quality
        if subject.steps is None:
            middle = len(frames) // 2
            cameras = [self.capture.camera(i, frames[middle]) for i in self.views.train_cameras]
            nominal, g = steps_for(quality, subject.radius), track.models[middle].gaussians()
            subject.steps = measured_steps(g, quality, nominal, cameras, backend=self.views.backend)
        graph, steps = subject.tracker.graph, subject.steps
        model = GroupModel(graph, subject.canonical, track.models, track.poses, steps, track.moved(), self.settings)
        on_step = self._report(f"fine-tune {frames[0]}-{frames[-1]}")
        finetune(model, self.views, frames, self.settings, radius=subject.tracker.radius, on_step=on_step)
        return model


@dataclass
class _Track:
    """Frame by frame the Gaussians, the nodes, and which Gaussians tracking has touched ([N] bool)."""

    models: list[Model] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    moving: list[torch.Tensor] = field(default_factory=list)

    def add(self, tracker: Tracker) -> None:
        self.models.append(tracker.model)
        self.poses.append(tracker.pose)
        self.moving.append(tracker.moving)

    def moved(self) -> torch.Tensor:
        """[N] bool: touched in any frame."""
        moved = torch.ones(len(self.moving[-1]), dtype=torch.bool)  # what is born moves
        moved[: len(self.moving[0])] = False
        for moving in self.moving:
            moved[: len(moving)] |= moving
        return moved
