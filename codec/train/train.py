"""Capture -> groups of tracked Gaussians: keyframe, motion, joint fine-tuning, group after group.

Groups come out one at a time, so that they are encoded and safe on disk while the next one trains. After each, a
checkpoint holds its last frame, from which the next keyframe starts; a run that stops goes on there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from gscodec.bitstream.quantization import steps_for, subject_radius
from gscodec.errors import CaptureError
from gscodec.gaussians import Gaussians, Group
from gscodec.train.carve import carve, random_box
from gscodec.train.finetune import GroupModel, finetune
from gscodec.train.keyframe import train_keyframe
from gscodec.train.model import Model, from_gaussians, from_points
from gscodec.train.motion import track
from gscodec.train.settings import TrainSettings
from gscodec.train.views import Views

WARM_SHARE = 0.5  # of the keyframe's steps, when it starts from the group before


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


def _steps_left(frames: int, first: bool, s: TrainSettings) -> int:
    """Estimate of the steps that `frames` frames take, in groups of the full length."""
    groups = -(-frames // s.gop)
    keys = groups * int(WARM_SHARE * s.keyframe_steps) + (s.keyframe_steps - int(WARM_SHARE * s.keyframe_steps)) * first
    return keys + (frames - groups) * s.motion_steps + (frames * s.finetune_steps if s.gop > 1 else 0)


def initial_model(capture, frame: int, settings: TrainSettings) -> Model:
    """Gaussians from the visual hull of the masks, or at random where there are none.

    Raises:
        CaptureError: nothing to start from.
    """
    cameras = [i for i, c in enumerate(capture.cameras) if c.split == "train"]
    if not cameras:
        raise CaptureError(f"{capture.name}: no training camera, expected at least one with split 'train'")
    views = []
    for i in cameras:
        v = capture.view(i, frame)
        views.append((capture.cameras[i], v.rgb, v.alpha))
    known = [c for c, _, _ in views]
    if all(alpha is not None for _, _, alpha in views):
        points, colors = carve(known, views, settings.initial_points)
        if len(points):
            return from_points(points, colors, opacity=0.5)
    points, colors = random_box(known, views, settings.initial_points, settings.seed)
    if len(points) == 0:
        raise CaptureError(f"{capture.name}: no point is seen by two cameras, expected cameras that overlap")
    return from_points(points, colors, opacity=0.1)


class Checkpoint:
    """The end of the last finished group, on disk: what the next keyframe starts from."""

    def __init__(self, folder: Path | None):
        self.folder = folder

    def _path(self, next_frame: int) -> Path:
        return self.folder / f"before_{next_frame:06d}.npz"

    def save(self, next_frame: int, last: Gaussians | None) -> None:
        """Writes the Gaussians of the frame before `next_frame`, atomically, and drops older ones."""
        if self.folder is None or last is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        old = list(self.folder.glob("before_*.npz"))
        part = self.folder / "writing.npz"
        np.savez(part, **{f.name: getattr(last, f.name) for f in fields(last)})
        os.replace(part, self._path(next_frame))
        for path in old[:-1]:  # the newest but one stays: the stream may not have the last group yet
            path.unlink()

    def load(self, next_frame: int) -> Gaussians | None:
        """What `save` wrote for `next_frame`, or None."""
        if self.folder is None or not self._path(next_frame).exists():
            return None
        try:
            with np.load(self._path(next_frame)) as z:
                return Gaussians(**dict(z))
        except (OSError, ValueError, KeyError):
            return None

    def clear(self) -> None:
        """Removes the folder once the run is complete."""
        if self.folder is not None and self.folder.is_dir():
            for path in self.folder.glob("*.npz"):
                path.unlink()
            self.folder.rmdir()


def train_groups(
    capture,
    settings: TrainSettings,
    *,
    first_frame: int = 0,
    checkpoints: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Iterator[Group]:
    """Trains `capture` from `first_frame` on and yields each group when it is done.

    Args:
        first_frame: where an earlier run stopped; a group starts there.
        checkpoints: folder for what the next group starts from; None keeps it in memory only.
        on_progress: called after every step.

    Raises:
        CaptureError: a frame cannot be read, or no view overlaps another.
    """
    # Torch only handles small tensors here; its threads would spin against those of the native kernels.
    torch.set_num_threads(1)
    store = Checkpoint(checkpoints)
    last = store.load(first_frame) if first_frame else None  # absent after a cut, too
    progress = Progress(
        _steps_left(capture.frame_count - first_frame, last is None, settings), started=time.monotonic()
    )
    run = _Run(capture, settings, progress, on_progress)
    start = first_frame
    while start < capture.frame_count:
        frames = range(start, min(start + settings.gop, capture.frame_count))
        group = run.group(frames, last)
        start += len(group)
        # Where the motion outran the keyframe its Gaussians are no good start for the next one either.
        last = group.frames[-1] if len(group) == len(frames) else None
        progress.total = progress.done + _steps_left(capture.frame_count - start, last is None, settings)
        store.save(start, last)
        yield group


class _Run:
    """What the groups of one run share."""

    def __init__(self, capture, settings: TrainSettings, progress: Progress, on_progress):
        self.capture, self.settings, self.progress, self.on_progress = capture, settings, progress, on_progress
        self.views = Views(capture, settings.seed)

    def _report(self, stage: str) -> Callable:
        def on_step(*numbers):
            p = self.progress
            p.done, p.stage, p.loss = p.done + 1, stage, float(numbers[-1])
            p.total = max(p.total, p.done)
            if self.on_progress:
                self.on_progress(p)

        return on_step

    def group(self, frames: range, last: Gaussians | None) -> Group:
        """Trains one group; it ends before `frames` does where the motion outruns the keyframe."""
        s, views = self.settings, self.views
        model = initial_model(self.capture, frames[0], s) if last is None else from_gaussians(last)
        radius = subject_radius(model.params["means"].numpy())
        steps = s.keyframe_steps if last is None else int(WARM_SHARE * s.keyframe_steps)
        on_step = self._report(f"keyframe {frames[0]}")
        loss = train_keyframe(model, views, frames[0], s, steps=steps, radius=radius, on_step=on_step)
        if len(frames) == 1:
            return Group([model.gaussians()])
        on_step = self._report(f"motion from {frames[0]}")
        means, turned = track(model, views, frames, s, radius=radius, loss_max=s.cut_ratio * loss, on_step=on_step)
        frames = frames[: len(means)]
        group = GroupModel(model, means, turned, steps_for(s.quality, radius))
        if len(frames) > 1:
            on_step = self._report(f"fine-tune {frames[0]}-{frames[-1]}")
            finetune(group, views, frames, s, radius=radius, on_step=on_step)
        with torch.no_grad():
            return Group([group.gaussians(t) for t in range(len(frames))])
