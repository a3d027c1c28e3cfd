"""Sparse points of a capture, from which training starts: the part that all layouts share, .ply and .npz.

The points of COLMAP models are read in colmap_points.py. Positions are in the world of the cameras.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..ply_table import read_table

GREY = 128  # colour of points without a known colour


@dataclass(frozen=True)
class Points:
    """Sparse points of the scene, as it is in frame 0 of the capture.

    Attributes:
        means: [N, 3] float, world units.
        colors: [N, 3] u8 sRGB.
    """

    means: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.means)


def checked(source: Path, means: np.ndarray, colors: np.ndarray) -> Points:
    """Points of a file. Those that are not finite are left out.

    Args:
        source: the file, for messages.
        means: [N, 3], any real type.
        colors: [N, 3], 0..255.

    Raises:
        CaptureError: no point is left.
    """
    finite = np.isfinite(means).all(1) & np.isfinite(colors).all(1)
    if not finite.any():
        raise CaptureError(f"{source}: no points, expected sparse points of the scene; delete the file to go without")
    shades = np.rint(colors[finite]).clip(0, 255).astype(np.uint8)
    return Points(np.ascontiguousarray(means[finite], np.float64), np.ascontiguousarray(shades))


def read_ply_points(path: Path) -> Points:
    """The vertices of a .ply: x, y, z and, where they are there, red, green, blue (nerfstudio, COLMAP, N3DV).

    Raises:
        CaptureError: the file is missing, damaged or has no vertices with a position.
    """
    rows = read_table(path).get("vertex")
    names = () if rows is None else rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise CaptureError(f"{path}: no points, expected an element 'vertex' with x, y and z")
    means = np.stack([rows[n].astype(np.float64) for n in "xyz"], 1)
    if not {"red", "green", "blue"} <= set(names):
        return checked(path, means, np.full(means.shape, GREY))
    colors = np.stack([rows[n].astype(np.float64) for n in ("red", "green", "blue")], 1)
    return checked(path, means, colors * (255 if rows["red"].dtype.kind == "f" else 1))


def read_npz_points(path: Path) -> Points:
    """init_pt_cld.npz of Dynamic 3D Gaussians: `data` [N, 7] with x, y, z, r, g, b in 0..1, and a segment's number.

    Raises:
        CaptureError: it is not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as z:
            data = z["data"]
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as e:
        raise CaptureError(f"{path}: not a point cloud of Dynamic 3D Gaussians ({e}), expected an array 'data'") from e
    if data.ndim != 2 or data.shape[1] < 6 or data.dtype.kind != "f":
        raise CaptureError(f"{path}: 'data' is {list(data.shape)} {data.dtype}, expected [points, 7] numbers: xyz, rgb")
    return checked(path, data[:, :3], 255 * data[:, 3:6])
