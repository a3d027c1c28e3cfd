"""transforms.json (instant-ngp, nerfstudio) -> Capture.

The format lists images, a capture has cameras with all their frames: entries are grouped by `camera` and ordered by
`frame` or `time`. Each entry has its own pose and may have its own intrinsics, so cameras may move (D-NeRF: one camera
with another pose in each frame). Poses are OpenGL camera-to-world (x right, y up, z back) and become OpenCV
world-to-camera. `near`, in the head or in an entry, is a near plane in the units of the poses. `ply_file_path` names
sparse points in the world of the poses. `depth_file_path` names the depth image of an entry, along the optical axis;
its values times `depth_unit_scale_factor` (default 0.001, as in nerfstudio) are world units.
"""

from __future__ import annotations

import json
import math
import warnings
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..errors import CaptureError
from .capture import Capture
from .depth import DepthImages
from .images import SUFFIXES, image_size
from .points import Points, read_ply_points
from .rig import FPS, Feed, Track, assemble, usable
from .transforms_camera import FISHEYE, entry_camera

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
MILLIMETRES = 0.001  # world units of one step of a depth image, if the file does not state them


@dataclass
class Entry:
    """One item of `frames`, completed from the head of the file.

    Attributes:
        camera: camera name; if the file has none, None until `_name_cameras`.
        time: frame number, or seconds if there is none: only the order matters.
        values: keys of the head of the file, overridden by keys of the item.
    """

    camera: str | None
    time: float
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
    entries, fps, points = [], None, None
    for path, split in files:
        data = _load(path)
        entries += _entries(data, path, split)
        fps = fps or _fps(data, path)
        points = points or _points(data, path)
    source = files[0][0]
    times = _common_times(entries)

    def make(name: str, own: list[Entry]) -> tuple[Track, Feed]:
        of_camera = _at_times(name, own, times)
        files = [e.mask or _mask_file(source.parent, e.image, e.values) for e in of_camera]
        images, masks, depths = [e.image for e in of_camera], [e.mask for e in of_camera], _depths(source, of_camera)
        return _track(name, of_camera), Feed(images, masks, files, depths=depths)

    tracks, feeds = usable(source, _by_camera(entries), make)
    if not any(track[0].split == "train" for track in tracks):
        raise CaptureError(f"{source}: all {len(tracks)} cameras are test cameras, training needs split 'train' too")
    return assemble(source.parent.resolve().name, tracks, feeds, fps or FPS, points=points)


def _load(path: Path) -> dict:
    try:
        data = json.loads(path.read_text())
    except (ValueError, UnicodeDecodeError) as e:
        raise CaptureError(f"{path}: not valid JSON ({e})") from e
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list) or not data["frames"]:
        raise CaptureError(f"{path}: no 'frames', expected a transforms.json with a list of images and poses")
    for where in (data, *data["frames"]):
        model = where.get("camera_model", "OPENCV") if isinstance(where, dict) else "OPENCV"
        if model not in (*MODELS, FISHEYE):
            known = ", ".join((*MODELS, FISHEYE))
            raise CaptureError(f"{path}: camera_model {model} is not supported, expected {known}; undistort it first")
    return data


def _points(data: dict, path: Path) -> Points | None:
    """The points that `ply_file_path` names; None: the file has no such key."""
    name = data.get("ply_file_path")
    if name is None:
        return None
    if not isinstance(name, str):
        raise CaptureError(f"{path}: ply_file_path is {name!r}, expected the name of a .ply file")
    return read_ply_points(path.parent / name)


def _fps(data: dict, path: Path) -> float | None:
    """Frames a second: `fps` of the file, or from entries that have both a frame number and a time in seconds; None:
    the file does not tell."""
    try:
        both = {int(f["frame"]): float(f["time"]) for f in data["frames"] if "frame" in f and "time" in f}
        fps = float(data.get("fps") or 0)
    except (TypeError, ValueError) as e:
        raise CaptureError(f"{path}: fps, frame or time is not a number ({e})") from e
    if fps > 0 or not both:
        return fps if fps > 0 else None
    a, b = min(both), max(both)
    return (b - a) / (both[b] - both[a]) if both[b] > both[a] else None


