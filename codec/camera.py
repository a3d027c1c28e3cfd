"""A calibrated camera, in gsplat's convention: OpenCV axes (x right, y down, z forward), world-to-camera matrix."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with optional lens distortion.

    Attributes:
        name: unique in the capture, e.g. "cam03".
        K: [3, 3] f64, intrinsics in pixels; pixel centres are at half-integers.
        viewmat: [4, 4] f64, world-to-camera, OpenCV axes.
        width, height: image size in pixels.
        distortion: [k1, k2, p1, p2, k3] as in OpenCV (any length it takes), empty for none; a Capture hands out
            undistorted images with an empty one.
        split: "train" or "test".
    """

    name: str
    K: np.ndarray
    viewmat: np.ndarray
    width: int
    height: int
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    split: str = "train"

    @property
    def center(self) -> np.ndarray:
        """[3] f64, position in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid."""
        K = self.K.copy()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return replace(self, K=K, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The rectangle of this view that starts at pixel (left, top)."""
        K = self.K.copy()
        K[0, 2] -= left
        K[1, 2] -= top
        return replace(self, K=K, width=int(width), height=int(height))


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """[4, 4] f64 world-to-camera matrix, OpenCV axes, of a camera at `eye` that looks at `target`, `up` upwards."""
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    z = target - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    if np.linalg.norm(x) < 1e-6:  # looking along `up`: any horizontal direction will do
        x = np.cross(z, np.roll(up, 1))
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    m = np.eye(4)
    m[:3, :3] = R
    m[:3, 3] = -R @ eye
    return m
