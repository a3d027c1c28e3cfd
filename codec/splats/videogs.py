"""VideoGS (V3, Wang et al. 2024): its checkpoints and its packed maps -> frames.

    checkpoint/FRAME/point_cloud/iteration_N/point_cloud.ply     as trained: standard .ply; of the last iteration saved
    feature_image/groupG/FRAME_PLANE.png, group_info.json, viewer_min_max.json (or min_max.json)
    feature_video/png_all_QP/groupG/PLANE.mp4, group_info.json, viewer_min_max.json

A column c of a checkpoint's .ply (position, normal, sh0, shN, opacity, scales, rotation) is plane c + 3 in 8 bits
between its least and largest value in the frame; a position is two planes, the low and the high byte of 16 bits. One of
the published scripts packs exp(scale), sigmoid(opacity) and harmonics by coefficient; the other packs all values as
trained. Only the first has no scale below 0.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.video import Video
from ..errors import CaptureError, require
from ..model.gaussian_sequence import DenseGroup
from ..model.gaussians import SH_COUNTS, Gaussians, logit
from .ply import split_rest

INFO, RANGES, RANGES_FLAT = "group_info.json", "viewer_min_max.json", "min_max.json"
PLAIN = 17  # columns without harmonics
SCALE_MIN = 1e-6  # a packed scale of 0 has no logarithm
GAUSSIANS_MAX = 50_000_000


def find_checkpoints(path: Path) -> list[Path]:
    """The .ply of each frame in order, of the last iteration that has one; empty if `path` holds no checkpoints.

    Raises:
        CaptureError: no iteration of a frame has one.
    """
    found = []
    for root in (path / "checkpoint", path):
        folders = [p for p in root.iterdir() if p.name.isdigit()] if root.is_dir() else []
        for folder in sorted(folders, key=lambda p: int(p.name)):
            saved = {int(m[1]): p for p in folder.glob("point_cloud/*") if (m := re.match(r"iteration_(\d+)$", p.name))}
            plys = [ply for n in sorted(saved) if (ply := saved[n] / "point_cloud.ply").is_file()]
            if saved and not plys:
                raise CaptureError(f"{folder}: no iteration has a point_cloud.ply, expected one; train the frame again")
            found += plys[-1:]
        if found:
            break
    return found


def find_packed(path: Path) -> Path | None:
    """The folder of packed maps in, or at, `path`; images are preferred to videos, which are lossy."""
    inside = [path, path / "feature_image", *sorted(path.glob("feature_video/*")), *sorted(path.glob("png_all_*"))]
    ranges = lambda p: (p / RANGES).is_file() or (p / RANGES_FLAT).is_file()  # noqa: E731
    return next((p for p in inside if (p / INFO).is_file() and ranges(p)), None)


@dataclass(frozen=True)
class PackedFrame:
    """Location of a packed frame, and the ranges of its integers.

    Attributes:
        folder: folder of its group.
        name: its number.
        place: its index in the videos of the group.
        count: number of Gaussians.
        ranges: [columns, 2] f64, least and largest value.
    """

    folder: Path
    name: int
    place: int
    count: int
    ranges: np.ndarray

    @property
    def side(self) -> int:
        """Width and height of the maps: the least multiple of 8 with room for all Gaussians."""
        return 8 * int(np.ceil(np.sqrt(self.count) / 8))


class OpenVideos:
    """The videos of one group at a time; thread-safe."""

    def __init__(self):
        self._folder, self._videos, self._lock = None, {}, threading.Lock()

    def of(self, path: Path) -> Video:
        """The video at `path`; those of other folders are closed."""
        with self._lock:
            if self._folder != path.parent:
                self._folder, self._videos = path.parent, {}
            if path not in self._videos:
                self._videos[path] = Video(path)
            return self._videos[path]


class PackedFrames(Sequence):
    """Frames of a group, read on demand; thread-safe."""

    def __init__(self, frames: list[PackedFrame], videos: OpenVideos):
        self._frames, self._videos = frames, videos

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, t):
        if isinstance(t, slice):
            return PackedFrames(self._frames[t], self._videos)
        return _gaussians(self._frames[t], self._plane)

    def _plane(self, frame: PackedFrame, plane: int) -> np.ndarray:
        """[count] u8."""
        image = frame.folder / f"{frame.name}_{plane}.png"
        pixels = _read_image(image, frame.side) if image.is_file() else self._read_video(frame, plane)
        if pixels.shape != (frame.side, frame.side):
            where = f"{frame.folder}: plane {plane} of frame {frame.name}"
            raise CaptureError(f"{where} is {pixels.shape}, expected {frame.side} x {frame.side} grey pixels")
        return pixels.ravel()[: frame.count]

    def _read_video(self, frame: PackedFrame, plane: int) -> np.ndarray:
        path = frame.folder / f"{plane}.mp4"
        if not path.is_file():
            raise CaptureError(
                f"{frame.folder}: neither {frame.name}_{plane}.png nor {plane}.mp4, VideoGS packs either"
            )
        video = self._videos.of(path)
        if (video.width, video.height) != (frame.side, frame.side):
            return np.zeros((video.height, video.width))
        return video.frame(frame.place)[..., 1]


def _read_image(path: Path, side: int) -> np.ndarray:
    """[H, W] u8; other sizes than `side` are not decoded."""
    cv2, data = require("cv2", "reading VideoGS maps"), path.read_bytes()
    size = tuple(int.from_bytes(data[i : i + 4], "big") for i in (20, 16))  # height and width of a PNG
    if size != (side, side):
        return np.zeros((0, 0))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8:
        raise CaptureError(f"{path}: not a readable 8-bit grey PNG")
    return image


def _gaussians(f: PackedFrame, plane) -> Gaussians:
    columns = len(f.ranges)
    low, high = f.ranges.T
    unit = [(plane(f, 2 * c) + 256.0 * plane(f, 2 * c + 1)) / 65535 for c in range(3)]
    unit += [np.zeros(f.count) if c < 6 else plane(f, c + 3) / 255.0 for c in range(3, columns)]  # normals are not read
    v = np.stack(unit, 1) * (high - low) + low
    sh, rest = v[:, 6:9], v[:, 9 : columns - 8]
    opacity, scales, quats = v[:, -8], v[:, -7:-4], v[:, -4:]
    if low[-7:-4].min() >= 0:  # packed by compress_ckpt_2_image_precompute.py
        opacity, scales = logit(opacity), np.log(np.maximum(scales, SCALE_MIN))
        shN = rest.reshape(f.count, -1, 3) if rest.shape[1] else np.zeros((f.count, 0, 3))
    else:
        shN = split_rest(rest) if rest.shape[1] else np.zeros((f.count, 0, 3))
    quats = np.where(quats.any(1, keepdims=True), quats, (1, 0, 0, 0))
    return Gaussians(v[:, :3], quats, scales, opacity, sh, shN).validate(f"{f.folder}, frame {f.name}")


def open_packed(folder: Path, gop: int) -> tuple[list[DenseGroup], list[str]]:
    """The groups, of at most `gop` frames, and the names of all frames. In a group of VideoGS index i is one Gaussian.

    Raises:
        CaptureError: a JSON file is damaged or does not fit the other.
    """
    ranges, groups, names, videos = _ranges(folder), [], [], OpenVideos()
    try:
        spans = {int(k): [int(n) for n in v["name_index"]] for k, v in json.loads((folder / INFO).read_text()).items()}
        spans = {k: (first, last) for k, (first, last) in sorted(spans.items())}
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise CaptureError(
            f"{folder / INFO}: not valid ({e}), expected name_index: [first, last] of each group"
        ) from None
    for number, (first, last) in spans.items():
        own = [n for n in sorted(ranges) if first <= n <= last]
        group = folder / f"group{number}"
        frames = [PackedFrame(group, n, i, *ranges[n]) for i, n in enumerate(own)]
        if not frames or len({f.count for f in frames}) > 1:
            counts = sorted({f.count for f in frames})
            raise CaptureError(
                f"{group}: frames {first} to {last} have {counts} Gaussians, expected one number of them"
            )
        same = np.arange(frames[0].count, dtype=np.int32)
        for a in range(0, len(frames), gop):
            groups.append(DenseGroup(PackedFrames(frames[a : a + gop], videos), parents=same if a else None))
        names += [str(n) for n in own]
    if not groups:
        raise CaptureError(f"{folder / INFO}: no groups, expected at least one")
    return groups, names


def _ranges(folder: Path) -> dict[int, tuple[int, np.ndarray]]:
    """Frame -> number of Gaussians, and [columns, 2] least and largest values."""
    path = folder / RANGES if (folder / RANGES).is_file() else folder / RANGES_FLAT
    try:
        data = json.loads(path.read_text())
        if path.name == RANGES_FLAT:
            data = _nested(data)
        found = {int(k): (int(v["num"]), np.array(v["info"], np.float64).reshape(-1, 2)) for k, v in data.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise CaptureError(f"{path}: not valid ({e}), expected num and info of each frame") from None
    for name, (count, values) in found.items():
        if (len(values) - PLAIN) % 3 or (len(values) - PLAIN) // 3 not in SH_COUNTS:
            raise CaptureError(f"{path}: frame {name} has {len(values)} columns, expected 17, 26, 41 or 62 (SH 0 to 3)")
        if not 0 < count <= GAUSSIANS_MAX or not np.isfinite(values).all():
            raise CaptureError(
                f"{path}: frame {name} has {count} Gaussians, expected 1 to {GAUSSIANS_MAX}, finite ranges"
            )
    return found


def _nested(flat: dict) -> dict:
    """min_max.json in the form of viewer_min_max.json: "0_num", "0_3_min" ... -> {"0": {"num": ..., "info": [...]}}."""
    frames = {k[:-4]: int(v) for k, v in flat.items() if k.endswith("_num")}
    out = {}
    for name, count in frames.items():
        columns = sum(k.startswith(f"{name}_") and k.endswith("_min") for k in flat)
        out[name] = {"num": count, "info": [flat[f"{name}_{c}_{m}"] for c in range(columns) for m in ("min", "max")]}
    return out
