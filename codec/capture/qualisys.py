"""Qualisys calibration (XML) and one video per camera -> Capture.

Layout: calibration/*.qca.txt and videos/<serial>.mp4. Intrinsics are in 1/64 pixel with pixel centres at integers,
positions in mm, distortion k1 k2 p1 p2 k3 as in OpenCV. The rows of the rotation r11..r33 are the camera's axes in
the world, x right, y up, z back (OpenGL): x_cv = diag(1, -1, -1) R (X - T). Of the four readings of that matrix (it
or its transpose, OpenGL or OpenCV axes) it is the one under which what four cameras see meets: in a recording of a
man on a treadmill the centre of his cap is met within 9 px in front of all cameras (the other readings: 134 to 470
px), and four bolts in the floor within 10 px and 10 mm of z = 0. Those 10 px (of 1920) are the calibration's own
error; no change of sign or order makes them fewer.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from gscodec.camera import Camera
from gscodec.capture.capture import Capture
from gscodec.capture.images import SUFFIXES, View, image_size, read_mask
from gscodec.capture.undistort import undistortion
from gscodec.capture.video import Video
from gscodec.errors import CaptureError

UNIT = 64  # calibration units per pixel
VIDEOS = (".mp4", ".mov", ".avi", ".mkv")
DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)  # OpenCV's order; the spelling is Qualisys'


def open_qualisys(root: Path, calibration: Path) -> Capture:
    """Reads a calibration file and the videos in `root`/videos (or beside it).

    Raises:
        CaptureError: the file is not a calibration, or no camera has a usable video.
    """
    cameras, videos = [], []
    for element in _cameras(calibration):
        name = element.get("serial", "?")
        try:
            camera, video = _camera(element, name), Video(_find_video(root, name))
            cameras.append(_at_size(camera, video))
            videos.append(video)
        except CaptureError as e:
            warnings.warn(f"{calibration}: camera {name} is left out: {e}", stacklevel=3)
            reason = str(e)
    if not cameras:
        raise CaptureError(f"{calibration}: no camera can be used; the last one: {reason}")
    cameras, videos, frame_count = _same_length(cameras, videos)
    masks = [_masks(root, c.name, frame_count) for c in cameras]
    pinholes, warps = zip(*(undistortion(c) for c in cameras), strict=True)

    def read(index: int, frame: int) -> View:
        alpha = read_mask(masks[index][frame]) if masks[index] else None
        return warps[index](View(videos[index].frame(frame), alpha))

    return Capture(root.resolve().name, videos[0].fps, list(pinholes), frame_count, any(masks), read)


def _cameras(calibration: Path) -> list[ET.Element]:
    try:
        found = ET.parse(calibration).getroot().findall("./cameras/camera")
    except ET.ParseError as e:
        raise CaptureError(f"{calibration}: not valid XML ({e}), expected a Qualisys calibration") from e
    if not found:
        raise CaptureError(f"{calibration}: no cameras, expected a Qualisys calibration with cameras/camera elements")
    return found


def _numbers(element: ET.Element, tag: str, keys: tuple[str, ...]) -> list[float]:
    child = element.find(tag)
    try:
        values = [float(child.get(k, 0 if "Distortion" in k else "")) for k in keys] if child is not None else []
    except ValueError:
        values = []
    if not values or not np.isfinite(values).all():
        raise CaptureError(f"<{tag}> is missing or incomplete, expected numbers {', '.join(keys)}")
    return values


def _camera(element: ET.Element, name: str) -> Camera:
    left, top, right, bottom = _numbers(element, "fov_video", ("left", "top", "right", "bottom"))
    u = _numbers(element, "intrinsic", ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV"))
    fx, fy, cx, cy = (v / UNIT for v in u)
    rotation = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
    R = np.array(_numbers(element, "transform", rotation)).reshape(3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise CaptureError("its rotation r11..r33 is singular or not a rotation")
    if min(fx, fy) <= 0:
        raise CaptureError(f"focal length {fx} x {fy} is not positive")
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.diag([1, -1, -1]) @ R
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.array(_numbers(element, "transform", ("x", "y", "z"))) / 1000
    K = np.array([[fx, 0, cx - left + 0.5], [0, fy, cy - top + 0.5], [0, 0, 1]])
    size = round(right - left) + 1, round(bottom - top) + 1
    return Camera(name, K, viewmat, *size, np.array(_numbers(element, "intrinsic", DISTORTION)))


def _find_video(root: Path, name: str) -> Path:
    folders = [f for f in (root / "videos", root) if f.is_dir()]
    for folder in folders:
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() in VIDEOS and path.stem == name:
                return path
    where = " or ".join(str(f) for f in folders)
    raise CaptureError(f"no video, looked for {name} with {', '.join(VIDEOS)} in {where}")


def _at_size(camera: Camera, video: Video) -> Camera:
    """The camera at the size of its video, which may be a smaller copy of what was calibrated."""
    if abs(video.width * camera.height - video.height * camera.width) > max(camera.width, camera.height):
        raise CaptureError(
            f"its video is {video.width}x{video.height}, expected {camera.width}x{camera.height} "
            "as the calibration says, or that shape at another scale"
        )
    return camera.resized(video.width, video.height)


def _same_length(cameras: list[Camera], videos: list[Video]) -> tuple[list[Camera], list[Video], int]:
    """The capture ends with its shortest video, unless that one is under half as long as usual: then it is left out."""
    usual = sorted(v.frame_count for v in videos)[len(videos) // 2]
    keep = [i for i, v in enumerate(videos) if 2 * v.frame_count >= usual]
    for i, v in enumerate(videos):
        if v.frame_count < usual:
            what = f"the capture ends at frame {v.frame_count}" if i in keep else "the camera is left out"
            warnings.warn(f"{v.path}: short video, {v.frame_count} of {usual} frames; {what}", stacklevel=4)
    count = min(videos[i].frame_count for i in keep)
    if count < 1:
        raise CaptureError(f"{videos[keep[0]].path}: the videos have no frames")
    return [cameras[i] for i in keep], [videos[i] for i in keep], count


def _masks(root: Path, name: str, frame_count: int) -> list[Path]:
    """Mask images masks/<camera>/*, in the order of their names; none if there is no such folder."""
    folder = root / "masks" / name
    if not folder.is_dir():
        return []
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    if len(paths) < frame_count:
        raise CaptureError(f"{folder}: {len(paths)} masks for {frame_count} frames")
    image_size(paths[0])  # a readable image
    return paths
