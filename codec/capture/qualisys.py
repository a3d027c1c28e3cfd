"""Qualisys calibration (XML) and one video per camera -> Capture.

Layout: calibration/*.qca.txt and videos/<serial>.mp4. Intrinsics are in 1/64 pixel with pixel centres at integers,
positions in mm, distortion k1 k2 p1 p2 k3 as in OpenCV. The rows of the rotation r11..r33 are the camera's axes in
the world, x right, y up, z back (OpenGL): x_cv = diag(1, -1, -1) R (X - T).

The format is not documented; the matrix could also be its transpose, or have OpenCV axes. In a recording with four
cameras, a point triangulated in this reading is reprojected within 9 px, in the other three within 134 to 470 px.
Four bolts in the floor are within 10 px and 10 mm of z = 0. The rest (10 of 1920 px) is the error of the calibration.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .rig import Feed, Track, assemble, feed_of, find_video, pinhole, rigid, usable
from .video import Video

UNIT = 64  # calibration units per pixel
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
    elements = {e.get("serial", "?"): e for e in _cameras(calibration)}
    folders = [f for f in (root / "videos", root) if f.is_dir()]

    def make(name: str, element: ET.Element) -> tuple[Track, Feed]:
        camera = _camera(element, name)
        return [camera], feed_of(Video(find_video(folders, name)), root / "masks" / name)

    return assemble(root.resolve().name, *usable(calibration, elements, make))


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
    turn = np.diag([1, -1, -1]) @ R
    viewmat = rigid(turn, -turn @ np.array(_numbers(element, "transform", ("x", "y", "z"))) / 1000)
    K = pinhole(fx, fy, cx - left + 0.5, cy - top + 0.5)
    size = round(right - left) + 1, round(bottom - top) + 1
    return Camera(name, K, viewmat, *size, np.array(_numbers(element, "intrinsic", DISTORTION)))
