"""Inputs that several commands open: a capture with a frame range, a stream with a warning where it is cut short."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import UsageError
from ..frame_range import frame_range

if TYPE_CHECKING:
    from ..capture import Capture
    from ..decode import Stream


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


def open_stream_warning(path: Path) -> Stream:
    """The stream at `path`; a line on stderr says where it is unfinished.

    Raises:
        BitstreamError, LimitError: see the message.
    """
    from ..decode import open_stream

    stream = open_stream(path)
    if not stream.complete:
        print(
            f"warning: {stream.name} is unfinished or cut short; its {stream.frame_count} whole frames are used",
            file=sys.stderr,
        )
    return stream


def open_stream_of_frames(path: Path) -> Stream:
    """As `open_stream_warning`, a stream with at least one whole frame.

    Raises:
        UsageError: it has none.
    """
    stream = open_stream_warning(path)
    if not stream.frame_count:
        raise UsageError(f"{stream.name} has no whole frame, expected at least one group; encode it (further) first")
    return stream
