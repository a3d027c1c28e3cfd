"""Calibrated cameras and what each has recorded -> Capture: the part that all layouts share.

A `Feed` is the footage of one camera: an image file a frame or a video, with mask files beside it or none. A camera
whose footage is a smaller copy of what was calibrated is scaled with it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .images import SUFFIXES, View, image_size, read_image, read_mask
from .undistort import undistortion
from .video import Video

FPS = 30.0  # where nothing says it
VIDEOS = (".mp4", ".mov", ".avi", ".mkv")


class Feed:
    """The footage of one camera; thread-safe.

    Args:
        source: a video, or the image file of each frame.
        masks: the mask file of each frame, or nothing; None for a frame that lacks its own.

    Attributes:
        path: of the video or the first image.
        width, height: of the video or the first image; later images are checked against the camera.
        has_alpha: views have an alpha channel, of their own or from masks.

    Raises:
        CaptureError: an image is missing or not readable, or only some frames have masks.
    """

    def __init__(self, source: Video | Sequence[Path], masks: Sequence[Path | None] = ()):
        self._source = source
        if isinstance(source, Video):
            self.path, self.width, self.height, alpha = source.path, source.width, source.height, False
        else:
            self.path = source[0]
            self.width, self.height, alpha = image_size(self.path)
        there = [m for m in masks if m is not None]
        if there and len(there) < len(self):
            raise CaptureError(f"{there[0].parent}: {len(there)} masks for {len(self)} frames")
        self._masks = there
        self.has_alpha = alpha or bool(there)

    def __len__(self) -> int:
        return self._source.frame_count if isinstance(self._source, Video) else len(self._source)

    @property
    def fps(self) -> float:
        """Frames a second, as the video says."""
        return self._source.fps if isinstance(self._source, Video) else FPS

    def view(self, t: int) -> View:
        """Frame `t` as it was recorded."""
        if isinstance(self._source, Video):
            view = View(self._source.frame(t))
        else:
            view = read_image(self._source[t])
        if not self._masks:
            return view
        alpha = read_mask(self._masks[t])
        if alpha.shape != view.rgb.shape[:2]:
            raise CaptureError(f"{self._masks[t]}: mask is {_size(alpha.shape)}, its image {_size(view.rgb.shape)}")
        return View(view.rgb, alpha)

    def name(self, t: int) -> Path:
        """The file that has frame `t`."""
        return self.path if isinstance(self._source, Video) else self._source[t]


def assemble(name: str, cameras: Sequence[Camera], feeds: Sequence[Feed], fps: float | None = None) -> Capture:
    """The capture of `cameras`, which may have distortion, and their `feeds`; `fps` is that of the videos where it is
    None. It ends with the shortest feed, unless that one is under half as long as usual: then its camera is left out.

    Raises:
        CaptureError: the feeds have no frames.
    """
    cameras, feeds, frame_count = _same_length(cameras, feeds)
    cameras = [_at_size(c, f) for c, f in zip(cameras, feeds, strict=True)]
    pinholes, warps = zip(*(undistortion(c) for c in cameras), strict=True)

    def read(index: int, frame: int) -> View:
        view, camera = feeds[index].view(frame), cameras[index]
        if view.rgb.shape[:2] != (camera.height, camera.width):
            raise CaptureError(
                f"{feeds[index].name(frame)}: camera {camera.name}, frame {frame} is {_size(view.rgb.shape)}, "
                f"expected {camera.width}x{camera.height} as the calibration says"
            )
        return warps[index](view)

    alpha = any(f.has_alpha for f in feeds)
    return Capture(name, fps or feeds[0].fps, list(pinholes), frame_count, alpha, read)


def rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """[4, 4] world-to-camera matrix of a rotation and a translation.

    Raises:
        CaptureError: R is not a rotation.
    """
    if not np.isfinite([*R.flat, *t]).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CaptureError("its pose is singular or not a rotation")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, t
    return out


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """[3, 3] intrinsics.

    Raises:
        CaptureError: a focal length is not positive.
    """
    if not (fx > 0 and fy > 0 and np.isfinite([fx, fy, cx, cy]).all()):
        raise CaptureError(f"focal length {fx:g} x {fy:g} is not positive")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def usable(source: Path, made: dict, make) -> tuple[list[Camera], list[Feed]]:
    """`make(name, item)` -> (camera, feed) of every item of `made`; those that cannot be used are left out.

    Raises:
        CaptureError: none can be used.
    """
    found, reason = [], "there are no cameras"
    for name, item in made.items():
        try:
            camera, feed = make(name, item)
            _at_size(camera, feed)
            found.append((camera, feed))
        except CaptureError as e:
            warnings.warn(f"{source}: camera {name} is left out: {e}", stacklevel=4)
            reason = str(e)
    if not found:
        raise CaptureError(f"{source}: no camera can be used; the last one: {reason}")
    cameras, feeds = zip(*found, strict=True)
    return list(cameras), list(feeds)


def numbered(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """The images of a folder (or files with other `suffixes`) in the order of the numbers in their names."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in suffixes] if folder.is_dir() else []
    return sorted(paths, key=by_number)


def by_number(path: Path) -> list:
    """Sort key: frame2 comes before frame10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def find_video(folders: Sequence[Path], name: str) -> Path:
    """The video `name` in one of the folders.

    Raises:
        CaptureError: none has it.
    """
    for folder in folders:
        for path in numbered(folder, VIDEOS):
            if path.stem == name:
                return path
    where = " or ".join(str(f) for f in folders)
    raise CaptureError(f"no video, looked for {name} with {', '.join(VIDEOS)} in {where}")


def _at_size(camera: Camera, feed: Feed) -> Camera:
    """The camera at the size of its feed, which may be a smaller copy of what was calibrated."""
    if abs(feed.width * camera.height - feed.height * camera.width) > max(camera.width, camera.height):
        raise CaptureError(
            f"{feed.path} is {feed.width}x{feed.height}, expected {camera.width}x{camera.height} "
            "as the calibration says, or that shape at another scale"
        )
    return camera.resized(feed.width, feed.height)


def _same_length(cameras: Sequence[Camera], feeds: Sequence[Feed]) -> tuple[list[Camera], list[Feed], int]:
    usual = sorted(map(len, feeds))[len(feeds) // 2]
    keep = [i for i, f in enumerate(feeds) if 2 * len(f) >= usual]
    for i, f in enumerate(feeds):
        if len(f) < usual:
            what = f"the capture ends at frame {len(f)}" if i in keep else "the camera is left out"
            warnings.warn(f"{f.path}: short, {len(f)} of {usual} frames; {what}", stacklevel=5)
    count = min(len(feeds[i]) for i in keep)
    if count < 1:
        raise CaptureError(f"{feeds[keep[0]].path}: the videos have no frames")
    return [cameras[i] for i in keep], [feeds[i] for i in keep], count


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
