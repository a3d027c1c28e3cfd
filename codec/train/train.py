"""Capture -> groups of tracked Gaussians: keyframe, motion, joint fine-tuning, group after group.

Groups come out one at a time, so that they are encoded and safe on disk while the next one trains. After each, a
checkpoint holds its last frame, from which the next keyframe starts; a run that stops goes on there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
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


def group_ranges(frame_count: int, gop: int) -> list[range]:
    """Frames of each group."""
    return [range(a, min(a + gop, frame_count)) for a in range(0, frame_count, gop)]


def _steps_of(frames: range, first: bool, s: TrainSettings) -> int:
    key = s.keyframe_steps if first else int(WARM_SHARE * s.keyframe_steps)
    return key + (len(frames) - 1) * s.motion_steps + (len(frames) * s.finetune_steps if len(frames) > 1 else 0)


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

    def _path(self, group: int) -> Path:
        return self.folder / f"group_{group:05d}.npz"

    def save(self, group: int, last: Gaussians) -> None:
        """Writes the last frame of `group`, atomically, and drops the one before."""
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        part = self._path(group).with_suffix(".part.npz")
        np.savez(part, **{f.name: getattr(last, f.name) for f in fields(last)})
        os.replace(part, self._path(group))
        if group > 0:
            self._path(group - 1).unlink(missing_ok=True)

    def load(self, group: int) -> Gaussians | None:
        """The last frame of `group`, or None."""
        if self.folder is None or not self._path(group).exists():
            return None
        try:
            with np.load(self._path(group)) as z:
                return Gaussians(**dict(z))
        except (OSError, ValueError, KeyError):
            return None


def train_groups(
    capture,
    settings: TrainSettings,
    *,
    first_group: int = 0,
    checkpoints: Path | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Iterator[Group]:
    """Trains the groups of `capture` from `first_group` on and yields each when it is done.

    Args:
        checkpoints: folder for what the next group starts from; None keeps it in memory only.
        on_progress: called after every step.

    Raises:
        CaptureError: a frame cannot be read, or no view overlaps another.
    """
    # Torch only handles small tensors here; its threads would spin against those of the native kernels.
    torch.set_num_threads(1)
    ranges = group_ranges(capture.frame_count, settings.gop)
    store = Checkpoint(checkpoints)
    last = store.load(first_group - 1) if first_group else None
    todo = list(enumerate(ranges))[first_group:]
    total = sum(_steps_of(r, last is None and n == 0, settings) for n, (_, r) in enumerate(todo))
    progress = Progress(total, started=time.monotonic())

    def report(stage: str):
        def on_step(*numbers):
            progress.done += 1
            progress.stage, progress.loss = stage, float(numbers[-1])
            if on_progress:
                on_progress(progress)

        return on_step

    views = Views(capture, settings.seed)
    for number, frames in todo:
        group = _train_group(capture, views, frames, last, settings, report)
        last = group.frames[-1]
        store.save(number, last)
        yield group


def _train_group(capture, views, frames: range, last: Gaussians | None, settings: TrainSettings, report) -> Group:
    model = initial_model(capture, frames[0], settings) if last is None else from_gaussians(last)
    radius = subject_radius(model.params["means"].numpy())
    steps = settings.keyframe_steps if last is None else int(WARM_SHARE * settings.keyframe_steps)
    key = train_keyframe(
        model,
        views,
        frames[0],
        settings,
        steps=steps,
        radius=radius,
        on_step=report(f"keyframe {frames[0]}"),
    )
    if len(frames) == 1:
        return Group([key.gaussians()])
    means, turned = track(
        key, views, frames, settings, radius=radius, on_step=report(f"motion {frames[0]}-{frames[-1]}")
    )
    group = GroupModel(key, means, turned, steps_for(settings.quality, radius))
    finetune(group, views, frames, settings, radius=radius, on_step=report(f"fine-tune {frames[0]}-{frames[-1]}"))
    with torch.no_grad():
        return Group([group.gaussians(t) for t in range(len(frames))])


def fingerprint(settings: TrainSettings) -> dict:
    """What must be equal for a resumed run to go on."""
    return asdict(settings)
