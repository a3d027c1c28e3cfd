"""Calibrated cameras and their footage -> Capture: the part that all layouts share.

A `Feed` is the footage of one camera: a video or one image file per frame, with or without mask files. A `Track` is the
calibration of one camera. If the footage is a smaller copy of the calibrated size, the camera is scaled to it.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CaptureError
from ..model.camera import NEAR, PIXEL_LOW_PASS, Camera, meeting_point
from .background import background_of, border_color, cut_out
from .capture import Capture, differs, extent
from .depth import DepthImages, along_axis
from .images import SUFFIXES, View, image_size, read_image, read_mask
from .points import Points
from .undistort import Undistortion
from .video import Video

FPS = 30.0  # frames per second, if no file states them
NEAR_SHARE = 0.2  # near plane over the depth at which the optical axes meet: nothing nearer is part of the scene
ROUNDED = 0.1  # pixels, largest error of single precision for points as far away as the cameras are apart
VIDEOS = (".mp4", ".mov", ".avi", ".mkv")
Track = Sequence[Camera]  # the camera in each frame of its feed; a single entry holds for all frames


class Feed:
    """The footage of one camera; thread-safe.

    Args:
        source: a video, or the image file of each frame.
        masks: the mask file of each frame (None: the frame has no mask), or empty.
        mask_files: path of each frame's mask, also of a mask that does not exist.
        labels: masks are label images; label 0 is the background.
        depths: the depth images of the frames; None: the camera has none.

    Attributes:
        path: path of the video or the first image.
        masks: the mask file of each frame; empty: there are none.
        width, height: size of the video or the first image; later images are checked against the camera.
        has_alpha: views have an alpha channel: their own, from masks or from the background; False: their own channel
            is dropped.
        background: [3] colour of the background, which is cut out; None: it is not cut out.

    Raises:
        CaptureError: an image is missing or not readable, or only some frames have masks or depth images.
    """

    def __init__(
        self,
        source: Video | Sequence[Path],
        masks: Sequence[Path | None] = (),
        mask_files: Sequence[Path] = (),
        *,
        labels: bool = False,
        depths: DepthImages | None = None,
    ):
        self._source, self._labels, self.mask_files, self.depths = source, labels, mask_files, depths
        if isinstance(source, Video):
            self.path, self.width, self.height, alpha = source.path, source.width, source.height, False
        else:
            self.path = source[0]
            self.width, self.height, alpha = image_size(self.path)
        there = [m for m in masks if m is not None]
        if there and len(there) < len(self):
            raise CaptureError(f"{there[0].parent}: {len(there)} masks for {len(self)} frames")
        if depths and len(depths.files) != len(self):
            raise CaptureError(f"{depths.files[0].parent}: {len(depths.files)} depth images for {len(self)} frames")
        self.masks = there
        self.has_alpha = alpha or bool(there)
        self.background: np.ndarray | None = None

    def __len__(self) -> int:
        return self._source.frame_count if isinstance(self._source, Video) else len(self._source)

    @property
    def subject_alone(self) -> bool:
        """Whether nothing is known behind the subject: the mask is the image's own alpha or found by the background."""
        return self.has_alpha and not self.masks

    @property
    def fps(self) -> float:
        """Frames per second of the video; `FPS` for images."""
        return self._source.fps if isinstance(self._source, Video) else FPS

    def view(self, t: int) -> View:
        """Frame `t` as it was recorded, with its mask and its depth along the optical axis or along rays (`depths`)."""
        view = self.picture(t)
        if self.depths:
            height, width = view.rgb.shape[:2]
            view = replace(view, depth=self.depths.read(t, width, height))
        if self.background is not None:
            rgb, alpha = cut_out(view.rgb, self.background)
            return replace(view, rgb=rgb, alpha=alpha)
        if not self.masks:
            return view
        alpha = read_mask(self.masks[t], labels=self._labels)
        if alpha.shape != view.rgb.shape[:2]:
            raise CaptureError(f"{self.masks[t]}: mask is {_size(alpha.shape)}, its image {_size(view.rgb.shape)}")
        return replace(view, alpha=alpha)

    def picture(self, t: int) -> View:
        """Frame `t` as it was recorded, without the mask of a mask file."""
        if isinstance(self._source, Video):
            return View(self._source.frame(t))
        view = read_image(self._source[t])
        return view if self.has_alpha else replace(view, alpha=None)

    def opaque(self) -> bool:
        """Whether the first picture is opaque: no mask file, and no alpha channel or one that is 255 everywhere."""
        if self.masks or not self.has_alpha:
            return not self.masks
        try:
            return bool((self.picture(0).alpha == 255).all())
        except CaptureError:  # raised again where the picture is needed
            return False

    def numbers(self) -> list[int]:
        """The last number in the name of each image; empty: a video, or there are none."""
        found = [] if isinstance(self._source, Video) else [_numbers(p.stem) for p in self._source]
        return [n[-1] for n in found] if all(found) else []

    def name(self, t: int) -> Path:
        """The file that has frame `t`."""
        return self.path if isinstance(self._source, Video) else self._source[t]


