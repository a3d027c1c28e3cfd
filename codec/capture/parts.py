"""A capture in two: what stands still, as one frame, and what does not, as a subject with masks.

Capture -> Parts, for a file of several tracks. Cameras must stand still. The still part is the median over time of each
camera's pictures, of a pixel those where no mask covers it; what a mask always covers is filled in from around it:
other cameras see it. Masks are those of the capture, or found by movement (mask_finders.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np

from ..errors import CaptureError, UsageError, require
from .capture import Capture
from .images import View
from .mask_finders import GROW, disc, moving_finder
from .masks import FRAMES_LEAST, mask_of

WAYS = ("masks", "motion")
SAMPLES = 31  # frames of which the median is taken
FILL = 3.0  # pixels, radius of what fills a hole in


@dataclass(frozen=True)
class Parts:
    """A capture in two.

    Attributes:
        room: one frame without masks. subject: all frames, with masks.
    """

    room: Capture
    subject: Capture


def split_capture(capture: Capture, by: str) -> Parts:
    """What stands still and what does not.

    Args:
        by: "masks", of people or other subjects, which come with the capture; "motion": what moves is the subject.

    Raises:
        UsageError: there is no such way.
        CaptureError: a camera moves, there are no masks, or nothing is behind them; by motion, too few frames.
    """
    if by not in WAYS:
        raise UsageError(f"--tracks {by}: expected masks or motion")
    if capture.moves:
        raise CaptureError(
            f"{capture.name}: its cameras move, so that no picture stays; --tracks needs cameras that rest"
        )
    subject = _masked(capture) if by == "masks" else _moving(capture)
    read = cache(lambda i, _: View(still_picture(subject, i)))
    room = replace(capture, frame_count=1, first_frame=0, has_alpha=False, has_depth=False, poses=None, footage=())
    return Parts(replace(room, read=read), subject)


def _masked(capture: Capture) -> Capture:
    """The capture, whose masks are files beside whole pictures."""
    if not capture.has_alpha:
        raise CaptureError(
            f"{capture.name}: there are no masks; expected a mask for each picture (gscodec masks makes them), "
            f"or --tracks motion"
        )
    if any(f.has_alpha and not f.masks for f in capture.footage):
        raise CaptureError(
            f"{capture.name}: its images have an alpha channel, so that nothing is known of the room; "
            f"encode it without --tracks"
        )
    return capture


def _moving(capture: Capture) -> Capture:
    """The capture with masks of what moves; those that it has are not looked at."""
    if capture.frame_count < FRAMES_LEAST:
        raise CaptureError(
            f"{capture.name}: {capture.frame_count} frames, expected {FRAMES_LEAST} or more to see what moves"
        )
    locks = [Lock() for _ in capture.cameras]
    finder = cache(lambda i: moving_finder(_Footage(capture, i), capture.frame_count, capture.fps))

    @cache
    def packed(i: int, t: int) -> bytes:
        with locks[i]:  # the first frame of a camera looks at all of them
            find = finder(i)
        return _packed(mask_of(capture.view(i, t).rgb, find(t)))

    def read(i: int, t: int) -> View:
        return replace(capture.view(i, t), alpha=_unpacked(packed(i, t)))

    poses = None if capture.poses is None else capture.camera
    return replace(capture, first_frame=0, has_alpha=True, read=read, poses=poses, footage=())


@dataclass(frozen=True)
class _Footage:
    """The undistorted pictures of one camera, as `moving_finder` reads them."""

    capture: Capture
    index: int

    @property
    def path(self) -> Path:
        """For messages."""
        return Path(self.capture.name) / self.capture.cameras[self.index].name

    def picture(self, t: int) -> View:
        """Frame `t`."""
        return self.capture.view(self.index, t)


def _packed(alpha: np.ndarray) -> bytes:
    return require("cv2", "making masks").imencode(".png", alpha)[1].tobytes()


def _unpacked(data: bytes) -> np.ndarray:
    import cv2

    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def still_picture(capture: Capture, index: int) -> np.ndarray:
    """[H, W, 3] u8: the median over time of what a camera shows beside its masks, holes filled in.

    Raises:
        CaptureError: a picture cannot be read, or the masks of all frames cover it all.
    """
    cv2 = require("cv2", "filling in what masks cover")
    times = np.unique(np.linspace(0, capture.frame_count - 1, SAMPLES).round().astype(int)).tolist()
    seen, count = [], 0
    for t in times:
        view = capture.view(index, t)
        free = np.ones(view.rgb.shape[:2], bool) if view.alpha is None else ~_near(view.alpha > 0)
        seen.append(np.where(free[..., None], view.rgb, 255))  # what is covered lies behind all else
        count = count + free.astype(np.int32)
    ordered = np.sort(seen, axis=0)
    middle = (np.maximum(count - 1, 0) // 2)[None, ..., None]
    picture = np.ascontiguousarray(np.take_along_axis(ordered, middle, 0)[0])
    hole = count == 0
    if hole.all():
        raise CaptureError(
            f"{capture.name}: the masks of camera {capture.cameras[index].name} cover all of its pictures"
        )
    return cv2.inpaint(picture, hole.astype(np.uint8), FILL, cv2.INPAINT_TELEA) if hole.any() else picture


def _near(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool with a margin around it: masks are never exact."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), disc(GROW * float(np.hypot(*mask.shape)))) > 0
