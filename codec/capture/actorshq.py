"""ActorsHQ (Isik et al. 2023) -> Capture: calibration.csv, rgbs/CAMERA/*.jpg, masks/CAMERA/*.png.

A line of calibration.csv has a camera's name, size, rotation vector and position (camera-to-world, OpenCV axes,
metres), focal lengths and principal point, both as shares of width and height.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require
from ..model.camera import Camera
from .capture import Capture
from .rig import Feed, Track, assemble, feed_of, numbered, pinhole, rigid, usable

NUMBERS = ("w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
FPS = 25.0


def open_actorshq(calibration: Path) -> Capture:
    """Reads calibration.csv and the folders rgbs and masks beside it. All cameras are for training.

    Raises:
        CaptureError: the file is not such a calibration, or no camera can be used.
    """
    root = calibration.parent
    made = {line["name"]: line for line in _lines(calibration)}

    def make(name: str, line: dict) -> tuple[Track, Feed]:
        images = numbered(root / "rgbs" / name)
        if not images:
            raise CaptureError(f"no images in {root / 'rgbs' / name}")
        return [_camera(name, line)], feed_of(images, root / "masks" / name)

    return assemble(root.resolve().name, *usable(calibration, made, make), FPS)


def _lines(path: Path) -> list[dict]:
    try:
        with path.open(newline="") as file:
            lines = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as e:
        raise CaptureError(f"{path}: not a table ({e}), expected calibration.csv of ActorsHQ") from e
    if not lines or not {"name", *NUMBERS} <= set(lines[0]):
        raise CaptureError(f"{path}: expected a line for each camera with the columns name, {', '.join(NUMBERS)}")
    return lines


def _camera(name: str, line: dict) -> Camera:
    try:
        v = [float(line[k]) for k in NUMBERS]
    except (ValueError, TypeError):
        v = [np.nan]
    if not np.isfinite(v).all():
        raise CaptureError(f"expected numbers {', '.join(NUMBERS)}")
    width, height = round(v[0]), round(v[1])
    K = pinhole(*(np.array(v[8:]) * [width, height, width, height]))
    R = require("cv2", "reading rotation vectors").Rodrigues(np.array(v[2:5]))[0].T
    return Camera(name, K, rigid(R, -R @ np.array(v[5:8])), width, height)
