"""Splits a capture into a static background (the room, one frame) and a moving subject (all frames, with masks).

Capture -> Parts, for a file of several tracks. Cameras must stand still. The room is the median over time of each
camera's pictures. By masks: the median of the unmasked pixels; pixels that a mask covers in all frames are inpainted
from around them, since other cameras see that place. By motion: the subject is the pixels that differ from the median
(mask_finders.py). Objects that stand still most of the time are then in the room, and room and subject together give
the pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from ..errors import CaptureError, UsageError, require
from .capture import Capture
from .images import View
from .mask_finders import GROW, disc, unlike_finder
from .masks import FRAMES_LEAST, mask_of

WAYS = ("masks", "motion")
SAMPLES = 31  # frames in the median
NO_ROOM = "its images show the subject alone, so that nothing is known of the room; encode it without --tracks"
FILL = 3.0  # pixels, radius of inpainting


@dataclass(frozen=True)
class Parts:
    """The two parts of a capture.

    Attributes:
        room: the static background, one frame, without masks.
        subject: all frames, with masks.
    """

    room: Capture
    subject: Capture


def split_capture(capture: Capture, by: str) -> Parts:
    """Splits a capture into its static background and its subject.

    Args:
        by: "masks": those of the capture, of people or other subjects; "motion": moving pixels are the subject.

    Raises:
        UsageError: `by` is neither.
        CaptureError: a camera moves, there are no masks, or the images show the subject alone; by motion, too few
            frames.
    """
    if by not in WAYS:
        raise UsageError(f"--tracks {by}: expected masks or motion")
    if capture.moves:
        raise CaptureError(
            f"{capture.name}: its cameras move, so that no picture stays; --tracks needs cameras that rest"
        )
    source = _masked(capture) if by == "masks" else _unmasked(capture)
    still = cache(lambda i: still_picture(source, i))
    subject = source if by == "masks" else _unlike(source, still)
    room = replace(capture, frame_count=1, first_frame=0, has_alpha=False, has_depth=False, poses=None, footage=())
    return Parts(replace(room, read=lambda i, _: View(still(i))), subject)


def _masked(capture: Capture) -> Capture:
    """The capture; raises CaptureError unless its masks are files beside whole pictures."""
    if not capture.has_alpha:
        raise CaptureError(
            f"{capture.name}: there are no masks; expected a mask for each picture (gscodec masks makes them), "
            f"or --tracks motion"
        )
    if any(f.subject_alone for f in capture.footage):
        raise CaptureError(f"{capture.name}: {NO_ROOM}")
    return capture


def _unmasked(capture: Capture) -> Capture:
    """The capture with whole pictures, without masks; raises CaptureError if it is too short to detect motion."""
    if capture.frame_count < FRAMES_LEAST:
        raise CaptureError(
            f"{capture.name}: {capture.frame_count} frames, expected {FRAMES_LEAST} or more to see what moves"
        )
    if any(f.subject_alone for f in capture.footage):
        raise CaptureError(f"{capture.name}: {NO_ROOM}")
    read = lambda i, t: replace(capture.view(i, t), alpha=None)  # noqa: E731
    poses = None if capture.poses is None else capture.camera
    return replace(capture, first_frame=0, has_alpha=False, read=read, poses=poses, footage=())


def _unlike(capture: Capture, still: Callable[[int], np.ndarray]) -> Capture:
    """The capture with masks of the pixels that differ from the still pictures."""
    finder = cache(lambda i: unlike_finder(_Footage(capture, i), still(i)))
    packed = cache(lambda i, t: _packed(mask_of(capture.view(i, t).rgb, finder(i)(t))))

    def read(i: int, t: int) -> View:
        return replace(capture.view(i, t), alpha=_unpacked(packed(i, t)))

    return replace(capture, has_alpha=True, read=read)


@dataclass(frozen=True)
class _Footage:
    """The undistorted pictures of one camera, as `unlike_finder` reads them."""

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
    """[H, W, 3] u8: the median over time of a camera's unmasked pixels, holes inpainted.

    Raises:
        CaptureError: a picture cannot be read, or every pixel is masked in all frames.
    """
    cv2 = require("cv2", "filling in what masks cover")
    times = np.unique(np.linspace(0, capture.frame_count - 1, SAMPLES).round().astype(int)).tolist()
    seen, count = [], 0
    for t in times:
        view = capture.view(index, t)
        free = np.ones(view.rgb.shape[:2], bool) if view.alpha is None else ~_near(view.alpha > 0)
        seen.append(np.where(free[..., None], view.rgb, 255))  # masked pixels sort last
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
    """[H, W] bool: the mask and a margin around it, since masks are never exact."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), disc(GROW * float(np.hypot(*mask.shape)))) > 0