def _entries(data: dict, path: Path, split: str) -> list[Entry]:
    shared = {k: v for k, v in data.items() if k != "frames"}
    listed = {n: s for s in ("train", "test", "val") for n in _names(data, f"{s}_filenames", path)}
    out = []
    for i, f in enumerate(data["frames"]):
        if not isinstance(f, dict) or not f.get("file_path"):
            raise CaptureError(f"{path}: frames[{i}] has no file_path")
        for key in ("file_path", "mask_path"):
            if not isinstance(f.get(key) or "", str):  # null: there is none
                raise CaptureError(f"{path}: {key} of frames[{i}] is {f[key]!r}, expected the name of an image")
        values = {**shared, **f}
        image = _with_suffix(path.parent / f["file_path"])
        own = str(f.get("split", listed.get(f["file_path"], split)))
        try:
            time = float(f.get("frame", f.get("time", 0)))
        except (TypeError, ValueError):
            raise CaptureError(f"{path}: frame or time of frames[{i}] is not a number") from None
        out.append(
            Entry(
                camera=str(f["camera"]) if "camera" in f else None,
                time=time,
                split="train" if own == "train" else "test",
                image=image,
                mask=_mask(path.parent, image, f),
                values=values,
            )
        )
    return _name_cameras(out)


def _names(data: dict, key: str, path: Path) -> list[str]:
    names = data.get(key) or []
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise CaptureError(f"{path}: {key} is {names!r}, expected a list of the names of images")
    return names


def _name_cameras(entries: list[Entry]) -> list[Entry]:
    """The entries of a file, each with a camera.

    Entries without `camera` in one folder are one camera, which may move, if all have different frames or times.
    Otherwise entries with the same pose are one camera, which stands still.
    """
    folders: dict[Path, list[Entry]] = {}
    for e in entries:
        if e.camera is None:
            folders.setdefault(Path(e.values["file_path"]).parent, []).append(e)
    one = {
        folder
        for folder, own in folders.items()
        if 1 < len(own) == len({e.time for e in own}) and all("frame" in e.values or "time" in e.values for e in own)
    }
    by_pose: dict[str, str] = {}
    named = []
    for e in entries:
        path = Path(e.values["file_path"])
        name = e.camera
        if name is None and path.parent in one:
            name = _joined(path.parent)
        elif name is None:
            name = by_pose.setdefault(str(e.values.get("transform_matrix")), _joined(path.with_suffix("")))
        named.append(replace(e, camera=name))
    return named


def _joined(path: Path) -> str:
    return path.as_posix().replace("/", "_")


def _with_suffix(path: Path) -> Path:
    if path.suffix.lower() in SUFFIXES:
        return path
    found = [path.with_name(path.name + s) for s in SUFFIXES if path.with_name(path.name + s).is_file()]
    return found[0] if found else path


def _mask(root: Path, image: Path, f: dict) -> Path | None:
    """mask_path of the entry, or the same name under masks/, there without a first folder images, images_2 ..."""
    if f.get("mask_path"):
        return root / f["mask_path"]
    here = _mask_file(root, image, f)
    if not (root / "masks").is_dir():
        return None
    found = [m for s in ("", *SUFFIXES) if (m := here.with_name(image.stem + (s or image.suffix))).is_file()]
    return found[0] if found else None


def _mask_file(root: Path, image: Path, f: dict) -> Path:
    """The path of an image's mask, as .png."""
    parts = [p for p in Path(f["file_path"]).parts if p not in (".", "..", "/")]
    own = parts[1:] if len(parts) > 1 and parts[0].startswith("images") else parts
    return (root / "masks").joinpath(*own).with_name(image.stem + ".png")


