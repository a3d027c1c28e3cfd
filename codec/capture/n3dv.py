"""Neural 3D Video (Li et al. 2022) -> Capture: one camNN.mp4 per camera and poses_bounds.npy.

A row of poses_bounds.npy (LLFF, Mildenhall et al. 2019) has a [3, 5] matrix and two depths, which are not used. The
matrix is camera-to-world with the axes down, right and back; its last column has height, width and focal length in
pixels. Rows are in the order of the videos' names. The first camera is the test camera, as in papers on the dataset.
Sparse points: points3D_downsample2.ply or points3D_downsample.ply, which 4DGS (Wu et al. 2024) writes beside it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.camera import Camera
from .capture import Capture
from .points import read_ply_points
from .rig import VIDEOS, Feed, Track, assemble, feed_of, numbered, pinhole, rigid, usable
from .video import Video

POINTS = ("points3D_downsample2.ply", "points3D_downsample.ply")


def open_n3dv(poses: Path) -> Capture:
    """Reads poses_bounds.npy and the videos beside it.

    Raises:
        CaptureError: the file is not an LLFF calibration with one row per video, or no camera can be used.
    """
    try:
        rows = np.load(poses, allow_pickle=False)
    except (ValueError, OSError, EOFError) as e:
        raise CaptureError(f"{poses}: not a numpy file ({e}), expected poses_bounds.npy of LLFF") from e
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f" or not np.isfinite(rows).all():
        raise CaptureError(f"{poses}: shape {list(rows.shape)}, expected 17 finite numbers for each camera (LLFF)")
    videos = numbered(poses.parent, VIDEOS)
    if len(videos) != len(rows):
        raise CaptureError(f"{poses}: {len(rows)} cameras, expected as many as there are videos: {len(videos)}")
    made = {v.stem: (row[:15].reshape(3, 5), v) for row, v in zip(rows, videos, strict=True)}
    first = next(iter(made))

    def make(name: str, item: tuple[np.ndarray, Path]) -> tuple[Track, Feed]:
        camera = _camera(name, item[0], "test" if name == first else "train")
        return [camera], feed_of(Video(item[1]), poses.parent / "masks" / name)

    found = next((p for f in POINTS if (p := poses.parent / f).is_file()), None)
    points = read_ply_points(found) if found else None
    return assemble(poses.parent.resolve().name, *usable(poses, made, make), points=points)


def _camera(name: str, m: np.ndarray, split: str) -> Camera:
    R = np.stack([m[:, 1], m[:, 0], -m[:, 2]])  # rows: the camera's axes right, down and forward, in the world
    height, width, focal = m[:, 4]
    K = pinhole(focal, focal, width / 2, height / 2)
    return Camera(name, K, rigid(R, -R @ m[:, 3]), round(width), round(height), split=split)
