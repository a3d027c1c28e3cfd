"""COLMAP sparse models -> Capture, one frame a folder or all frames in one.

A folder has images/ and a model in sparse/0, sparse or colmap/sparse/0 (cameras and images, .bin or .txt). There are
two kinds of captures:

- One folder for each frame, in the order of their numbers (the layout of V3 and SpacetimeGaussians). An image has the
  name of its camera.
- One folder with all frames. Images named CAMERA/FRAME are the frames of a camera, images without a folder are single
  frames.

A camera whose known poses agree stands still, and one known pose is enough. A camera that moves needs a pose in every
frame. Masks are in masks/ under the same names. The points of the (first) model are those of the capture. Poses are
world-to-camera, OpenCV axes, pixel centres at half-integers.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture, differs, extent
from .colmap_points import read_colmap_points
from .images import SUFFIXES
from .rig import Feed, Track, assemble, by_number, numbered, pinhole, rigid, usable

MODELS = ("sparse/0", "sparse", "colmap/sparse/0")
# number of the camera model -> its name, and the index of the parameter that is fx, fy, cx, cy and then OpenCV's
# distortion: k1, k2, p1, p2, k3 ... k6, or k1, k2, k3, k4 of a fisheye lens
LENSES = {
    0: ("SIMPLE_PINHOLE", (0, 0, 1, 2)),
    1: ("PINHOLE", (0, 1, 2, 3)),
    2: ("SIMPLE_RADIAL", (0, 0, 1, 2, 3)),
    3: ("RADIAL", (0, 0, 1, 2, 3, 4)),
    4: ("OPENCV", (0, 1, 2, 3, 4, 5, 6, 7)),
    5: ("OPENCV_FISHEYE", (0, 1, 2, 3, 4, 5, 6, 7)),
    6: ("FULL_OPENCV", tuple(range(12))),
    8: ("SIMPLE_RADIAL_FISHEYE", (0, 0, 1, 2, 3)),
    9: ("RADIAL_FISHEYE", (0, 0, 1, 2, 3, 4)),
}
FISHEYE = (5, 8, 9)
NUMBERS = {name: number for number, (name, _) in LENSES.items()}


@dataclass(frozen=True)
class _Lens:
    width: int
    height: int
    params: list[float]  # fx, fy, cx, cy, k1 ...
    fisheye: bool


@dataclass(frozen=True)
class _Image:
    name: str
    lens: int
    quat: np.ndarray
    translation: np.ndarray


@dataclass(frozen=True)
class _Model:
    folder: Path
    lenses: dict[int, _Lens]
    images: dict[str, _Image]

    def camera(self, image: str) -> Camera | None:
        """The camera that took `image`; None where the model does not have the image.

        Raises:
            CaptureError: its lens is not in the model, or its pose is not a rotation.
        """
        from scipy.spatial.transform import Rotation

        if image not in self.images:
            return None
        i = self.images[image]
        lens = self.lenses.get(i.lens)
        if lens is None:
            raise CaptureError(f"{self.folder} has no camera {i.lens}, which took image {image}")
        fx, fy, cx, cy, *distortion = lens.params
        unit = 0 < np.linalg.norm(i.quat) < np.inf
        R = Rotation.from_quat(np.roll(i.quat, -1)).as_matrix() if unit else np.zeros((3, 3))  # `rigid` refuses it
        terms = np.array(distortion + [0.0] * (4 - len(distortion)))
        try:
            K, viewmat = pinhole(fx, fy, cx, cy), rigid(R, i.translation)
        except CaptureError as e:
            raise CaptureError(f"{self.folder}, image {image}: {e}") from e
        return Camera(_name(image), K, viewmat, lens.width, lens.height, terms, fisheye=lens.fisheye)


def find_model(folder: Path) -> Path | None:
    """The folder of the model in `folder`, or in the folder of the first frame."""
    if not folder.is_dir():
        return None
    return _model_in(folder) or next((m for f in frames_of(folder)[:1] if (m := _model_in(f))), None)


def _model_in(folder: Path) -> Path | None:
    places = (folder / model for model in MODELS)
    return next((p for p in places if any((p / f"images{s}").is_file() for s in (".bin", ".txt"))), None)


def frames_of(root: Path) -> list[Path]:
    """The folders of single frames, in order: those that contain a folder images/."""
    return sorted((f for f in root.iterdir() if (f / "images").is_dir()), key=by_number)


def open_colmap(root: Path) -> Capture:
    """Reads the capture in `root`. All cameras are for training.

    Raises:
        CaptureError: a model is damaged, its lens is not supported, or no camera can be used.
    """
    found = find_model(root)
    model = _read_model(found)
    if (root / "images").is_dir():
        made, make = _one_folder(root, model)
    else:
        made, make = _frame_folders(frames_of(root), model)
    tracks, feeds = usable(found, dict(sorted(made.items(), key=_by_number)), make)
    return assemble(root.resolve().name, tracks, feeds, points=read_colmap_points(found))


def _by_number(item: tuple[str, object]) -> list:
    return by_number(Path(item[0]))


def _frame_folders(frames: list[Path], first: _Model):
    """The arguments `made` and `make` of `usable`, for one folder per frame; `first`: model of the first frame."""
    models = [first, *(_read_model(own) if (own := _model_in(f)) else None for f in frames[1:])]

    def make(name: str, image: str) -> tuple[Track, Feed]:
        paths = [_there(f / "images" / image) for f in frames]
        masks = [_mask(f / "masks", Path(image)) for f in frames]
        files = [m or (f / "masks" / image).with_suffix(".png") for m, f in zip(masks, frames, strict=True)]
        return _track([m and m.camera(image) for m in models], paths), Feed(paths, masks, files)

    return {_name(image): image for image in first.images}, make


def _one_folder(root: Path, model: _Model):
    """The arguments `made` and `make` of `usable`, for one folder with all frames."""
    made: dict[str, list[str]] = {}
    for image in sorted(model.images, key=lambda i: by_number(Path(i))):
        made.setdefault(_name(image), []).append(image)

    def make(name: str, images: list[str]) -> tuple[Track, Feed]:
        paths = numbered((root / "images" / images[0]).parent) if "/" in images[0] else []
        paths = paths or [_there(root / "images" / images[0])]
        names = [p.relative_to(root / "images") for p in paths]
        masks = [_mask(root / "masks", n) for n in names]
        files = [m or (root / "masks" / n).with_suffix(".png") for m, n in zip(masks, names, strict=True)]
        known = [model.camera(n.as_posix()) for n in names]
        return _track(known if any(known) else [model.camera(images[0])], paths), Feed(paths, masks, files)

    return made, make


def _track(known: list[Camera | None], paths: list[Path]) -> Track:
    """The camera in each frame (image of `paths`); a single entry if it stands still and a frame has no pose.

    Raises:
        CaptureError: it moves, and a frame has no pose.
    """
    poses = [c for c in known if c is not None]
    if len(poses) == len(known):
        return poses
    moved = next((c for c in poses[1:] if differs(c, poses[0], extent(poses[:1]))), None)
    if moved is not None:
        t = known.index(None)
        raise CaptureError(f"frame {t}: the camera moves, but no model has a pose of image {paths[t]}")
    return poses[:1]


def _name(image: str) -> str:
    """The name of an image's camera: the folder of the image, or the image's own name without a folder."""
    path = Path(image)
    return path.parent.as_posix() if path.parent.name else path.stem


def _there(path: Path) -> Path:
    if not path.is_file():
        raise CaptureError(f"image {path} is missing")
    return path


def _mask(folder: Path, image: Path) -> Path | None:
    """The mask of an image: the same name with any suffix, or the whole name with .png appended (COLMAP's way)."""
    names = [image.with_suffix(s) for s in SUFFIXES] + [image.with_name(image.name + ".png")]
    return next((folder / n for n in names if (folder / n).is_file()), None)


def _read_model(folder: Path) -> _Model:
    binary = (folder / "images.bin").is_file()
    suffix, lenses, images = (".bin", _lenses_bin, _images_bin) if binary else (".txt", _lenses_txt, _images_txt)
    out = []
    for path, read in ((folder / f"cameras{suffix}", lenses), (folder / f"images{suffix}", images)):
        try:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                out.append(list(read(data)))  # the points of images.bin, most of the file, are never loaded
        except FileNotFoundError:
            raise CaptureError(f"{path}: the file is missing, expected a COLMAP model") from None
        except (struct.error, ValueError, IndexError, UnicodeDecodeError) as e:
            raise CaptureError(f"{path}: damaged ({e}), expected a COLMAP model") from e
    return _Model(folder, dict(out[0]), {image.name: image for image in out[1]})


def _lens(number: int, width: int, height: int, params: list[float]) -> _Lens:
    which = LENSES[number][1]
    if len(params) <= max(which):
        raise ValueError(f"camera model {LENSES[number][0]} has {len(params)} parameters, expected {max(which) + 1}")
    return _Lens(width, height, [params[i] for i in which], number in FISHEYE)


def _known(number: int | None, shown: object) -> int:
    if number not in LENSES:
        known = ", ".join(name for name, _ in LENSES.values())
        raise CaptureError(f"COLMAP camera model {shown} is not supported, undistort to PINHOLE first (known: {known})")
    return number


def _lenses_bin(data: mmap.mmap) -> Iterator[tuple[int, _Lens]]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        index, number, width, height = struct.unpack_from("<iiQQ", data, at)
        n = 1 + max(LENSES[_known(number, number)][1])
        params = struct.unpack_from(f"<{n}d", data, at + 24)
        at += 24 + 8 * n
        yield index, _lens(number, width, height, list(params))


def _images_bin(data: mmap.mmap) -> Iterator[_Image]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, lens = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise ValueError("a name does not end")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield _Image(data[at + 64 : end].decode(), lens, np.array(pose[:4]), np.array(pose[4:]))
        at = end + 9 + 24 * points


def _rows(data: mmap.mmap) -> list[list[str]]:
    lines = data[:].decode().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def _lenses_txt(data: mmap.mmap) -> Iterator[tuple[int, _Lens]]:
    for index, name, width, height, *params in filter(None, _rows(data)):
        number = _known(NUMBERS.get(name), name)
        yield int(index), _lens(number, int(width), int(height), [float(p) for p in params])


def _images_txt(data: mmap.mmap) -> Iterator[_Image]:
    for row in _rows(data)[::2]:  # every second line has the points
        if row:
            pose = np.array([float(v) for v in row[1:8]])
            yield _Image(" ".join(row[9:]), int(row[8]), pose[:4], pose[4:])
