"""RIG.npz -> Rig. The fields and how SMPL maps to them: docs/rigs.md."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from .rig import Rig
from .rotations import quat_to_rotvec, rotvec_to_quat

JOINTS_MAX = 255


def read_rig(path: Path, frames: int | None = None) -> Rig:
    """Reads the rig of a file.

    Args:
        frames: number of frames that the rig must have; None: any number.

    Raises:
        CaptureError: the file is not a rig, or an array is missing or has an invalid shape or value.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {n: np.asarray(file[n]) for n in file.files}
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as e:
        raise CaptureError(f"{path}: expected a rig, an .npz of arrays ({e})") from None
    rig = _Arrays(path, arrays).rig()
    if frames is not None and len(rig) != frames:
        raise CaptureError(f"{path}: has poses for {len(rig)} frames, expected one for each of {frames} frames")
    return rig


class _Arrays:
    """The arrays of a file, checked as they are taken."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray]):
        self.path, self.arrays = path, arrays

    def rig(self) -> Rig:
        joints = self.take("joints_rest", ("J", 3))
        count = len(joints)
        if not 1 <= count <= JOINTS_MAX:
            raise CaptureError(f"{self.path}: joints_rest has {count} joints, expected 1 to {JOINTS_MAX}")
        rotations = self.take("rotations", ("T", count, 3))
        for t in range(1, len(rotations)):  # nearest of the equal rotation vectors, so that poses are smooth
            rotations[t] = quat_to_rotvec(rotvec_to_quat(rotations[t]), rotations[t - 1])
        poses = np.concatenate([rotations, self.translations(len(rotations), count)], 2)
        vertices = weights = None
        if "vertices" in self.arrays or "weights" in self.arrays:
            vertices = self.take("vertices", ("V", 3))
            weights = self.take("weights", (len(vertices), count))
            if not len(vertices) or weights.min() < 0 or not weights.any(1).all():
                raise CaptureError(f"{self.path}: weights must be 0 or more, and one of each vertex above 0")
        return Rig(joints, self.parents(count), poses, vertices, weights)

    def translations(self, frames: int, joints: int) -> np.ndarray:
        """[T, J, 3]; the file may have [T, 3], for the root alone, or no translations (0)."""
        found = np.zeros((frames, joints, 3), np.float32)
        if "translations" not in self.arrays:
            return found
        if self.arrays["translations"].ndim == 3:
            return self.take("translations", (frames, joints, 3))
        found[:, 0] = self.take("translations", (frames, 3))
        return found

    def parents(self, count: int) -> np.ndarray:
        """[J] u8; a root has its own index."""
        told = self.take("parents", (count,))
        own = np.arange(count)
        if not ((told == np.rint(told)) & (told >= -1) & (told < own)).all():
            raise CaptureError(
                f"{self.path}: parents must be -1 for a root, such as the first joint, or else a joint before"
            )
        return np.where(told < 0, own, told).astype(np.uint8)

    def take(self, name: str, shape: tuple) -> np.ndarray:
        """An array as f32; a letter in `shape` stands for any number."""
        if name not in self.arrays:
            raise CaptureError(f"{self.path}: has no {name}, expected an array of shape {_words(shape)}")
        a = self.arrays[name]
        fits = a.ndim == len(shape) and all(isinstance(e, str) or e == n for e, n in zip(shape, a.shape, strict=True))
        if not fits:
            raise CaptureError(f"{self.path}: {name} has shape {_words(a.shape)}, expected {_words(shape)}")
        if a.dtype.kind not in "fiu" or not np.isfinite(a).all():
            raise CaptureError(f"{self.path}: {name} must be finite numbers")
        return a.astype(np.float32)


def _words(shape: tuple) -> str:
    return "[" + ", ".join(map(str, shape)) + "]"
