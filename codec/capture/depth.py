"""One depth image -> [H, W] f32: integer or float images, and .npy arrays, times a unit.

A value is a distance in the file's own unit, which the layout knows; 0, infinity and NaN mean unknown. The image may be
smaller than the picture, as from a sensor beside the camera. It is resampled by nearest neighbour, since the mean
across an edge lies on neither side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require
from .images import first_line

SUFFIXES = (".exr", ".png", ".npy", ".tif", ".tiff", ".pfm", ".hdr")


@dataclass(frozen=True)
class DepthImages:
    """The depth images of a camera.

    Attributes:
        files: one for each frame.
        unit: world units per step of the values.
        along_ray: values are distances from the camera's centre; otherwise along its optical axis.
    """

    files: Sequence[Path]
    unit: float = 1.0
    along_ray: bool = False

    def read(self, t: int, width: int, height: int) -> np.ndarray:
        """[height, width] f32 depth of frame `t`, 0 where it is unknown.

        Raises:
            CaptureError: the file is missing or damaged, has no numbers, or has another shape than the picture.
        """
        path = self.files[t]
        values = (_values(path) * self.unit).astype(np.float32)
        own = values.shape[::-1]
        if abs(own[0] * height - own[1] * width) > max(width, height):
            raise CaptureError(
                f"{path}: depth image is {own[0]}x{own[1]}, expected {width}x{height} as its picture, or that shape at "
                f"another scale"
            )
        values = np.where(np.isfinite(values) & (values > 0), values, np.float32(0))
        if own != (width, height):
            cv2 = require("cv2", "scaling depth images")
            values = cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        return values


def along_axis(distances: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Distances from the centre of a pinhole camera ([H, W]; K [3, 3]) -> depth along its optical axis."""
    height, width = distances.shape
    x = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    return (distances / np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)).astype(np.float32)


def _values(path: Path) -> np.ndarray:
    """[H, W] numbers as stored in the file."""
    if not path.is_file():
        raise CaptureError(f"{path}: depth image is missing")
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except (ValueError, OSError, EOFError) as e:
            raise CaptureError(f"{path}: not a numpy file ({e}), expected depth [height, width]") from e
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
    else:
        values = _pixels(path)
    if values.ndim != 2 or not values.size or values.dtype.kind not in "uif":
        raise CaptureError(f"{path}: {list(values.shape)} {values.dtype}, expected depth [height, width] as numbers")
    return values


def _pixels(path: Path) -> np.ndarray:
    """[H, W] the first channel of an image; integers stay integers."""
    oiio = require("OpenImageIO", "reading depth images")
    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise CaptureError(f"{path}: not a readable depth image ({oiio.geterror() or 'unknown format'})")
    spec = image.spec()
    of = {"uint8": "uint8", "uint16": "uint16", "uint32": "uint32"}.get(str(spec.format), "float")
    pixels, message = image.read_image(of), image.geterror()
    image.close()
    if pixels is None or message:
        raise CaptureError(f"{path}: damaged depth image ({first_line(message)}), expected a whole file; copy it again")
    return pixels.reshape(spec.height, spec.width, -1)[..., 0]
