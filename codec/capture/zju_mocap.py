"""ZJU-MoCap (Peng et al. 2021) -> Capture: annots.npy, an image for each camera and frame, masks in mask/.

annots.npy is a pickled dictionary. `cams` has lists by camera: K ([3, 3] pixels, centres at integers), D (distortion
as in OpenCV), R and T (world-to-camera, T in millimetres); `ims` has for each frame the paths of the images of all
cameras. Masks are label images: pixels other than 0 are the subject. They are in mask/ or mask_cihp/ under the same
names.

Unpickling runs code that the file names. So only the few names that numpy arrays need are allowed.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .rig import Feed, Track, assemble, pinhole, rigid, usable

FILE = "annots.npy"
MASKS = ("masks", "mask", "mask_cihp")  # `gscodec masks` writes to the first
MILLIMETRES = 1000.0
ALLOWED = {
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str):
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which no annotation needs")
        return super().find_class(module, name)


def open_zju_mocap(calibration: Path) -> Capture:
    """Reads annots.npy and the images beside it. All cameras are for training.

    Raises:
        CaptureError: the file is not such a calibration, or no camera can be used.
    """
    root, (cams, ims) = calibration.parent, _load(calibration)
    by_camera = list(zip(*ims, strict=True))
    made = {_name(files[0], i): (i, files) for i, files in enumerate(by_camera)}

    def make(name: str, item: tuple[int, tuple[str, ...]]) -> tuple[Track, Feed]:
        index, files = item
        feed = _feed(root, files)
        return [_camera(name, cams, index, feed)], feed

    return assemble(root.resolve().name, *usable(calibration, made, make))


def _load(path: Path) -> tuple[dict, list[list[str]]]:
    """`cams`, and the paths of the images by frame and camera."""
    expected = "expected annots.npy of ZJU-MoCap: cams (K, D, R, T) and ims"
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            read(file)
            data = _Unpickler(file).load()
        data = data.item() if isinstance(data, np.ndarray) else data
        cams, ims = data["cams"], [[str(i) for i in np.asarray(frame["ims"]).ravel()] for frame in data["ims"]]
        counts = {len(cams[k]) for k in ("K", "D", "R", "T")} | {len(frame) for frame in ims}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, EOFError, pickle.UnpicklingError) as e:
        raise CaptureError(f"{path}: {type(e).__name__} ({e}), {expected}") from e
    if len(counts) != 1 or not ims:
        raise CaptureError(f"{path}: {len(ims)} frames, cameras by list: {sorted(counts)}; expected as many in each")
    return cams, ims


def _name(image: str, index: int) -> str:
    """The name of a camera: the folder of its images, or its number if they have no folder."""
    return Path(image).parent.name or f"cam{index:02}"


def _feed(root: Path, files: tuple[str, ...]) -> Feed:
    images = [root / f for f in files]
    missing = next((i for i in images if not i.is_file()), None)
    if missing is not None:
        raise CaptureError(f"image {missing} is missing")
    of = lambda folder: [(root / folder / f).with_suffix(".png") for f in files]  # noqa: E731
    masks = next((m for m in map(of, MASKS) if any(p.is_file() for p in m)), [])
    found = [m if m.is_file() else None for m in masks]
    return Feed(images, found, of(MASKS[0]), labels=bool(masks) and masks != of(MASKS[0]))


def _camera(name: str, cams: dict, index: int, feed: Feed) -> Camera:
    try:
        shapes = {"K": (3, 3), "D": (-1,), "R": (3, 3), "T": (3,)}
        K, D, R, T = (np.array(cams[k][index], np.float64).reshape(shape) for k, shape in shapes.items())
    except (ValueError, TypeError):
        raise CaptureError("K, D, R or T is not of numbers, expected 3 x 3, 5, 3 x 3 and 3") from None
    if D.size not in (0, 4, 5, 8) or not np.isfinite(D).all():
        raise CaptureError(f"D has {D.size} values, expected 4, 5 or 8 finite ones")
    K = pinhole(K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    return Camera(name, K, rigid(R, T / MILLIMETRES), feed.width, feed.height, D)
