"""points3D.bin or points3D.txt of a COLMAP model -> Points. The images that see a point are skipped."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import CaptureError
from .points import Points, checked

RECORD = struct.Struct("<Q3d3BdQ")  # id, position, colour, error in pixels, number of images that see it
TRACK = 8  # bytes for each of these images


def read_colmap_points(model: Path) -> Points | None:
    """The points of the model in the folder `model`; None where it has none.

    Raises:
        CaptureError: the file is damaged.
    """
    for name, read in (("points3D.bin", _binary), ("points3D.txt", _text)):
        path = model / name
        if not path.is_file():
            continue
        try:
            rows = list(read(path.read_bytes()))
        except (struct.error, ValueError, UnicodeDecodeError) as e:
            raise CaptureError(f"{path}: damaged ({e}), expected the points of a COLMAP model") from e
        table = np.array(rows, np.float64).reshape(-1, 6)
        return checked(path, table[:, :3], table[:, 3:]) if len(table) else None
    return None


def _binary(data: bytes) -> Iterator[tuple]:
    (count,), at = struct.unpack_from("<Q", data), 8
    if count * RECORD.size > len(data):
        raise ValueError(f"{count} points do not fit into {len(data)} bytes")
    for _ in range(count):
        record = RECORD.unpack_from(data, at)
        yield record[1:7]
        at += RECORD.size + TRACK * record[8]


def _text(data: bytes) -> Iterator[list[float]]:
    for line in data.decode().splitlines():
        if line.strip() and not line.startswith("#"):
            row = [float(v) for v in line.split()[1:7]]
            if len(row) < 6:
                raise ValueError(f"a line has {len(row)} of 6 numbers x y z r g b")
            yield row