def _depths(source: Path, entries: list[Entry]) -> DepthImages | None:
    """The depth images of the entries of a camera; None: no entry has one.

    Raises:
        CaptureError: a name or the unit is wrong, or an image is missing.
    """
    names = [e.values["depth_file_path"] for e in entries if e.values.get("depth_file_path") is not None]
    if not names:
        return None
    unit = entries[0].values.get("depth_unit_scale_factor", MILLIMETRES)
    if not isinstance(unit, int | float) or not 0 < unit < math.inf:
        raise CaptureError(f"depth_unit_scale_factor is {unit!r}, expected world units of one step, such as 0.001")
    wrong = next((n for n in names if not isinstance(n, str)), None)
    if wrong is not None:
        raise CaptureError(f"depth_file_path is {wrong!r}, expected the name of a depth image")
    files = [source.parent / n for n in names]
    missing = next((f for f in files if not f.is_file()), None)
    if missing is not None:
        raise CaptureError(f"depth image {missing} is missing")
    return DepthImages(files, float(unit))


def _common_times(entries: list[Entry]) -> list[float]:
    """The frames that most cameras have, or those of a single training camera (D-NeRF); cameras that lack one of them
    are left out later."""
    trained = [e for e in entries if e.split == "train"]
    alone = len({e.camera for e in trained}) == 1
    count = Counter(t for _, t in {(e.camera, e.time) for e in (trained if alone else entries)})
    return sorted(t for t, n in count.items() if 2 * n > max(count.values()))


def _by_camera(entries: list[Entry]) -> dict[str, list[Entry]]:
    out: dict[str, list[Entry]] = {}
    for e in entries:
        out.setdefault(e.camera, []).append(e)
    return dict(sorted(out.items()))


def _at_times(name: str, entries: list[Entry], times: list[float]) -> list[Entry]:
    """The entries of camera `name`, one for each of `times`; warns about entries of the same frame, and about test
    images among training images.

    Raises:
        CaptureError: a frame, its image or its mask is missing.
    """
    have = {e.time: e for e in entries}
    missing = [t for t in times if t not in have]
    if missing:
        raise CaptureError(f"frame {missing[0]:g} is missing ({len(missing)} of {len(times)} frames)")
    for t in times:
        for what, path in (("image", have[t].image), ("mask", have[t].mask)):
            if path and not path.is_file():
                raise CaptureError(f"frame {t:g}: {what} {path} is missing")
    _warn_of_lost(name, entries, have, times)
    return [have[t] for t in times]


def _warn_of_lost(name: str, entries: list[Entry], have: dict[float, Entry], times: list[float]) -> None:
    same, gone = len(entries) - len(have), have.keys() - set(times)
    if same:
        why = "they have the frame or time of another image; give each image of a camera its own 'frame' or 'time'"
        warnings.warn(f"camera {name}: {same} of {len(entries)} images are left out: {why}", stacklevel=7)
    if gone and len({e.split for e in entries}) > 1:
        why = "a camera is for training or for testing; name a test camera in 'camera'"
        lost = f"{len(gone)} of {len(entries)} images are left out, the first one is {have[min(gone)].image.name}"
        warnings.warn(f"camera {name}: {lost}: {why}", stacklevel=7)


def _track(name: str, entries: list[Entry]) -> Track:
    """The camera in each of its frames.

    Raises:
        CaptureError: names the frame whose pose, intrinsics or size are missing or wrong.
    """
    width, height, _ = image_size(entries[0].image)
    track = []
    for e in entries:
        try:
            camera = entry_camera(name, e.image, e.values, (width, height))
        except (TypeError, ValueError) as error:
            raise CaptureError(f"frame {e.time:g}: not a number ({error})") from error
        except CaptureError as error:
            raise CaptureError(f"frame {e.time:g}: {error}") from error
        track.append(replace(camera, split=entries[0].split))
    return track
