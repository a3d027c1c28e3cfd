"""The sequences and frames on which codecs are measured; made once and kept in a work folder.

statue                     a scanned statue in motion (animate_splat.py), 20 frames, 101,275 Gaussians
lumberjack                 the captured character, 30 frames, trained as by `gscodec encode`, at SH degree 0 and only
                           with the Gaussians that live in all frames of the group: most video packings have neither
                           higher harmonics nor lifetimes
statue-0, playbot, fruit   single frames of SH degree 0, 2 and 3
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.errors import UsageError
from gscodec.model.gaussian_sequence import GaussianSequence
from gscodec.model.parametric_group import ParametricGroup
from gscodec.splats import open_sequence

from .animate_splat import animate_splat
from .data import existing

FRAMES = 20
SINGLE = {"statue-0": "statue.ply", "playbot": "playbot.ply", "fruit": "fruit.ply"}
SEQUENCES = ("statue", "lumberjack", *SINGLE)


def open_case(name: str, data: Path, work: Path) -> GaussianSequence:
    """The sequence `name` of the data folder.

    Raises:
        UsageError: the name is unknown or its files are missing.
    """
    if name in SINGLE:
        return open_sequence(existing(data / "splats" / SINGLE[name]))
    makers: dict[str, Callable[[Path, Path], None]] = {"statue": _statue, "lumberjack": _lumberjack}
    if name not in makers:
        raise UsageError(f"no sequence {name}, expected one of {', '.join(SEQUENCES)}")
    folder = work / name
    if not (done := folder / ".done").exists():
        makers[name](data, folder)
        done.touch()
    return open_sequence(folder)


def _statue(data: Path, folder: Path) -> None:
    animate_splat(existing(data / "splats" / "statue.ply"), folder, FRAMES)


def _lumberjack(data: Path, folder: Path) -> None:
    from gscodec.capture import open_capture
    from gscodec.splats import SequenceWriter
    from gscodec.train.settings import train_settings
    from gscodec.train.train import train_groups

    capture = open_capture(existing(data / "lumberjack"))
    writer = SequenceWriter(folder, capture.fps, capture.cameras)
    for group in lasting(train_groups(capture, train_settings("medium", sh_degree=0))):
        writer.add(group)


def lasting(groups: Iterable[ParametricGroup]) -> Iterator[ParametricGroup]:
    """Each group without the Gaussians that do not live in all of its frames. A Gaussian whose parent is left out has
    no parent."""
    place = np.full(1, -1, np.int32)  # [N + 1] index among Gaussians kept in the group before; -1: left out; [N]: -1
    for group in groups:
        count = len(group.canonical)
        lasts = np.ones(count, bool) if group.lifetimes is None else (group.lifetimes == [0, len(group)]).all(1)
        index = np.flatnonzero(lasts)
        kept = group.take(index)
        yield replace(kept, lifetimes=None, parents=None if kept.parents is None else place[kept.parents])
        place = np.full(count + 1, -1, np.int32)
        place[index] = np.arange(len(index))
