"""A moving scene of Gaussians -> a capture: its pictures, drawn from a rig of cameras around it as they are asked for.

So any splats that `animate_splat` moves, or that others trained, become a capture of any size with exact calibration
and test cameras between the training ones. What is drawn is what a Gaussian model can show, so that such a capture says
how much of it training finds, and not how well Gaussians stand for the world.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from gscodec.capture import Capture, View
from gscodec.errors import UsageError
from gscodec.model.camera import NEAR, Camera, look_at
from gscodec.model.gaussian_sequence import GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.render.image import render_rgba
from gscodec.render.movie import up_vector
from gscodec.splats import open_sequence

from .animate_splat import Motion, animate_splat

HEIGHTS = (-0.15, 0.15, 0.55)  # of the rings of cameras, in distances from the subject
FIELD = 0.9  # of the shorter side of the picture that the subject's bounding sphere fills
CACHED = 64  # pictures


@dataclass(frozen=True)
class Rig:
    """Cameras on three rings around a subject.

    Attributes:
        train, val, test: number of cameras; val and test cameras stand between the others.
        width, height: of the pictures.
        focal: in widths of the picture.
        up: world axis that points away from the floor.
    """

    train: int = 24
    val: int = 2
    test: int = 2
    width: int = 512
    height: int = 512
    focal: float = 1.2
    up: str = "-y"

    def cameras(self, means: np.ndarray) -> list[Camera]:
        """The cameras around the 1-99 % box of `means` ([N, 3])."""
        low, high = np.percentile(means, (1, 99), axis=0)
        center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        f, shorter = self.focal * self.width, min(self.width, self.height)
        distance = radius / np.sin(np.arctan(0.5 * FIELD * shorter / f))
        K = np.array([[f, 0, self.width / 2], [0, f, self.height / 2], [0, 0, 1]])
        up = up_vector(self.up)
        side, ahead = np.roll(up, 1), np.cross(up, np.roll(up, 1))

        def camera(split: str, i: int, turn: float, z: float) -> Camera:
            around = np.cos(2 * np.pi * turn) * side + np.sin(2 * np.pi * turn) * ahead
            eye = center + distance * (np.sqrt(1 - z * z) * around + z * up)
            viewmat = look_at(eye, center, up)
            return Camera(f"{split}{i:02}", K, viewmat, self.width, self.height, split=split, near=NEAR * distance)

        rig = [camera("train", i, i / self.train, HEIGHTS[i % 3]) for i in range(self.train)]
        for split, count, shift in (("val", self.val, 0.35), ("test", self.test, 0.6)):
            for i in range(count):
                rig.append(camera(split, i, (shift + i * self.train / count) / self.train, 0.1 + 0.25 * i))
        return rig


def draw(sequence: GaussianSequence, name: str, rig: Rig) -> Capture:
    """The capture that `rig` takes of a sequence, RGBA."""
    return drawn(sequence.frame, sequence.frame_count, sequence.fps, name, rig)


def drawn(frame: Callable[[int], Gaussians], frames: int, fps: float, name: str, rig: Rig) -> Capture:
    """As `draw`, of `frame(t)` for t < frames."""
    cameras, there = rig.cameras(frame(0).means), lru_cache(2)(frame)

    @lru_cache(CACHED)
    def read(camera: int, t: int) -> View:
        rgba = render_rgba(there(t), cameras[camera])
        rgb = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)
        return View(_u8(rgb), _u8(rgba[..., 3]))

    return Capture(name, fps, cameras, frames, True, read)


def animated_capture(splat: Path, work: Path, frames: int, rig: Rig) -> Capture:
    """The capture of a static splat that `animate_splat` moves; its frames are kept in the folder `work`.

    Raises:
        UsageError: there is no such file.
    """
    if not splat.is_file():
        raise UsageError(f"{splat} does not exist, expected a 3DGS .ply")
    folder = work / f"{splat.stem}-{frames}"
    if not (done := folder / ".done").exists():
        animate_splat(splat, folder, frames, Motion(up=rig.up))
        done.touch()
    return draw(open_sequence(folder), splat.stem, rig)


def _u8(x: np.ndarray) -> np.ndarray:
    return np.rint(255 * x.clip(0, 1)).astype(np.uint8)