def feed_of(source: Video | Sequence[Path], masks: Path, depths: DepthImages | None = None) -> Feed:
    """The footage of a camera whose masks are files in a folder of its own. If there are as many as frames, their order
    counts, otherwise their numbers.

    Raises:
        CaptureError: see `Feed`; or no mask has the number of a frame.
    """
    if isinstance(source, Video):
        stems = [f"{t:06}" for t in range(source.frame_count)]
    else:
        stems = [image.stem for image in source]
    there = numbered(masks)
    if there and len(there) != len(stems):
        by_numbers = {_numbers(m.stem) or m.stem: m for m in there}
        found = [by_numbers.get(_numbers(stem) or stem) for stem in stems]
        if not any(found):
            raise CaptureError(f"{masks}: {len(there)} masks for {len(stems)} frames, expected the numbers of frames")
        there = found
    return Feed(source, there, there or [masks / f"{stem}.png" for stem in stems], depths=depths)


def _numbers(stem: str) -> tuple[int, ...]:
    """The numbers in the name of a picture or mask."""
    return tuple(map(int, re.findall(r"[0-9]+", stem)))


def assemble(
    name: str,
    tracks: Sequence[Track],
    feeds: Sequence[Feed],
    fps: float | None = None,
    *,
    points: Points | None = None,
) -> Capture:
    """The capture of the cameras that `usable` returned. It ends with the shortest feed; a camera whose feed is less
    than half as long as the median, or lacks a picture before its end, is left out.

    Args:
        tracks: calibration of each camera, with or without distortion.
        feeds: footage of each camera.
        fps: frames per second; None: that of the first feed.
        points: sparse points that came with the capture.

    Raises:
        CaptureError: the feeds have no frames.
    """
    tracks, feeds, frame_count = _same_length(tracks, feeds)
    tracks, points = _near_origin(name, tracks, points)
    tracks = _as_drawn(_still(tracks))
    lenses = [Undistortion() for _ in tracks]
    pinholes = [[lens.camera(c) for c in track] for lens, track in zip(lenses, tracks, strict=True)]

    def read(index: int, frame: int) -> View:
        view, camera = feeds[index].view(frame), _at(tracks[index], frame)
        if view.rgb.shape[:2] != (camera.height, camera.width):
            raise CaptureError(
                f"{feeds[index].name(frame)}: camera {camera.name}, frame {frame} is {_size(view.rgb.shape)}, "
                f"expected {camera.width}x{camera.height} as the calibration says"
            )
        view, depths = lenses[index].view(view, camera), feeds[index].depths
        if depths and depths.along_ray:
            view = replace(view, depth=along_axis(view.depth, _at(pinholes[index], frame).K))
        return view

    def poses(index: int, frame: int) -> Camera:
        return _at(pinholes[index], frame)

    _find_masks(feeds)
    alpha = any(f.has_alpha for f in feeds)
    moving = any(len(track) > 1 for track in tracks)
    cameras = [track[0] for track in pinholes]
    fps, poses_of = fps or feeds[0].fps, poses if moving else None
    depth = any(f.depths for f in feeds)
    more = {"has_depth": depth, "poses": poses_of, "points": points, "footage": feeds}
    return Capture(name, fps, cameras, frame_count, alpha, read, **more)


