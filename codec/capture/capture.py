"""A multi-view capture as the later stages see it: a pinhole camera and a view for each camera and frame.

Layout (reader) -> Capture -> train, metrics. A view is decoded when it is asked for and is not kept, so a capture may
be larger than memory; any number of threads may ask at once. Colours are 8-bit sRGB, not premultiplied. They are
composited in sRGB, on a background that the caller names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import UsageError
from ..model.camera import Camera
from .images import View, resize_area
from .points import Points

if TYPE_CHECKING:
    from .rig import Feed

MARGIN = 24  # pixels of background kept around the subject
STILL = 1e-6  # relative change; a camera whose values change by less stands still


@dataclass(frozen=True)
class Capture:
    """Synchronised images of cameras that stand still or move.

    Attributes:
        name: name of the folder, for messages and reports.
        fps: frames a second.
        cameras: undistorted pinhole cameras, as they are in frame 0; each has an image of every frame.
        frame_count: frames of this (possibly restricted) capture.
        has_alpha: views have an alpha channel (from the images, from masks, or cut out of a background of one colour).
        has_depth: views of at least one camera have depth.
        read: (camera index, frame of the source) -> View at the source's size, undistorted; thread-safe.
        first_frame: source frame that is frame 0 here.
        poses: (camera index, frame of the source) -> the camera in that frame; only its K (at the source's size) and
            its viewmat are used; thread-safe. None: no camera moves.
        points: sparse points that came with the capture; None: there are none.
        footage: the recorded footage of each camera; empty if the capture is not read from files.
    """

    name: str
    fps: float
    cameras: Sequence[Camera]
    frame_count: int
    has_alpha: bool
    read: Callable[[int, int], View]
    first_frame: int = 0
    has_depth: bool = False
    poses: Callable[[int, int], Camera] | None = None
    points: Points | None = None
    footage: Sequence[Feed] = ()

    def view(self, camera_index: int, frame: int) -> View:
        """The image of a camera at a frame, at the camera's size.

        Raises:
            UsageError: there is no such camera or frame.
            CaptureError: the image cannot be read or has another size than the calibration says.
        """
        self._check(camera_index, frame)
        camera = self.cameras[camera_index]
        return resize_area(self.read(camera_index, self.first_frame + frame), camera.width, camera.height)

    def camera(self, camera_index: int, frame: int) -> Camera:
        """The camera that took `view(camera_index, frame)`. Name, size and split are the same in all frames.

        Raises:
            UsageError: there is no such camera or frame.
        """
        self._check(camera_index, frame)
        reference = self.cameras[camera_index]
        if self.poses is None:
            return reference
        there = self.poses(camera_index, self.first_frame + frame).resized(reference.width, reference.height)
        return replace(reference, K=there.K, viewmat=there.viewmat)

    @property
    def moves(self) -> bool:
        """Whether the pose or the intrinsics of any camera change between frames."""
        if self.poses is None:
            return False
        scale = extent(self.cameras)
        return any(
            differs(self.camera(i, t), reference, scale)
            for i, reference in enumerate(self.cameras)
            for t in range(1, self.frame_count)
        )

    def _check(self, camera_index: int, frame: int) -> None:
        if not 0 <= camera_index < len(self.cameras):
            raise UsageError(f"{self.name}: no camera {camera_index}, there are {len(self.cameras)} (0 to n - 1)")
        if not 0 <= frame < self.frame_count:
            raise UsageError(f"{self.name}: no frame {frame}, there are {self.frame_count} (0 to n - 1)")

    def indices(self, split: str) -> list[int]:
        """Indices of the cameras of a split, "train" or "test"."""
        return [i for i, c in enumerate(self.cameras) if c.split == split]

    def frames(self, start: int | None, stop: int | None = None) -> Capture:
        """The frames [start, stop) as a new capture. None: the first or the last frame; negative ends count back.

        Raises:
            UsageError: no frame is left.
        """
        a, b, _ = slice(start, stop).indices(self.frame_count)
        if b <= a:
            raise UsageError(f"{self.name}: frames {start}:{stop} is empty, the capture has {self.frame_count} frames")
        cameras = [self.camera(i, a) for i in range(len(self.cameras))]
        return replace(self, cameras=cameras, first_frame=self.first_frame + a, frame_count=b - a)

    def with_low_pass(self, low_pass: float) -> Capture:
        """The capture with another low-pass of its cameras (variance, px^2)."""
        return replace(self, cameras=[replace(c, low_pass=low_pass) for c in self.cameras])

    def scaled(self, scale: float) -> Capture:
        """The capture with images `scale` times the size (area filter), at least 1 pixel.

        Raises:
            UsageError: the scale is not in (0, 1].
        """
        if not 0 < scale <= 1:
            raise UsageError(f"image scale {scale} is outside (0, 1]; images are only ever made smaller")
        size = [(max(1, round(c.width * scale)), max(1, round(c.height * scale))) for c in self.cameras]
        return replace(self, cameras=[c.resized(w, h) for c, (w, h) in zip(self.cameras, size, strict=True)])


def extent(cameras: Sequence[Camera]) -> float:
    """Largest distance of a camera from the origin, world units: the scale that `differs` needs."""
    return max(float(np.linalg.norm(c.viewmat[:3, 3])) for c in cameras)


def differs(a: Camera, b: Camera, scale: float) -> bool:
    """Whether two cameras differ in pose, intrinsics or distortion by more than rounding errors (`STILL`).

    Args:
        scale: length, world units; errors of positions are relative to it.
    """
    if a.distortion.shape != b.distortion.shape or a.fisheye != b.fisheye:
        return True
    pairs = ((a.viewmat[:3, :3], b.viewmat[:3, :3], 1.0), (a.viewmat[:3, 3], b.viewmat[:3, 3], scale))
    pairs += ((a.K, b.K, a.width), (a.distortion, b.distortion, 1.0))
    return any(np.abs(x - y).max(initial=0) > STILL * size for x, y, size in pairs)


def cropped(view: View, camera: Camera) -> tuple[View, Camera]:
    """The part of a view with the subject and MARGIN pixels around it; without alpha or subject the whole view."""
    if view.alpha is None or not view.alpha.any():
        return replace(view, rgb=np.ascontiguousarray(view.rgb)), camera
    (height, width), alpha = view.alpha.shape, view.alpha
    rows, cols = np.flatnonzero(alpha.any(1)), np.flatnonzero(alpha.any(0))
    top, bottom = max(rows[0] - MARGIN, 0), min(rows[-1] + 1 + MARGIN, height)
    left, right = max(cols[0] - MARGIN, 0), min(cols[-1] + 1 + MARGIN, width)
    part = (slice(top, bottom), slice(left, right))
    depth = None if view.depth is None else np.ascontiguousarray(view.depth[part])
    part_of = View(np.ascontiguousarray(view.rgb[part]), np.ascontiguousarray(alpha[part]), depth)
    return part_of, camera.cropped(left, top, right - left, bottom - top)


def blend(view: View, background: Sequence[float]) -> np.ndarray:
    """[H, W, 3] f32, 0 to 255: the view over `background` (r, g, b in 0..1), in sRGB as splat renderers do."""
    if view.alpha is None:
        return view.rgb.astype(np.float32)
    a = view.alpha[..., None].astype(np.float32) / 255
    return view.rgb * a + np.asarray(background, np.float32) * (255 * (1 - a))


def composite(view: View, background: Sequence[float]) -> np.ndarray:
    """[H, W, 3] u8: `blend`, rounded."""
    return view.rgb if view.alpha is None else (blend(view, background) + 0.5).astype(np.uint8)
