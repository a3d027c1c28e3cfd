"""COLMAP sparse models -> Capture, one frame a folder or all frames in one.

A folder has images/ and a model in sparse/0, sparse or colmap/sparse/0 (cameras and images, .bin or .txt). Either the
capture is a folder of such folders, one a frame in the order of their numbers (V3's layout, SpacetimeGaussians'), where
an image's name is the camera's and the first frame's model holds for all; or it is one such folder, where images of
the model named CAMERA/FRAME have the other frames beside them, and images without a folder are single frames. Masks lie
in masks/ under the same names. Poses are world-to-camera, OpenCV axes, pixel centres at half-integers, as ours.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .images import SUFFIXES
from .rig import Feed, assemble, by_number, numbered, pinhole, rigid, usable

MODELS = ("sparse/0", "sparse", "colmap/sparse/0")
# number and name of the camera model -> which parameter is fx, fy, cx, cy, k1, k2, p1, p2 (None: 0)
LENSES = {
    0: ("SIMPLE_PINHOLE", (0, 0, 1, 2)),
    1: ("PINHOLE", (0, 1, 2, 3)),
    2: ("SIMPLE_RADIAL", (0, 0, 1, 2, 3)),
    3: ("RADIAL", (0, 0, 1, 2, 3, 4)),
    4: ("OPENCV", (0, 1, 2, 3, 4, 5, 6, 7)),
}
NUMBERS = {name: number for number, (name, _) in LENSES.items()}


@dataclass(frozen=True)
class _Lens:
    width: int
    height: int
    params: list[float]  # fx, fy, cx, cy, k1 ...


@dataclass(frozen=True)
class _Image:
    name: str
    lens: int
    quat: np.ndarray
    translation: np.ndarray


def find_model(folder: Path) -> Path | None:
    """The folder of the model in `folder`, or in the first frame's."""
    if not folder.is_dir():
        return None
    for place in (folder, *frames_of(folder)[:1]):
        for model in MODELS:
            if any((place / model / f"images{s}").is_file() for s in (".bin", ".txt")):
                return place / model
    return None


def frames_of(root: Path) -> list[Path]:
    """The folders of single frames, in order: those with an images/ folder in them."""
    return sorted((f for f in root.iterdir() if (f / "images").is_dir()), key=by_number)


def open_colmap(root: Path) -> Capture:
    """Reads the capture in `root`. All cameras are for training.

    Raises:
        CaptureError: the model is damaged or of a lens that is not supported, or no camera can be used.
    """
    model = find_model(root)
    lenses, images = _read_model(model)
    frames = [] if (root / "images").is_dir() else frames_of(root)

    def make(name: str, image: _Image) -> tuple[Camera, Feed]:
        if frames:
            paths = [_there(f / "images" / image.name) for f in frames]
            masks = [_mask(f / "masks", Path(image.name)) for f in frames]
        else:
            paths = numbered((root / "images" / image.name).parent) if "/" in image.name else []
            paths = paths or [_there(root / "images" / image.name)]
            masks = [_mask(root / "masks", p.relative_to(root / "images")) for p in paths]
        return _camera(name, image, lenses.get(image.lens)), Feed(paths, masks)

    made = {_name(i.name): i for i in sorted(images, key=lambda i: by_number(Path(i.name)))}
    return assemble(root.resolve().name, *usable(model, made, make))


def _name(image: str) -> str:
    """The camera's: the folder of the image where it has one."""
    path = Path(image)
    return path.parent.as_posix() if path.parent.name else path.stem


def _there(path: Path) -> Path:
    if not path.is_file():
        raise CaptureError(f"image {path} is missing")
    return path


def _mask(folder: Path, image: Path) -> Path | None:
    """Of the image of that name, also with its suffix and .png behind it (as COLMAP wants masks)."""
    names = [image.with_suffix(s) for s in SUFFIXES] + [image.with_name(image.name + ".png")]
    return next((folder / n for n in names if (folder / n).is_file()), None)


def _camera(name: str, image: _Image, lens: _Lens | None) -> Camera:
    from scipy.spatial.transform import Rotation

    if lens is None:
        raise CaptureError(f"the model has no camera {image.lens}")
    fx, fy, cx, cy, *distortion = lens.params
    turns = 0 < np.linalg.norm(image.quat) < np.inf  # others are refused as no rotation
    R = Rotation.from_quat(np.roll(image.quat, -1)).as_matrix() if turns else np.zeros((3, 3))
    viewmat = rigid(R, image.translation)
    lens_terms = np.array((distortion + [0.0] * 4)[:4])
    return Camera(name, pinhole(fx, fy, cx, cy), viewmat, lens.width, lens.height, lens_terms)


def _read_model(folder: Path) -> tuple[dict[int, _Lens], list[_Image]]:
    binary = (folder / "images.bin").is_file()
    suffix, lenses, images = (".bin", _lenses_bin, _images_bin) if binary else (".txt", _lenses_txt, _images_txt)
    out = []
    for path, read in ((folder / f"cameras{suffix}", lenses), (folder / f"images{suffix}", images)):
        try:
            out.append(list(read(path.read_bytes())))
        except FileNotFoundError:
            raise CaptureError(f"{path}: the file is missing, expected a COLMAP model") from None
        except (struct.error, ValueError, IndexError, UnicodeDecodeError) as e:
            raise CaptureError(f"{path}: damaged ({e}), expected a COLMAP model") from e
    return dict(out[0]), out[1]


def _lens(number: int, width: int, height: int, params: list[float]) -> _Lens:
    which = LENSES[number][1]
    return _Lens(width, height, [params[i] for i in which])


def _known(number: int | None, shown: object) -> int:
    if number not in LENSES:
        known = ", ".join(name for name, _ in LENSES.values())
        raise CaptureError(f"COLMAP camera model {shown} is not supported, undistort to PINHOLE first (known: {known})")
    return number


def _lenses_bin(data: bytes) -> Iterator[tuple[int, _Lens]]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        index, number, width, height = struct.unpack_from("<iiQQ", data, at)
        n = 1 + max(LENSES[_known(number, number)][1])
        params = struct.unpack_from(f"<{n}d", data, at + 24)
        at += 24 + 8 * n
        yield index, _lens(number, width, height, list(params))


def _images_bin(data: bytes) -> Iterator[_Image]:
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, lens = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", data, end + 1)
        yield _Image(data[at + 64 : end].decode(), lens, np.array(pose[:4]), np.array(pose[4:]))
        at = end + 9 + 24 * points


def _rows(data: bytes) -> list[list[str]]:
    lines = data.decode().splitlines()
    return [line.split() for line in lines if not line.startswith("#")]


def _lenses_txt(data: bytes) -> Iterator[tuple[int, _Lens]]:
    for index, name, width, height, *params in filter(None, _rows(data)):
        number = _known(NUMBERS.get(name), name)
        yield int(index), _lens(number, int(width), int(height), [float(p) for p in params])


def _images_txt(data: bytes) -> Iterator[_Image]:
    for row in _rows(data)[::2]:  # every second line has the points
        if row:
            pose = np.array([float(v) for v in row[1:8]])
            yield _Image(" ".join(row[9:]), int(row[8]), pose[:4], pose[4:])
