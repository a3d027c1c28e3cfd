"""What `encode` encodes: groups of a capture that is trained, of splats that are fitted, or of a folder that `train`
left. Each is opened here as a `Source`, and from there on all are alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..bitstream.quantization import QUALITY_DEFAULT
from ..encode.coder import CamerasAt, RefineByPictures
from ..encode.encode import stream_config
from ..encode.settings import EncodeSettings
from ..errors import CaptureError, UsageError, require
from ..fingerprint import inputs
from ..frame_range import frame_range
from ..model.camera import Camera
from ..model.gaussian_sequence import DenseGroup, GaussianSequence
from ..model.parametric_group import ParametricGroup
from ..model.rig import Rig
from ..model.rig_file import read_rig
from ..progress import Bar
from .inputs import open_frames

if TYPE_CHECKING:
    from ..capture import Capture
    from ..encode.audio import AudioTrack

AXES = ("x", "y", "z")
LENGTHS_DIFFER = 0.1  # seconds between the ends of sound and video that nobody notices
UP_UNKNOWN = "-y"  # what 3DGS trainers leave where nothing is known


@dataclass(frozen=True)
class Source:
    """An input of the encoder.

    Attributes:
        groups: (groups done, frames done) -> the groups behind them.
        config: of the stream.
        settings: of the encoder, as they are for this input.
        made_of: settings besides those of the encoder that decide what the groups are (JSON-able).
        frames: in all.
        cameras: frame -> the cameras for training, from which sensitivity is measured too.
        refine_by_pictures: last stage of training; None: there are no pictures.
        finish: called when the stream is complete.
    """

    groups: Callable[[int, int], Iterator[ParametricGroup]]
    config: dict
    settings: EncodeSettings
    made_of: dict
    frames: int
    cameras: CamerasAt
    refine_by_pictures: RefineByPictures | None = None
    finish: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class TrainOptions:
    """Options of the commands that train.

    Attributes:
        preset: fast, medium or slow. frames: "A:B", None: all. gop: most frames in a group.
        motion: field or nodes, see `train_settings`.
        cluster: address of the Ray cluster that trains; None: this machine.
        rig: file of the rig that predicts the motion; None: nothing does.
    """

    preset: str
    frames: str | None
    gop: int
    motion: str = "field"
    cluster: str | None = None
    rig: Path | None = None

    def fingerprint(self) -> dict:
        """The rig among what decides how groups are."""
        return {"rig": inputs(self.rig)} if self.rig else {}


def up_axis(cameras: Sequence[Camera]) -> str:
    """The world axis that the cameras hold upwards, e.g. "z" or "-y"."""
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    i = int(np.abs(up).argmax())
    return ("-" if up[i] < 0 else "") + AXES[i]


def splat_source(path: Path, settings: EncodeSettings, options: TrainOptions, bar: Bar) -> Source:
    """Splats that others trained, or a folder that `gscodec train` has left."""
    require("scipy", "encoding")
    from ..fit import fit_groups
    from ..splats import open_sequence

    frames = options.frames
    sequence = open_sequence(path, gop=options.gop)
    if sequence.frame_count > 1:
        bar.say(f"{path}: {sequence.mode} ({_MODES.get(sequence.mode, 'as sequence.json says')})")
    rig = open_rig(options.rig, sequence.frame_count, frames)
    if rig and all(isinstance(g, ParametricGroup) for g in sequence.groups):
        raise UsageError(f"--rig {options.rig}: {path} is trained already; give the rig to gscodec train")
    sequence = _restricted(sequence, frames)
    if settings.refine is None and sequence.frame_count == 1:
        settings = replace(settings, refine=settings.rounding.still_views)
    cameras, refinement, level = sequence.cameras, None, None
    if sequence.training and frames is None:
        refinement, level = _trained(path, sequence.training, settings, bar)
        settings = replace(settings, loss=sequence.training["loss"])
    level = level or _largest(sequence)
    trained = [c for c in cameras if c.split == "train"]
    return Source(
        lambda done, _: fit_groups(
            sequence.groups,
            start=done,
            random_access=settings.random_access,
            quality=QUALITY_DEFAULT if settings.quality is None else settings.quality,
            rig=rig,
        ),
        stream_config(fps=sequence.fps, **level, cameras=cameras, up=up_axis(cameras) if cameras else UP_UNKNOWN),
        settings,
        {"frames": frames, "gop": options.gop} | options.fingerprint(),
        sequence.frame_count,
        lambda _: trained,
        refinement,
    )


def open_rig(path: Path | None, count: int, frames: str | None) -> Rig | None:
    """The rig of a file with a pose for each of `count` frames, of which the range `frames` is taken; None of None.

    Raises:
        CaptureError, UsageError: see the message.
    """
    return None if path is None else read_rig(path, count).frames(frame_range(frames, count))


_MODES = {
    "scene": "index i is the same Gaussian in all frames of a group",
    "tracked": "index i is the same Gaussian in every frame",
    "matched": "Gaussians were matched from frame to frame",
    "independent": "frames do not match each other, each is coded alone",
}


def _largest(sequence: GaussianSequence) -> dict:
    """Caps that the level of the stream must cover."""
    first = [g.frame(0) for g in sequence.groups]
    counts = {"gaussians": max(map(len, first)), "frames": max(len(g) for g in sequence.groups)}
    return {"sh_degree": max(g.sh_degree for g in first), **counts}


def _trained(path: Path, training: dict, settings: EncodeSettings, bar: Bar) -> tuple:
    """Refinement by the pictures of the capture that a folder was trained on, and the level of its stream."""
    from ..train.refinement import PictureRefinement

    level = {"sh_degree": training["sh_degree"], "gaussians": training["gaussians"], "frames": training["frames"]}
    try:
        capture = open_frames(Path(training["capture"]), training["range"])
    except (CaptureError, UsageError, OSError) as e:
        bar.say(f"{path}: coded without refinement by pictures, since the capture that it was trained on is gone: {e}")
        return None, level
    return PictureRefinement(capture, views=settings.refine), level


def _restricted(sequence, frames: str | None):
    """Frames A:B; groups that the range cuts become shorter, and dense."""
    chosen = frame_range(frames, sequence.frame_count)
    if len(chosen) == sequence.frame_count:
        return sequence
    groups, start, place = [], 0, None  # place: index in the last cut group of each Gaussian that it had before
    for g in sequence.groups:
        a, b = max(chosen[0] - start, 0), min(chosen[-1] + 1 - start, len(g))
        if a < b:
            parents = _moved_parents(g.parents, place) if groups else None
            place = None
            if (a, b) == (0, len(g)):
                groups.append(replace(g, parents=parents))
            else:
                cut, place = _cut(g, parents, a, b)
                groups.append(cut)
        start += len(g)
    return sequence.with_groups(groups)


def _cut(g, parents: np.ndarray | None, a: int, b: int) -> tuple[DenseGroup, np.ndarray | None]:
    """Frames a to b - 1 of a group, with the Gaussians that live in them, and the new index of each, -1: gone."""
    if g.lifetimes is None:
        return DenseGroup([g.frame(t) for t in range(a, b)], None, parents), None
    life = np.clip(g.lifetimes - a, 0, b - a)
    kept = life[:, 0] < life[:, 1]
    frames = [g.frame(t).take(kept) for t in range(a, b)]
    place = np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32)
    return DenseGroup(frames, life[kept], None if parents is None else parents[kept]), place


def _moved_parents(parents: np.ndarray | None, place: np.ndarray | None) -> np.ndarray | None:
    """Parents by the new indices of the group before."""
    if parents is None or place is None or not len(place):
        return parents
    return np.where(parents >= 0, place[np.maximum(parents, 0)], -1).astype(np.int32)


def open_rig_of_capture(path: Path, capture, options: TrainOptions) -> Rig | None:
    """As `open_rig`, of a capture at `path` that was opened with the frames of `options`."""
    if options.rig is None:
        return None
    whole = capture if options.frames is None else open_frames(path, None)
    return open_rig(options.rig, whole.frame_count, options.frames)


def capture_source(path: Path, out: Path, settings: EncodeSettings, options: TrainOptions, bar: Bar) -> Source:
    """A capture that is trained group by group, while the group before is coded and safe on disk."""
    require("torch", "training a capture")
    capture = open_frames(path, options.frames)
    say_few_cameras(capture, path, bar)
    rig = open_rig_of_capture(path, capture, options)
    source = trained_source(capture, out, settings, options, bar, rig=rig)
    if not options.cluster:
        return source
    recipe = _recipe(options, settings)
    return replace(source, groups=partial(_cluster_groups, path, source.settings, options, recipe, rig, bar))


def say_few_cameras(capture: Capture, path: Path, bar: Bar) -> None:
    """Says so where there is one training camera."""
    if len(capture.indices("train")) == 1:
        bar.say(f"{path}: 1 training camera, from other sides the scene will be wrong; expected two or more")


def say_lengths(path: Path, sound: AudioTrack, video: float, bar: Bar) -> None:
    """Says what becomes of the sound of the file `path` where it is not as long as the video, in seconds."""
    if sound.seconds > video + LENGTHS_DIFFER:
        bar.say(f"--audio {path}: {sound.seconds:.2f} s of sound, cut to the {video:.2f} s of the video")
    elif sound.seconds < video - LENGTHS_DIFFER:
        bar.say(f"--audio {path}: {sound.seconds:.2f} s of sound, the rest of the {video:.2f} s of the video is silent")


def _recipe(options: TrainOptions, settings: EncodeSettings):
    from ..train.settings import train_settings

    return train_settings(options.preset, settings.quality, motion=options.motion, gop=options.gop)


def trained_source(
    capture: Capture,
    out: Path,
    settings: EncodeSettings,
    options: TrainOptions,
    bar: Bar,
    *,
    longer: float = 1.0,
    rig: Rig | None = None,
) -> Source:
    """An opened capture, or a part of one.

    Args:
        out: the stream, beside which checkpoints lie. longer: times the usual steps of a keyframe.
        rig: predicts the motion; None: nothing does.
    """
    from ..train.checkpoint import Checkpoint
    from ..train.refinement import PictureRefinement
    from ..train.settings import coding_loss

    recipe = _recipe(options, settings)
    recipe = replace(recipe, keyframe_steps=round(longer * recipe.keyframe_steps))
    settings = replace(settings, loss=coding_loss(options.preset, capture))
    work, trained = out.with_name(out.name + ".work"), capture.indices("train")
    return Source(
        partial(_local_groups, capture, recipe, settings.random_access, work, rig, bar),
        stream_config(
            fps=capture.fps,
            sh_degree=recipe.sh_degree,
            gaussians=recipe.gaussians_max,
            frames=options.gop,
            cameras=capture.cameras,
            up=up_axis(capture.cameras),
        ),
        settings,
        {"frames": options.frames, "training": asdict(recipe)} | options.fingerprint(),
        capture.frame_count,
        lambda t: [capture.camera(i, t) for i in trained],
        PictureRefinement(capture, views=settings.refine),
        Checkpoint(work).clear,
    )


def _local_groups(capture, recipe, random_access: int, work: Path, rig, bar: Bar, _: int, first_frame: int):
    from ..train.train import train_groups

    steps, start = [0, 1], first_frame

    def on_progress(p) -> None:
        steps[:] = p.done, p.total
        bar.update(p.stage, *steps)

    options = {"random_access": random_access, "rig": rig, "checkpoints": work, "on_progress": on_progress}
    for group in train_groups(capture, recipe, first_frame=first_frame, **options):
        bar.update(f"code {start}-{start + len(group) - 1}", *steps)
        start += len(group)
        yield group


def _cluster_groups(path: Path, settings, options: TrainOptions, recipe, rig, bar: Bar, _: int, first_frame: int):
    from ..train.ray_jobs import cluster_groups

    total = open_frames(path, options.frames).frame_count
    yield from cluster_groups(
        options.cluster,
        partial(open_frames, path.resolve(), options.frames),
        recipe,
        settings.random_access,
        first_frame=first_frame,
        rig=rig,
        on_progress=lambda done: bar.update("train on the cluster", done, total),
    )
