"""One entry of transforms.json -> the camera that took its image, with its lens."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import NEAR, Camera
from .images import image_size
from .rig import pinhole, rigid

DISTORTION = ("k1", "k2", "p1", "p2", "k3")  # OpenCV's order
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
FISHEYE = "OPENCV_FISHEYE"


def entry_camera(name: str, image: Path, v: dict, size: tuple[int, int]) -> Camera:
    """The camera of one entry.

    Args:
        image: its file, for messages.
        v: the entry, completed from the head of the file.
        size: width and height of the first image of the camera, pixels: all its images have this size.

    Raises:
        CaptureError: pose, intrinsics or size are missing or wrong.
        TypeError, ValueError: a value is not a number.
    """
    width, height = size
    stated = int(v.get("w", width)), int(v.get("h", height))
    if stated != (width, height):
        own = image_size(image)[:2]
        expected, source = (size, "as the first image of its camera") if own == stated else (stated, "(w, h)")
        raise CaptureError(f"image {image} is {own[0]}x{own[1]}, expected {expected[0]}x{expected[1]} {source}")
    fisheye = v.get("camera_model") == FISHEYE or bool(v.get("is_fisheye"))
    distortion = np.array([float(v.get(k, 0)) for k in (FISHEYE_DISTORTION if fisheye else DISTORTION)])
    near = float(v.get("near", NEAR))
    if "near" in v and near == NEAR:
        near = math.nextafter(NEAR, 1)  # NEAR itself says that the near plane is not known
    if not 0 < near < math.inf:
        raise CaptureError(f"near plane at {near:g}, expected a distance above 0")
    K = _intrinsics(v, width, height)
    return Camera(name, K, _viewmat(v), width, height, distortion, near=near, fisheye=fisheye)


def _intrinsics(v: dict, width: int, height: int) -> np.ndarray:
    if "fl_x" in v:
        fx, fy = float(v["fl_x"]), float(v.get("fl_y", v["fl_x"]))
    elif "camera_angle_x" in v:
        fx = 0.5 * width / math.tan(0.5 * float(v["camera_angle_x"]))
        fy = 0.5 * height / math.tan(0.5 * float(v["camera_angle_y"])) if "camera_angle_y" in v else fx
    else:
        raise CaptureError("no focal length, expected fl_x (pixels) or camera_angle_x (radians)")
    return pinhole(fx, fy, float(v.get("cx", width / 2)), float(v.get("cy", height / 2)))


def _viewmat(v: dict) -> np.ndarray:
    """[4, 4] world-to-camera, OpenCV axes, from the OpenGL camera-to-world matrix (a uniform scale is removed)."""
    if "transform_matrix" not in v:
        raise CaptureError("no pose, expected transform_matrix")
    try:
        m = np.array(v["transform_matrix"], np.float64)
    except (TypeError, ValueError):
        m = np.zeros(0)
    if m.shape not in ((4, 4), (3, 4)) or not np.isfinite(m).all():
        raise CaptureError("transform_matrix is not 4x4 finite numbers")
    u, s, vt = np.linalg.svd(m[:3, :3])
    if s[2] < 1e-6 or s[0] > 1.01 * s[2] or np.linalg.det(m[:3, :3]) < 0:
        raise CaptureError("transform_matrix is singular, sheared or mirrored, expected a rotation")
    R = (u @ vt) * [1, -1, -1]  # columns: OpenGL camera axes -> OpenCV
    return rigid(R.T, -R.T @ m[:3, 3])
