"""`gscodec train`: capture -> one .ply per frame, the first half of encode."""

from __future__ import annotations

import json
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..atomic_write import part_file
from ..errors import require
from ..fingerprint import inputs, program, sentence
from ..model.gaussians import GOP, RANDOM_ACCESS
from ..progress import Bar
from .inputs import open_frames
from .options import PRESET, Frames, Gop, Motion, Preset, Quality, RandomAccess, RigPath, stdout

if TYPE_CHECKING:
    from .sources import TrainOptions


def train(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture (folder or transforms.json).")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    preset: Preset = PRESET,
    motion: Motion = "field",
    frames: Frames = None,
    gop: Gop = GOP,
    random_access: RandomAccess = RANDOM_ACCESS,
    quality: Quality = None,
    rig: RigPath = None,
) -> None:
    """Capture to one .ply per frame, the first half of encode."""
    from .sources import TrainOptions

    with Bar() as bar:
        options = TrainOptions(preset, frames, gop, motion, rig=rig)
        count = train_to_folder(capture, folder, options, random_access=random_access, quality=quality, bar=bar)
    stdout.print(f"{folder}: {count} frames")


def train_to_folder(
    source: Path, folder: Path, options: TrainOptions, *, random_access: int, quality: float | None, bar: Bar
) -> int:
    """Trains a capture and writes one .ply per frame and sequence.json, from which `encode` makes the bytes that it
    would make of the capture; returns the number of frames.

    A second run with the same program, capture and settings goes on where the first one stopped.
    """
    require("torch", "training a capture")
    from ..splats import SequenceWriter
    from ..train.checkpoint import Checkpoint
    from ..train.settings import coding_loss, train_settings
    from ..train.train import train_groups
    from .sources import open_rig_of_capture

    capture = open_frames(source, options.frames)
    recipe = train_settings(options.preset, quality, motion=options.motion, gop=options.gop)
    work, unfinished = folder / "work", folder / "unfinished.json"
    settings = {"frames": options.frames, "random_access": random_access, "training": asdict(recipe)}
    settings |= options.fingerprint()
    made_by = {"program": program(), "input": inputs(source, folder), "settings": settings}
    training = {
        "capture": str(source.resolve()),
        "range": options.frames,
        "sh_degree": recipe.sh_degree,
        "gaussians": recipe.gaussians_max,
        "frames": options.gop,
        "loss": coding_loss(options.preset, capture),
    }
    same = _goes_on(unfinished, made_by)
    writer = SequenceWriter(folder, capture.fps, capture.cameras, training=training, resume=same)
    with part_file(unfinished) as part:
        part.write_text(json.dumps(made_by))
    groups = train_groups(
        capture,
        recipe,
        first_frame=writer.frame_count,
        random_access=random_access,
        rig=open_rig_of_capture(source, capture, options),
        checkpoints=work,
        on_progress=lambda p: bar.update(p.stage, p.done, p.total),
    )
    for group in groups:
        writer.add(group)
    unfinished.unlink()
    Checkpoint(work).clear()
    return writer.frame_count


def _goes_on(unfinished: Path, made_by: dict) -> bool:
    """Whether an unfinished run was made by the same; a warning says what has changed."""
    if not unfinished.is_file():
        return False
    before, now = json.loads(unfinished.read_text()), json.loads(json.dumps(made_by))
    if before != now:
        warnings.warn(
            f"{unfinished.parent} starts anew, it was made differently: {sentence(before, now)}", stacklevel=2
        )
    return before == now