def _find_masks(feeds: Sequence[Feed]) -> None:
    """Drops alpha channels that are 255 everywhere, which many tools write, and finds the background of pictures
    without masks."""
    if all(f.opaque() for f in feeds):
        for feed in feeds:
            feed.has_alpha = False
    if any(f.has_alpha for f in feeds):
        return
    try:
        first = [f.picture(0).rgb for f in feeds]
        if border_color(first) is None:  # a room: no second frame is read
            return
        color = background_of(first + [f.picture(len(f) // 2).rgb for f in feeds])
    except CaptureError:  # raised again where the picture is needed
        return
    if color is None:
        return
    warnings.warn(
        f"{feeds[0].path.parent}: no masks, and a background of one colour, {tuple(color.astype(int).tolist())}: what "
        f"differs from it is the subject (gscodec masks makes other masks)",
        stacklevel=5,
    )
    for feed in feeds:
        feed.background, feed.has_alpha = color, True


def _near_origin(name: str, tracks: Sequence[Track], points: Points | None) -> tuple[Sequence[Track], Points | None]:
    """Tracks and points of the capture `name`, in a world whose origin is near enough; warns if the origin is moved."""
    if not (origin := _origin(tracks)).any():
        return tracks, points
    warnings.warn(
        f"{name}: cameras so far from the origin of the world that single precision would blur the scene; it is "
        f"moved, so that {tuple(origin.tolist())} is the origin, in the stream, too",
        stacklevel=5,
    )
    tracks = [[c.seen_from(origin) for c in track] for track in tracks]
    return tracks, points and replace(points, means=points.means - origin)


def _origin(tracks: Sequence[Track]) -> np.ndarray:
    """[3] f64, an origin at which single precision is enough for positions: that of the world, unless the cameras are
    as far from it as in map coordinates. Then a rounded position near the cameras."""
    centers = np.array([c.center for track in tracks for c in track])
    middle = centers.mean(0)
    apart = np.linalg.norm(centers - middle, axis=1).max()
    focal = max(track[0].K[0, 0] for track in tracks)
    if np.finfo(np.float32).eps / 2 * np.linalg.norm(middle) * focal <= ROUNDED * apart or apart == 0:
        return np.zeros(3)
    unit = 10.0 ** (math.ceil(math.log10(apart)) + 1)
    return unit * np.rint(middle / unit)


def _as_drawn(tracks: Sequence[Track]) -> list[Track]:
    """The tracks with the low-pass of pictures, and, where the layout has no near plane, a near plane at `NEAR_SHARE`
    of the depth at which the optical axes meet."""
    meeting, out = meeting_point([track[0] for track in tracks]), []
    for track in tracks:
        depth = float(track[0].viewmat[2] @ [*meeting, 1])
        near = NEAR_SHARE * depth if track[0].near == NEAR and depth > 0 else track[0].near
        out.append([replace(c, near=near, low_pass=PIXEL_LOW_PASS) for c in track])
    return out


def _at(track: Track, frame: int) -> Camera:
    return track[frame if len(track) > 1 else 0]


def _still(tracks: Sequence[Track]) -> list[Track]:
    """The tracks, with a single entry for each camera that stands still."""
    scale = extent([track[0] for track in tracks])
    return [track if any(differs(c, track[0], scale) for c in track[1:]) else track[:1] for track in tracks]


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


def usable(source: Path, made: dict, make: Callable[[str, Any], tuple[Track, Feed]]) -> tuple[list[Track], list[Feed]]:
    """Makes the cameras of a capture. A camera that cannot be used is left out with a warning.

    Args:
        source: the calibration, for messages.
        made: camera name -> the second argument of `make`.
        make: (name, item of `made`) -> track and feed; raises CaptureError where the camera cannot be used.

    Returns:
        The tracks, at the size of their feeds, and the feeds.

    Raises:
        CaptureError: no camera can be used.
    """
    found, reason = [], "there are no cameras"
    for name, item in made.items():
        try:
            found.append(_fitted(*make(name, item)))
        except CaptureError as e:
            warnings.warn(f"{source}: camera {name} is left out: {e}", stacklevel=4)
            reason = str(e)
    if not found:
        raise CaptureError(f"{source}: no camera can be used; the last one: {reason}")
    tracks, feeds = zip(*found, strict=True)
    return list(tracks), list(feeds)


def _fitted(track: Track, feed: Feed) -> tuple[Track, Feed]:
    """The track at the size of its feed, which may be a smaller copy of the calibrated size."""
    if len(track) not in (1, len(feed)):
        raise CaptureError(f"{feed.path}: {len(feed)} frames, but poses of {len(track)}; expected one for each frame")
    for t, camera in enumerate(track):
        if abs(feed.width * camera.height - feed.height * camera.width) > max(camera.width, camera.height):
            calibration = "the calibration" + (f" of frame {t}" if t else "")
            raise CaptureError(
                f"{feed.path} is {feed.width}x{feed.height}, expected {camera.width}x{camera.height} "
                f"as {calibration} says, or that shape at another scale"
            )
    track, lens = [camera.resized(feed.width, feed.height) for camera in track], Undistortion()
    for camera in track:
        lens.camera(camera)  # raises CaptureError if it is no lens
    return track, feed


def numbered(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    """The images of a folder (or files with other `suffixes`) in the order of the numbers in their names."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in suffixes] if folder.is_dir() else []
    return sorted((p for p in paths if not p.name.startswith("._")), key=by_number)  # ._NAME: macOS's notes on NAME


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


def _same_length(tracks: Sequence[Track], feeds: Sequence[Feed]) -> tuple[list[Track], list[Feed], int]:
    """Tracks and feeds without the cameras whose feed is far too short or lacks a picture before its end; the number of
    frames of the shortest feed."""
    usual, longest = sorted(map(len, feeds))[len(feeds) // 2], max(feeds, key=len)
    gaps = [_gap(f, longest) for f in feeds]
    keep = [i for i, f in enumerate(feeds) if 2 * len(f) >= usual and gaps[i] is None]
    for i, f in enumerate(feeds):
        if gaps[i] is not None:
            warnings.warn(
                f"{f.path.parent}: camera {tracks[i][0].name} is left out: picture {gaps[i]} is missing, though "
                f"{longest.path.parent} has it",
                stacklevel=5,
            )
        elif len(f) < usual:
            what = f"the capture ends at frame {len(f)}" if i in keep else "the camera is left out"
            warnings.warn(f"{f.path}: short, {len(f)} of {usual} frames; {what}", stacklevel=5)
    count = min(len(feeds[i]) for i in keep)
    if count < 1:
        raise CaptureError(f"{feeds[keep[0]].path}: the videos have no frames")
    return [tracks[i] for i in keep], [feeds[i] for i in keep], count


def _gap(feed: Feed, longest: Feed) -> int | None:
    """Number of the first picture that `feed` lacks before its end, by the names; None: it lacks none."""
    own, every = feed.numbers(), longest.numbers()
    if not set(own) < set(every) or own == every[: len(own)]:
        return None
    return next(n for n in every if n not in own)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
