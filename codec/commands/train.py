"""`gscodec train`: capture -> one .ply per frame, the first half of encode."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from ..atomic_write import part_file
from ..errors import require
from ..model.gaussians import GOP
from ..progress import Bar
from .inputs import open_frames
from .options import Frames, Gop, Preset, Quality, RandomAccess, stdout


def train(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture (folder or transforms.json).")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    preset: Preset = "medium",
    frames: Frames = None,
    gop: Gop = GOP,
    random_access: RandomAccess = 60,
    quality: Quality = 50.0,
) -> None:
    """Capture to one .ply per frame, the first half of encode."""
    with Bar() as bar:
        options = {"preset": preset, "frames": frames, "gop": gop, "random_access": random_access, "quality": quality}
        count = train_to_folder(capture, folder, **options, bar=bar)
    stdout.print(f"{folder}: {count} frames")


def train_to_folder(
    source: Path,
    folder: Path,
    *,
    preset: str,
    frames: str | None,
    gop: int,
    random_access: int,
    quality: float,
    bar: Bar,
) -> int:
    """Trains a capture and writes one .ply per frame and sequence.json; returns the number of frames.

    What an earlier run with the same settings left unfinished goes on where it stopped.
    """
    require("torch", "training a capture")
    from ..splats import SequenceWriter
    from ..train.settings import train_settings
    from ..train.train import Checkpoint, train_groups

    capture = open_frames(source, frames)
    recipe = train_settings(preset, gop=gop, quality=quality)
    work, unfinished = folder / "work", folder / "unfinished.json"
    facts = {"input": str(source.resolve()), "frames": frames, "random_access": random_access}
    made_by = json.dumps(facts | asdict(recipe))
    same = unfinished.is_file() and unfinished.read_text() == made_by
    writer = SequenceWriter(folder, capture.fps, capture.cameras, resume=same)
    with part_file(unfinished) as part:
        part.write_text(made_by)
    groups = train_groups(
        capture,
        recipe,
        first_frame=writer.frame_count,
        random_access=random_access,
        checkpoints=work,
        on_progress=lambda p: bar.update(p.stage, p.done, p.total),
    )
    for group in groups:
        writer.add(group)
    unfinished.unlink()
    Checkpoint(work).clear()
    return writer.frame_count
