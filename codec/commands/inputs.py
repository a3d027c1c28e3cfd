"""Inputs that several commands open: a capture with a frame range, a stream with a warning where it is cut short."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from ..frame_range import frame_range

if TYPE_CHECKING:
    from ..capture import Capture
    from ..decode import Scene, Stream


def open_frames(source: Path, frames: str | None) -> Capture:
    """The capture at `source` with the frames "A:B", None: all of them.

    Raises:
        UsageError, CaptureError: see the message.
    """
    from ..capture import open_capture

    capture = open_capture(source)
    if frames is None:
        return capture
    chosen = frame_range(frames, capture.frame_count)
    return capture.frames(chosen.start, chosen.stop)


def open_tracks(path: Path) -> Scene:
    """The .gsv file at `path` with all of its tracks.

    Raises:
        BitstreamError, LimitError: see the message.
    """
    from ..decode import open_scene

    return open_scene(path)


def scene_output(out: Path) -> None:
    """Checks the name of a file to write, and makes its folder.

    Raises:
        UsageError: it does not end in .gsv.
    """
    if out.suffix != ".gsv":
        raise UsageError(f"{out}: the output must be named *.gsv")
    out.parent.mkdir(parents=True, exist_ok=True)


def open_stream_warning(path: Path, tracks: Sequence[str] | None = None) -> Stream | Scene:
    """The stream at `path`, or the scene if it has several tracks or placed ones; `tracks`: the options --track. A line
    on stderr says where it is unfinished.

    Raises:
        BitstreamError, LimitError, UsageError: see the message.
    """
    from .tracks import place

    scene = place(open_tracks(path), tracks)
    stream = scene.plain() or scene
    if not stream.complete:
        print(
            f"warning: {stream.name} is unfinished or cut short; its {stream.frame_count} whole frames are used",
            file=sys.stderr,
        )
    return stream


def open_stream_of_frames(path: Path, tracks: Sequence[str] | None = None) -> Stream | Scene:
    """As `open_stream_warning`, a stream with at least one whole frame.

    Raises:
        UsageError: it has none, or shows none of them.
    """
    stream = open_stream_warning(path, tracks)
    if not stream.frame_count:
        if stream.groups:
            raise UsageError(
                f"{stream.name} shows no frame: its tracks are hidden or end before the scene begins; show one with "
                f"--track NAME:show:offset=0"
            )
        raise UsageError(f"{stream.name} has no whole frame, expected at least one group; encode it (further) first")
    return stream
