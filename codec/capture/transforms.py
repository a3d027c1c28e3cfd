"""transforms.json (instant-ngp, nerfstudio) -> Capture.

The format lists images, we need cameras with all their frames: entries are grouped by `camera` (without it by pose,
as in a static rig), and ordered by `frame` or `time`. Poses are OpenGL camera-to-world (x right, y up, z back) and
become OpenCV world-to-camera. A camera that cannot be used is left out with a warning as long as others remain.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .images import SUFFIXES, image_size
from .rig import FPS, Feed, assemble, pinhole, usable

DISTORTION = ("k1", "k2", "p1", "p2", "k3")  # OpenCV's order


@dataclass
class Entry:
    """One item of `frames` with the file's defaults filled in."""

    camera: str
    time: float  # frame number, or seconds where there is none: only the order matters
    split: str
    image: Path
    mask: Path | None
    values: dict = field(repr=False)


def open_transforms(files: list[tuple[Path, str]]) -> Capture:
    """Reads one or more transforms files as one capture.

    Args:
        files: (path, default split) pairs: transforms.json, or transforms_train.json with transforms_test.json.

    Raises:
        CaptureError: no camera can be used; names file, camera and frame.
    """
    entries, fps = [], FPS
    for path, split in files:
        data = _load(path)
        fps = float(data.get("fps") or _fps(data["frames"]) or FPS)
        entries += _entries(data, path, split)
    source = files[0][0]
    times = _common_times(entries)

    def make(name: str, own: list[Entry]) -> tuple[Camera, Feed]:
        camera, by_time = _camera(name, own, times), {e.time: e for e in own}
        return camera, Feed([by_time[t].image for t in times], [by_time[t].mask for t in times])

    cameras, feeds = usable(source, _by_camera(entries), make)
    if not any(c.split == "train" for c in cameras):
        raise CaptureError(f"{source}: all {len(cameras)} cameras are test cameras, training needs split 'train' too")
    return assemble(source.parent.resolve().name, cameras, feeds, fps)


