"""SOG version 2 for each frame, written by splat-transform with its defaults: one setting."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from gscodec.model.gaussians import Gaussians
from gscodec.splats import read_splat

from .splat_transform import convert

SETTINGS = {"default": {}}


def encode(frames: Sequence[Gaussians]) -> dict[str, bytes]:
    """One .sog for each frame."""
    return convert(frames, ".sog", "-g", "cpu")


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames."""
    with tempfile.TemporaryDirectory() as folder:
        frames = []
        for name, data in files.items():
            Path(folder, name).write_bytes(data)
            frames.append(read_splat(Path(folder, name)))
        return frames
