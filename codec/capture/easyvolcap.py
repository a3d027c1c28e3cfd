"""EasyVolcap and EasyMocap -> Capture: intri.yml and extri.yml (OpenCV's), images/CAMERA/* or videos/CAMERA.mp4.

Cameras that stand still share one pair of files in the folder; its `names` are the cameras. Cameras that move have a
pair each in cameras/CAMERA/; its `names` are the frames. Masks are masks/CAMERA/*. Depth images are depths/CAMERA/*, in
world units along the ray of a pixel, as EasyVolcap's own loader takes them by default (`use_z_depth: False`).

World-to-camera, OpenCV axes: K_name [3, 3] in pixels with pixel centres at integers, D_name or dist_name as in OpenCV,
Rot_name [3, 3] or R_name (a rotation vector), T_name; W_name and H_name if the calibrated size is another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require
from ..model.camera import Camera
from .capture import Capture
from .depth import SUFFIXES as DEPTHS
from .depth import DepthImages
from .rig import Feed, Track, assemble, by_number, feed_of, find_video, numbered, pinhole, rigid, usable
from .video import Video


class _Yaml:
    """OpenCV's YAML files, which no YAML library reads."""

    def __init__(self, path: Path):
        self.path = path
        cv2 = require("cv2", "reading calibrations")
        try:
            self._file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        except (cv2.error, SystemError) as e:
            raise CaptureError(f"{path}: not a calibration file of OpenCV ({e})") from e
        if not self._file.isOpened():
            raise CaptureError(f"{path}: not a calibration file of OpenCV")

    def names(self) -> list[str]:
        """The list `names`, of strings or integers."""
        node = self._file.getNode("names")
        items = [node.at(i) for i in range(node.size())]
        return [i.string() if i.isString() else str(int(i.real())) for i in items]

    def matrix(self, key: str, *shape: int) -> np.ndarray:
        """[*shape] f64. Raises CaptureError: it is missing, has another shape, or is not finite."""
        return self._numbers(key, (np.prod(shape),), " x ".join(map(str, shape))).reshape(shape)

    def distortion(self, key: str) -> np.ndarray:
        """[4, 5 or 8] f64. Raises CaptureError: as `matrix`."""
        return self._numbers(key, (4, 5, 8), "4, 5 or 8")

    def _numbers(self, key: str, sizes: Sequence[int], expected: str) -> np.ndarray:
        """A matrix as one row, whose length is one of `sizes`; `expected`: these in words."""
        cv2 = require("cv2", "reading calibrations")
        try:
            m = self._file.getNode(key).mat()
        except cv2.error:  # not a matrix
            m = None
        if m is None or m.size not in sizes or not np.isfinite(m).all():
            raise CaptureError(f"{self.path}: {key} is missing or wrong, expected {expected} finite numbers")
        return m.ravel().astype(np.float64)

    def has(self, key: str) -> bool:
        return not self._file.getNode(key).empty()

    def number(self, key: str) -> int:
        """An integer, 0 where it is missing."""
        return int(self._file.getNode(key).real())


def find_calibration(root: Path) -> Path | None:
    """The folder of intri.yml and extri.yml: `root`, or `root`/cameras where each camera has its own pair there."""
    if _has_pair(root):
        return root
    return root / "cameras" if moving_cameras(root) else None


def moving_cameras(root: Path) -> list[Path]:
    """The folders of cameras that move, in the order of the numbers in their names."""
    folder = root / "cameras"
    return sorted(filter(_has_pair, folder.iterdir()), key=by_number) if folder.is_dir() else []


def _has_pair(folder: Path) -> bool:
    return (folder / "intri.yml").is_file() and (folder / "extri.yml").is_file()


def open_easyvolcap(root: Path, calibration: Path) -> Capture:
    """Reads the images or videos in `root` and their `calibration` (`find_calibration`). All cameras are for training.

    Raises:
        CaptureError: a file is not a calibration, or no camera can be used.
    """

    def feed(name: str) -> Feed:
        images = numbered(root / "images" / name)
        depths = numbered(root / "depths" / name, DEPTHS)
        source = images or Video(find_video([root / "videos"], name))
        return feed_of(source, root / "masks" / name, DepthImages(depths, along_ray=True) if depths else None)

    def moving(name: str, folder: Path) -> tuple[Track, Feed]:
        pair, footage = _pair(folder), feed(name)
        frames = sorted(pair[0].names(), key=lambda frame: by_number(Path(frame)))
        track = []
        for frame in frames:
            try:
                track.append(replace(_camera(frame, *pair, footage), name=name))
            except CaptureError as e:
                raise CaptureError(f"frame {frame}: {e}") from e
        return track, footage

    def fixed(name: str, pair: tuple[_Yaml, _Yaml]) -> tuple[Track, Feed]:
        footage = feed(name)
        return [_camera(name, *pair, footage)], footage

    if calibration == root:
        pair = _pair(root)
        found = usable(root / "intri.yml", dict.fromkeys(pair[0].names(), pair), fixed)
    else:
        found = usable(calibration, {f.name: f for f in moving_cameras(root)}, moving)
    return assemble(root.resolve().name, *found)


def _pair(folder: Path) -> tuple[_Yaml, _Yaml]:
    return _Yaml(folder / "intri.yml"), _Yaml(folder / "extri.yml")


def _camera(name: str, intrinsics: _Yaml, extrinsics: _Yaml, feed: Feed) -> Camera:
    K = intrinsics.matrix(f"K_{name}", 3, 3)
    K = pinhole(K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    if extrinsics.has(f"Rot_{name}"):
        R = extrinsics.matrix(f"Rot_{name}", 3, 3)
    else:
        R = require("cv2", "reading rotation vectors").Rodrigues(extrinsics.matrix(f"R_{name}", 3))[0]
    viewmat = rigid(R, extrinsics.matrix(f"T_{name}", 3))
    keys = [k for k in (f"D_{name}", f"dist_{name}") if intrinsics.has(k)]
    distortion = intrinsics.distortion(keys[0]) if keys else np.zeros(0)
    width = intrinsics.number(f"W_{name}") or feed.width
    height = intrinsics.number(f"H_{name}") or feed.height
    return Camera(name, K, viewmat, width, height, distortion)