def _load(path: Path) -> dict:
    try:
        data = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as e:
        raise CaptureError(f"{path}: not valid JSON ({e})") from e
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise CaptureError(f"{path}: no 'frames', expected a transforms.json with a list of images and poses")
    model = data.get("camera_model", "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise CaptureError(f"{path}: camera_model {model} is not supported, undistort to OPENCV or PINHOLE first")
    return data


def _fps(frames: list[dict]) -> float | None:
    """From entries that have both a frame number and a time in seconds."""
    both = {int(f["frame"]): float(f["time"]) for f in frames if "frame" in f and "time" in f}
    if len(both) < 2:
        return None
    a, b = min(both), max(both)
    return (b - a) / (both[b] - both[a]) if both[b] > both[a] else None


def _entries(data: dict, path: Path, split: str) -> list[Entry]:
    shared = {k: v for k, v in data.items() if k != "frames"}
    listed = {n: s for s in ("train", "test", "val") for n in data.get(f"{s}_filenames", [])}
    out = []
    for i, f in enumerate(data["frames"]):
        if not isinstance(f, dict) or "file_path" not in f:
            raise CaptureError(f"{path}: frames[{i}] has no file_path")
        values = {**shared, **f}
        image = _with_suffix(path.parent / f["file_path"])
        own = str(f.get("split", listed.get(f["file_path"], split)))
        out.append(
            Entry(
                camera=str(f["camera"]) if "camera" in f else _pose_name(f, out),
                time=float(f.get("frame", f.get("time", 0))),
                split="train" if own == "train" else "test",
                image=image,
                mask=_mask(path.parent, image, f),
                values=values,
            )
        )
    return out


def _pose_name(f: dict, before: list[Entry]) -> str:
    """The camera of an entry that does not name one: entries with the same pose share it."""
    for e in before:
        if "camera" not in e.values and e.values.get("transform_matrix") == f.get("transform_matrix"):
            return e.camera
    return Path(f["file_path"]).with_suffix("").as_posix().removeprefix("./").replace("/", "_")


def _with_suffix(path: Path) -> Path:
    if path.suffix.lower() in SUFFIXES:
        return path
    found = [path.with_name(path.name + s) for s in SUFFIXES if path.with_name(path.name + s).is_file()]
    return found[0] if found else path


def _mask(root: Path, image: Path, f: dict) -> Path | None:
    """mask_path of the entry, or the same name under masks/ instead of the first folder (images/)."""
    if "mask_path" in f:
        return root / f["mask_path"]
    parts = Path(f["file_path"]).parts
    if len(parts) < 2 or not (root / "masks").is_dir():
        return None
    here = (root / "masks").joinpath(*[p for p in parts if p != "."][1:])
    found = [m for s in ("", *SUFFIXES) if (m := here.with_name(image.stem + (s or image.suffix))).is_file()]
    return found[0] if found else None


def _common_times(entries: list[Entry]) -> list[float]:
    """The frames that most cameras have; cameras that lack one of them are left out later."""
    count = Counter(t for _, t in {(e.camera, e.time) for e in entries})
    return sorted(t for t, n in count.items() if 2 * n > max(count.values()))


def _by_camera(entries: list[Entry]) -> dict[str, list[Entry]]:
    out: dict[str, list[Entry]] = {}
    for e in entries:
        out.setdefault(e.camera, []).append(e)
    return dict(sorted(out.items()))


def _camera(name: str, entries: list[Entry], times: list[float]) -> Camera:
    """One camera of the capture, with all that could make it unusable checked.

    Raises:
        CaptureError: a frame or an image is missing, the pose is missing, singular or moves, or a size is wrong.
    """
    have = {e.time: e for e in entries}
    missing = [t for t in times if t not in have]
    if missing:
        raise CaptureError(f"frame {missing[0]:g} is missing ({len(missing)} of {len(times)} frames)")
    for e in entries:
        if not e.image.is_file():
            raise CaptureError(f"frame {e.time:g}: image {e.image} is missing")
    first = have[times[0]]
    viewmat = _viewmat(first)
    for e in entries:
        if not np.allclose(_viewmat(e), viewmat, atol=1e-5):
            raise CaptureError(f"it moves at frame {e.time:g}; only fixed cameras are supported")
    width, height, _ = image_size(first.image)
    v = first.values
    if (int(v.get("w", width)), int(v.get("h", height))) != (width, height):
        raise CaptureError(f"image {first.image} is {width}x{height}, expected {v.get('w')}x{v.get('h')} (w, h)")
    distortion = np.array([float(v.get(k, 0)) for k in DISTORTION])
    return Camera(name, _intrinsics(v, width, height), viewmat, width, height, distortion, first.split)


def _intrinsics(v: dict, width: int, height: int) -> np.ndarray:
    if "fl_x" in v:
        fx, fy = float(v["fl_x"]), float(v.get("fl_y", v["fl_x"]))
    elif "camera_angle_x" in v:
        fx = 0.5 * width / math.tan(0.5 * float(v["camera_angle_x"]))
        fy = 0.5 * height / math.tan(0.5 * float(v["camera_angle_y"])) if "camera_angle_y" in v else fx
    else:
        raise CaptureError("no focal length, expected fl_x (pixels) or camera_angle_x (radians)")
    return pinhole(fx, fy, float(v.get("cx", width / 2)), float(v.get("cy", height / 2)))


def _viewmat(e: Entry) -> np.ndarray:
    """[4, 4] world-to-camera, OpenCV axes, out of the OpenGL camera-to-world matrix (a uniform scale is removed)."""
    if "transform_matrix" not in e.values:
        raise CaptureError(f"frame {e.time:g} has no pose (transform_matrix)")
    try:
        m = np.array(e.values["transform_matrix"], np.float64)
    except ValueError:
        m = np.zeros(0)
    if m.shape not in ((4, 4), (3, 4)) or not np.isfinite(m).all():
        raise CaptureError(f"frame {e.time:g}: transform_matrix is not 4x4 finite numbers")
    u, s, vt = np.linalg.svd(m[:3, :3])
    if s[2] < 1e-6 or s[0] > 1.01 * s[2] or np.linalg.det(m[:3, :3]) < 0:
        raise CaptureError(f"frame {e.time:g}: transform_matrix is singular, sheared or mirrored, expected a rotation")
    R = (u @ vt) * [1, -1, -1]  # columns: OpenGL camera axes -> OpenCV
    out = np.eye(4)
    out[:3, :3] = R.T
    out[:3, 3] = -R.T @ m[:3, 3]
    return out
