"""A moving scene of Gaussians -> a capture: its pictures, drawn from a rig of cameras around it and kept as PNG files.

So any splats that `animate_splat` moves, or that others trained, become a capture of any size with exact calibration
and test cameras between the training ones. A Gaussian model can show all of these pictures. So such a capture measures
how much of the model training finds, and not how well Gaussians represent the world.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gscodec.atomic_write import part_file
from gscodec.capture import Capture
from gscodec.capture.images import read_image
from gscodec.errors import UsageError
from gscodec.model.camera import NEAR, PIXEL_LOW_PASS, Camera, look_at
from gscodec.model.gaussian_sequence import GaussianSequence
from gscodec.render.image import render_rgba
from gscodec.render.movie import up_vector
from gscodec.splats import open_sequence

from .animate_splat import Motion, animate_splat

HEIGHTS = (-0.15, 0.15, 0.55)  # of the rings of cameras, over the distance from the subject
FIELD = 0.9  # share of the shorter side of the picture that the subject's bounding sphere fills


@dataclass(frozen=True)
class Rig:
    """Cameras on three rings around a subject.

    Attributes:
        train, val, test: number of cameras; val and test cameras stand between the others.
        width, height: size of the pictures, pixels.
        focal: focal length, in widths of the picture.
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


def draw(sequence: GaussianSequence, name: str, rig: Rig, folder: Path) -> Capture:
    """The capture that `rig` takes of a sequence, RGBA; missing pictures are drawn into `folder`."""
    cameras = rig.cameras(sequence.frame(0).means)
    file = lambda camera, t: folder / cameras[camera].name / f"{t:04}.png"  # noqa: E731
    for camera in cameras:
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
    for t in range(sequence.frame_count):
        missing = [i for i in range(len(cameras)) if not file(i, t).exists()]
        shown = sequence.frame(t) if missing else None
        for i in missing:
            _write(file(i, t), render_rgba(shown, cameras[i]))
    read = lambda camera, t: read_image(file(camera, t))  # noqa: E731
    capture = Capture(name, sequence.fps, cameras, sequence.frame_count, True, read)
    return capture.with_low_pass(PIXEL_LOW_PASS)  # as for any other pictures


def animated_capture(splat: Path, work: Path, frames: int, rig: Rig) -> Capture:
    """The capture of a static splat that `animate_splat` moves; its frames and pictures are kept in the folder `work`.

    Raises:
        UsageError: there is no such file.
    """
    if not splat.is_file():
        raise UsageError(f"{splat} does not exist, expected a 3DGS .ply")
    folder = work / f"{splat.stem}-{frames}"
    if not (done := folder / ".done").exists():
        animate_splat(splat, folder, frames, Motion(up=rig.up))
        done.touch()
    pictures = work / f"{folder.name}-{hashlib.sha256(repr(rig).encode()).hexdigest()[:8]}"  # one folder per rig
    return draw(open_sequence(folder), splat.stem, rig, pictures)


def _write(file: Path, rgba: np.ndarray) -> None:
    """Writes [H, W, 4] f32, premultiplied, as PNG."""
    alpha = rgba[..., 3:]
    straight = np.concatenate([rgba[..., :3] / np.maximum(alpha, 1e-6), alpha], 2).clip(0, 1)
    _, data = cv2.imencode(".png", cv2.cvtColor(np.rint(255 * straight).astype(np.uint8), cv2.COLOR_RGBA2BGRA))
    with part_file(file) as part:
        part.write_bytes(data)
