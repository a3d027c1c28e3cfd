"""Dynamic 3D Gaussians (Luiten et al. 2024; CMU Panoptic Sports) -> Capture: train_meta.json, test_meta.json, ims/.

Both files have lists by frame and camera: `k` ([3, 3] pixels), `w2c` ([4, 4] world-to-camera, OpenCV axes), `fn` (the
image in ims/) and `cam_id`; `w` and `h` hold for all. init_pt_cld.npz has sparse points. Its authors draw no Gaussian
nearer than 1, since the cameras hang in a wall. seg/ marks people; the authors train the whole pictures, and so do we.
Masks are in masks/CAMERA/, as in the other layouts.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .points import read_npz_points
from .rig import FPS, Feed, Track, assemble, feed_of, pinhole, rigid, usable

TRAIN, TEST, POINTS = "train_meta.json", "test_meta.json", "init_pt_cld.npz"
LISTS = ("k", "w2c", "fn", "cam_id")
NEAR = 1.0


@dataclass(frozen=True)
class _Shot:
    """One image of a camera: its file, K and viewmat as the file has them."""

    image: Path
    K: object
    viewmat: object


def open_dynamic3dgs(calibration: Path) -> Capture:
    """Reads train_meta.json and, where it is there, test_meta.json beside it.

    Raises:
        CaptureError: a file is not such a calibration, or no camera can be used.
    """
    root, made = calibration.parent, {}
    for path, split in ((calibration, "train"), (root / TEST, "test")):
        if split == "train" or path.is_file():
            size, shots = _load(path)
            made |= {name: (split, size, own) for name, own in shots.items()}

    def make(name: str, item: tuple[str, tuple[int, int], list[_Shot]]) -> tuple[Track, Feed]:
        split, size, shots = item
        track = [_camera(name, t, shot, size, split) for t, shot in enumerate(shots)]
        for t, shot in enumerate(shots):
            if not shot.image.is_file():
                raise CaptureError(f"frame {t}: image {shot.image} is missing")
        return track, feed_of([s.image for s in shots], root / "masks" / shots[0].image.parent.name)

    points = read_npz_points(root / POINTS) if (root / POINTS).is_file() else None
    return assemble(root.resolve().name, *usable(calibration, dict(sorted(made.items())), make), FPS, points=points)


def _load(path: Path) -> tuple[tuple[int, int], dict[str, list[_Shot]]]:
    """Size of the images, and the images of each camera in the order of the frames.

    Raises:
        CaptureError: it is not such a file, or a camera lacks a frame.
    """
    expected = f"expected w, h and lists {', '.join(LISTS)} by frame and camera (Dynamic 3D Gaussians)"
    try:
        data = json.loads(path.read_text())
        size, frames = (int(data["w"]), int(data["h"])), list(zip(*(data[n] for n in LISTS), strict=True))
        by_frame = [list(zip(*lists, strict=True)) for lists in frames]
    except (ValueError, UnicodeDecodeError, KeyError, TypeError) as e:
        raise CaptureError(f"{path}: {type(e).__name__} ({e}), {expected}") from e
    shots: dict[str, list[_Shot]] = {}
    for t, of_frame in enumerate(by_frame):
        for K, viewmat, file, camera in of_frame:
            name = f"cam{camera:02}" if isinstance(camera, int) else str(camera)
            if len(shots.setdefault(name, [])) != t:
                raise CaptureError(f"{path}: camera {name} is there {len(shots[name])} times before frame {t}")
            shots[name].append(_Shot(path.parent / "ims" / str(file), K, viewmat))
    short = next((n for n, s in shots.items() if len(s) < len(by_frame)), None)
    if short is not None or not shots:
        have = f"camera {short} has {len(shots[short])} of {len(by_frame)} frames" if shots else "no frames"
        raise CaptureError(f"{path}: {have}, {expected}")
    return size, shots


def _camera(name: str, t: int, shot: _Shot, size: tuple[int, int], split: str) -> Camera:
    try:
        K, viewmat = np.array(shot.K, np.float64), np.array(shot.viewmat, np.float64)
    except (ValueError, TypeError):
        K = viewmat = np.zeros(0)
    if K.shape != (3, 3) or viewmat.shape != (4, 4):
        raise CaptureError(f"frame {t}: k and w2c are not numbers, expected 3 x 3 and 4 x 4")
    try:
        K, viewmat = pinhole(K[0, 0], K[1, 1], K[0, 2], K[1, 2]), rigid(viewmat[:3, :3], viewmat[:3, 3])
    except CaptureError as e:
        raise CaptureError(f"frame {t}: {e}") from e
    return Camera(name, K, viewmat, *size, split=split, near=NEAR)
