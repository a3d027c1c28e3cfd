"""A calibrated camera, in gsplat's convention: OpenCV axes (x right, y down, z forward), world-to-camera matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

NEAR = 0.01  # world units, near plane of a camera if it is not known (spec 14)
LOW_PASS = 0.3  # px^2, for splats of other tools: as in 3D Gaussian Splatting (spec 14)
PIXEL_LOW_PASS = 0.1  # px^2, for captures: a pixel is a box of variance 1/12 (Mip-Splatting has the same)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with optional lens distortion.

    Attributes:
        name: unique in the capture, e.g. "cam03".
        K: [3, 3] f64, intrinsics in pixels; pixel centres are at half-integers.
        viewmat: [4, 4] f64, world-to-camera, OpenCV axes.
        width, height: image size in pixels.
        distortion: [k1, k2, p1, p2, k3] as in OpenCV (any length that OpenCV takes); empty: none. A Capture returns
            undistorted images, with an empty array.
        fisheye: `distortion` is [k1, k2, k3, k4] of OpenCV's fisheye model (Kannala and Brandt 2006) instead; a Capture
            returns pinhole cameras.
        split: "train", "val" or "test".
        near: near plane, world units: Gaussians whose centre is nearer are not drawn. A reader of captures leaves
            `NEAR` if its layout has no near plane; `Capture` then sets it to a share of the distance to the scene.
        low_pass: variance of the screen-space low-pass of drawn Gaussians, px^2 (spec 14).
    """

    name: str
    K: np.ndarray
    viewmat: np.ndarray
    width: int
    height: int
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(0))
    split: str = "train"
    near: float = NEAR
    fisheye: bool = False
    low_pass: float = LOW_PASS

    @property
    def center(self) -> np.ndarray:
        """[3] f64, position in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def seen_from(self, origin: np.ndarray) -> Camera:
        """The same view in coordinates with the origin at `origin` ([3], world units) of this world."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ origin
        return replace(self, viewmat=viewmat)

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


@dataclass(frozen=True)
class Calibration:
    """Calibration learned in training, for the C cameras of a capture in the T frames of a group.

    Attributes:
        corrections: [C, 4, 4] f64, rigid motions of the world: the true viewmat is viewmat @ correction, in all frames,
            also of moving cameras.
        gains: [T, C, 3] f32, colour gain of each camera: image = gain * scene + offset.
        offsets: [T, C, 3] f32, colour offset of each camera, in 0..1.
    """

    corrections: np.ndarray
    gains: np.ndarray
    offsets: np.ndarray

    @staticmethod
    def plain(cameras: int, frames: int) -> Calibration:
        """The identity: cameras as in the capture."""
        gains = np.ones((frames, cameras, 3), np.float32)
        return Calibration(np.tile(np.eye(4), (cameras, 1, 1)), gains, 0 * gains)

    def evened(self, rgb: np.ndarray, index: int, t: int) -> np.ndarray:
        """Colours of camera `index` (0 to 255) at frame `t` of the group, corrected to those of the scene, f32."""
        return ((rgb - 255 * self.offsets[t, index]) / self.gains[t, index]).astype(np.float32)

    def camera(self, camera: Camera, index: int) -> Camera:
        """`camera` with the true viewmat; it is camera `index` of the capture in any frame, or a crop of it."""
        return replace(camera, viewmat=camera.viewmat @ self.corrections[index])


def low_pass_of(cameras: Sequence[Camera]) -> float:
    """Low-pass for views from other positions than these cameras of a stream, a sequence or a capture, px^2."""
    return cameras[0].low_pass if cameras else LOW_PASS


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


def meeting_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Point nearest to all optical axes (least squares), [3] f64."""
    A, b = 1e-6 * np.eye(3), np.zeros(3)
    for c in cameras:
        axis = c.viewmat[2, :3]
        P = np.eye(3) - np.outer(axis, axis)
        A, b = A + P, b + P @ c.center
    return np.linalg.solve(A, b)


def working_distance(cameras: Sequence[Camera]) -> float:
    """Median distance of the cameras from the point where their optical axes meet, world units."""
    centre = meeting_point(cameras)
    return float(np.median([np.linalg.norm(c.center - centre) for c in cameras]))


GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def fibonacci_directions(count: int, turn: float = 0.0) -> np.ndarray:
    """[count, 3] f64 unit vectors, evenly over the sphere; `turn`: rotation of all about z, radians."""
    i = np.arange(count)
    z, angle = 1 - (2 * i + 1) / count, i * GOLDEN_ANGLE + turn
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)


def cameras_around(
    points: np.ndarray,
    count: int,
    *,
    name: str,
    size: int = 512,
    focal: float = 1.2,
    turn: float = 0.0,
    low_pass: float = LOW_PASS,
) -> list[Camera]:
    """Cameras in Fibonacci directions around the box of the 1st to 99th percentile of `points` ([N, 3]); even ones have
    its bounding sphere just in frame, odd ones stand at half that distance. Their near planes are at `NEAR`, or at a
    hundredth of their distance if that is less, so that scenes of any unit are visible.

    Args:
        size: width and height, pixels.
        focal: focal length in widths.
        turn: rotation of all directions about z, radians.
        low_pass: of the cameras, px^2.
    """
    low, high = np.percentile(points, (1, 99), axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    f = focal * size
    distance = radius / np.sin(np.arctan(0.5 * size / f))
    K = np.array([[f, 0, size / 2], [0, f, size / 2], [0, 0, 1]])
    cameras = []
    for i, direction in enumerate(fibonacci_directions(count, turn)):
        away = distance * (0.5 if i % 2 else 1)
        viewmat, near = look_at(center + direction * away, center, (0, 0, 1)), min(NEAR, 0.01 * away)
        cameras.append(Camera(f"{name}{i:02}", K, viewmat, size, size, split="test", near=near, low_pass=low_pass))
    return cameras
