"""Gaussians -> the 16 cameras from which stream and source are compared where there is no capture.

Directions on a Fibonacci sphere around the box of the 1st to 99th percentile of positions; even cameras have its
bounding sphere just in frame, odd ones stand at half that distance. 512 x 512, focal length 1.2 x width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.camera import Camera, look_at
from gscodec.errors import UsageError
from gscodec.gaussians import Gaussians

COUNT, SIZE, FOCAL = 16, 512, 1.2
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def codec_cameras(frames: Sequence[Gaussians]) -> list[Camera]:
    """The cameras around what the given frames hold together.

    Raises:
        UsageError: the frames hold no Gaussians.
    """
    means = np.concatenate([g.means for g in frames]) if frames else np.zeros((0, 3))
    if not len(means):
        raise UsageError("no Gaussians to place cameras around")
    low, high = np.percentile(means, (1, 99), axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    f = FOCAL * SIZE
    distance = radius / np.sin(np.arctan(0.5 * SIZE / f))
    K = np.array([[f, 0, SIZE / 2], [0, f, SIZE / 2], [0, 0, 1]])
    cameras = []
    for i in range(COUNT):
        z, turn = 1 - (2 * i + 1) / COUNT, i * GOLDEN_ANGLE
        direction = np.array([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
        eye = center + direction * distance * (0.5 if i % 2 else 1)
        cameras.append(Camera(f"codec{i:02}", K, look_at(eye, center, (0, 0, 1)), SIZE, SIZE, split="test"))
    return cameras
