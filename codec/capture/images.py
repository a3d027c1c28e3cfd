"""One image file -> View: 8-bit sRGB colour, not premultiplied, and alpha; resampling that weights colour by alpha.
Depth images are read by depth.py.

OpenImageIO reads every format. It is told not to premultiply by alpha; formats that are stored premultiplied (EXR)
are divided by alpha here. Float images are linear light and get the sRGB curve, integer images are taken as sRGB.
Resampling works on premultiplied colour: otherwise colour under alpha 0 would bleed into the edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import CaptureError, require

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".exr", ".tif", ".tiff")  # tried in this order for a name without suffix


@dataclass(frozen=True)
class View:
    """The picture of a camera in one frame.

    Attributes:
        rgb: [H, W, 3] u8 sRGB, not premultiplied.
        alpha: [H, W] u8; None: all pixels are opaque.
        depth: [H, W] f32, world units along the optical axis, 0 where it is unknown; None: there is no depth image.
    """

    rgb: np.ndarray
    alpha: np.ndarray | None = None
    depth: np.ndarray | None = None


def _open(path: Path):
    oiio = require("OpenImageIO", "reading images")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    if not path.is_file():
        raise CaptureError(f"{path}: image is missing")
    image = oiio.ImageInput.open(str(path), config)
    if image is None:
        raise CaptureError(f"{path}: not a readable image ({oiio.geterror() or 'unknown format'})")
    return image


def image_size(path: Path) -> tuple[int, int, bool]:
    """Width, height and whether there is an alpha channel, from the header alone.

    Raises:
        CaptureError: the file is missing or not an image.
    """
    image = _open(path)
    spec = image.spec()
    image.close()
    return spec.width, spec.height, _channels(spec.channelnames)[1] is not None


def _channels(names: tuple[str, ...]) -> tuple[list[int], int | None]:
    """Indices of red, green and blue (a grey image: one channel three times), and of alpha or None."""
    at = {n.rsplit(".", 1)[-1].upper(): i for i, n in reversed(list(enumerate(names)))}
    colour = [at[c] for c in "RGB"] if all(c in at for c in "RGB") else [0, 0, 0]
    return colour, at.get("A")


def read_image(path: Path) -> View:
    """Reads PNG, JPEG, EXR, TIFF, WebP ... of 8 or 16 bit or float.

    Raises:
        CaptureError: the file is missing, not an image or damaged.
        UsageError: OpenImageIO is not installed.
    """
    rgb, alpha, spec = _pixels(path)
    if alpha is not None and not spec.getattribute("oiio:UnassociatedAlpha"):
        top = 255 if rgb.dtype == np.uint8 else 1
        rgb = _divide(rgb.astype(np.float32), alpha.astype(np.float32) / top, top).astype(rgb.dtype)
    if not _step(spec):
        rgb = _srgb(rgb)
    return View(_u8(rgb), None if alpha is None else _u8(alpha))


def _pixels(path: Path):
    """[H, W, 3] colour and [H, W] alpha (or None) as stored, u8 or f32 (0 to 1), and OpenImageIO's description."""
    image = _open(path)
    spec = image.spec()
    pixels = image.read_image("uint8" if str(spec.format) == "uint8" else "float")
    message = image.geterror()
    image.close()
    if pixels is None or message:
        raise CaptureError(f"{path}: damaged image ({first_line(message)}), expected a whole file; copy it again")
    colour, a = _channels(spec.channelnames)
    pixels = pixels.reshape(spec.height, spec.width, -1)
    return pixels[..., colour], None if a is None else pixels[..., a], spec


def _step(spec) -> float:
    """The value 1 of an integer image among the values that `_pixels` returns; 0: a float image."""
    dtype = np.dtype(str(spec.format))
    if dtype.kind != "u":
        return 0.0
    return 1.0 if dtype == np.uint8 else 1 / np.iinfo(dtype).max


def first_line(message: str) -> str:
    """First line of OpenImageIO's error message; further lines repeat the error for the libraries below it."""
    return message.splitlines()[0] if message else "no pixels"


def read_mask(path: Path, *, labels: bool = False) -> np.ndarray:
    """[H, W] u8 coverage: the alpha channel of the file unless it is opaque everywhere, else its first colour channel.
    Float values are coverage too; integers of 0 and 1 mean 0 and 255. With `labels`, 255 where any channel is not 0."""
    rgb, alpha, spec = _pixels(path)
    if labels:
        return np.where((rgb > 0).any(-1), 255, 0).astype(np.uint8)
    values = rgb[..., 0] if alpha is None or (_u8(alpha) == 255).all() else alpha
    if 0 < values.max() <= _step(spec) * (1 + 1e-6):
        return np.where(values > 0, 255, 0).astype(np.uint8)
    return _u8(values)


def _srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _u8(x: np.ndarray) -> np.ndarray:
    if x.dtype != np.uint8:
        x = (np.clip(np.nan_to_num(x), 0, 1) * 255 + 0.5).astype(np.uint8)
    return np.ascontiguousarray(x)


def _divide(rgb: np.ndarray, alpha: np.ndarray, top: float) -> np.ndarray:
    """Premultiplied f32 colour -> not premultiplied; 0 where alpha is 0. Adds 0.5 for rounding if `top` is 255."""
    out = rgb / np.maximum(alpha, 1e-6)[..., None] * (alpha > 0)[..., None]
    return np.clip(out + (0.5 if top == 255 else 0), 0, top)


def resample(view: View, op: Callable[[np.ndarray], np.ndarray], nearest: Callable[[np.ndarray], np.ndarray]) -> View:
    """Applies a linear filter `op` (on [H, W, C] f32) to premultiplied colour and alpha, then divides by alpha. Depth
    is resampled by `nearest`: the mean depth across an edge lies on neither side."""
    depth = None if view.depth is None else nearest(view.depth)
    if view.alpha is None:
        return View((np.clip(op(view.rgb.astype(np.float32)), 0, 255) + 0.5).astype(np.uint8), depth=depth)
    a = view.alpha.astype(np.float32)
    out = op(np.dstack([view.rgb * (a / 255)[..., None], a]))
    rgb = _divide(out[..., :3], out[..., 3] / 255, 255)
    return View(rgb.astype(np.uint8), (np.clip(out[..., 3], 0, 255) + 0.5).astype(np.uint8), depth)


def resize_area(view: View, width: int, height: int) -> View:
    """The view at another (smaller) size, each new pixel the mean of the area it covers."""
    if view.rgb.shape[:2] == (height, width):
        return view
    cv2 = require("cv2", "scaling images")

    def resized(interpolation: int) -> Callable[[np.ndarray], np.ndarray]:
        return lambda x: cv2.resize(x, (width, height), interpolation=interpolation)

    return resample(view, resized(cv2.INTER_AREA), resized(cv2.INTER_NEAREST_EXACT))
