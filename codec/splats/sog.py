"""SOG version 2 (PlayCanvas) <-> Gaussians: attribute maps as lossless WebP with codebooks in meta.json.

A .sog is a zip of meta.json and the maps; unpacked it is a folder.

| attribute | in the maps |
|---|---|
| positions | sign(x) ln(1 + abs(x)) in 16 bits, low and high bytes in two maps |
| rotations | the three smallest components in 8 bits, 252 + index of the largest in alpha |
| scales, colours | 8-bit indices into codebooks; opacity in the alpha of the colours |
| SH | an index into a palette, whose entries are indices into a codebook |

OpenCV reads and writes the maps, since it does not premultiply by alpha. Its lossless WebP drops colour under alpha 0,
so opacity is written as 1 to 255.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError, require
from ..model.gaussians import SH_COUNTS, Gaussians, logit, sigmoid
from .codebook import codebook, palette
from .smallest_three import join_smallest_three, split_smallest_three

PALETTE_WIDTH = 64  # SH palette entries per row of its map
PALETTE_MAX = 1 << 16
SH_BANDS = {bands: k for k, bands in SH_COUNTS.items()}
LOSSLESS = 101  # OpenCV's WebP quality above 100


def read_sog_meta(path: Path) -> tuple[dict, Callable[[str], bytes]]:
    """meta.json of a .sog, a folder or the meta.json itself, and the function that reads a file beside it.

    Raises:
        CaptureError: there is none, or it is not version 2.
    """
    if path.suffix.lower() == ".sog":
        try:
            with zipfile.ZipFile(path) as z:
                files = {n: z.read(n) for n in z.namelist()}
        except (OSError, zipfile.BadZipFile) as e:
            raise CaptureError(f"{path}: not a readable .sog, expected a zip of meta.json and WebP maps ({e})") from e
        read = files.__getitem__
    else:
        folder = path if path.is_dir() else path.parent
        read = lambda name: (folder / Path(name).name).read_bytes()  # noqa: E731
    try:
        meta = json.loads(read("meta.json"))
    except (OSError, KeyError, ValueError) as e:
        raise CaptureError(f"{path}: no readable meta.json ({e}), expected SOG version 2") from e
    if not isinstance(meta, dict) or meta.get("version") != 2:
        found = meta.get("version", "1 or another format") if isinstance(meta, dict) else "none"
        raise CaptureError(f"{path}: SOG version {found}, only 2 is read; convert it with splat-transform")
    return meta, read


def read_sog(path: Path) -> Gaussians:
    """Reads a .sog, an unpacked folder or its meta.json.

    Raises:
        CaptureError: a map or a key is missing, damaged or too small.
    """
    meta, read = read_sog_meta(path)
    try:
        return _gaussians(meta, lambda name: _image(path, name, read)).validate(str(path))
    except (KeyError, TypeError, ValueError, IndexError) as e:
        raise CaptureError(f"{path}: meta.json is not valid SOG version 2 ({type(e).__name__}: {e})") from e


def _image(path: Path, name: str, read: Callable[[str], bytes]) -> np.ndarray:
    """[H, W, 4] u8 RGBA of one map."""
    cv2 = require("cv2", "reading .sog")
    try:
        data = read(name)
    except (OSError, KeyError) as e:
        raise CaptureError(f"{path}: map {name} is missing") from e
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if bgr is None or bgr.ndim != 3 or bgr.dtype != np.uint8:
        raise CaptureError(f"{path}: map {name} is not a readable 8-bit colour image")
    alpha = bgr[..., 3:] if bgr.shape[2] == 4 else np.full_like(bgr[..., :1], 255)
    return np.dstack([bgr[..., 2::-1], alpha])


def _gaussians(meta: dict, image: Callable[[str], np.ndarray]) -> Gaussians:
    count = int(meta["count"])

    def texels(entry: dict, i: int = 0) -> np.ndarray:
        pixels = image(entry["files"][i]).reshape(-1, 4)
        if len(pixels) < count:
            raise ValueError(f"map {entry['files'][i]} has {len(pixels)} pixels for {count} Gaussians")
        return pixels[:count].astype(np.int64)

    means, scales, sh0 = meta["means"], texels(meta["scales"]), texels(meta["sh0"])
    code = texels(means, 0)[:, :3] + 256 * texels(means, 1)[:, :3]
    low, high = np.array(means["mins"], np.float64), np.array(means["maxs"], np.float64)
    log = low + (high - low) * (code / 65535)
    quats = texels(meta["quats"])
    tagged = quats[:, 3] >= 252
    rotation = join_smallest_three((quats[:, :3] / 255 - 0.5) * np.sqrt(2), np.where(tagged, quats[:, 3] - 252, 0))
    rotation[~tagged] = (1, 0, 0, 0)
    return Gaussians(
        means=np.sign(log) * np.expm1(np.abs(log)),
        quats=rotation,
        log_scales=np.array(meta["scales"]["codebook"], np.float32)[scales[:, :3]],
        logit_opacities=logit(sh0[:, 3] / 255),
        sh0=np.array(meta["sh0"]["codebook"], np.float32)[sh0[:, :3]],
        shN=_read_sh(meta.get("shN"), count, texels, image),
    )


def _read_sh(entry: dict | None, count: int, texels: Callable, image: Callable[[str], np.ndarray]) -> np.ndarray:
    k = SH_BANDS[int(entry["bands"])] if entry else 0
    if not k:
        return np.zeros((count, 0, 3), np.float32)
    pixels = image(entry["files"][0])
    if pixels.shape[1] != PALETTE_WIDTH * k:
        raise ValueError(f"SH palette is {pixels.shape[1]} pixels wide, expected {PALETTE_WIDTH * k}")
    entries = np.array(entry["codebook"], np.float32)[pixels[..., :3].reshape(-1, k, 3)]
    labels = texels(entry, 1)
    label = labels[:, 0] + 256 * labels[:, 1]
    if count and label.max() >= min(len(entries), int(entry["count"])):
        raise ValueError(f"SH label {label.max()} for a palette of {entry['count']}")
    return entries[label]


def write_sog(path: Path, gaussians: Gaussians) -> None:
    """Writes a .sog, or an unpacked folder if the path is .../meta.json.

    Raises:
        CaptureError: there are no Gaussians, which this format cannot express.
    """
    if not len(gaussians):
        raise CaptureError(f"{path}: no Gaussians to write; use .ply for an empty frame")
    meta, maps = _maps(gaussians)
    files = {name: _webp(pixels) for name, pixels in maps.items()}
    files["meta.json"] = json.dumps(meta, separators=(",", ":")).encode()  # last: it makes the folder valid
    if path.suffix.lower() != ".sog":
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            with part_file(path.parent / name) as part:
                part.write_bytes(data)
        return
    with part_file(path) as part, zipfile.ZipFile(part, "w") as z:
        for name, data in files.items():
            z.writestr(zipfile.ZipInfo(name), data)


def _webp(rgba: np.ndarray) -> bytes:
    cv2 = require("cv2", "writing .sog")
    _, data = cv2.imencode(".webp", rgba[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS])
    return data.tobytes()


def _maps(g: Gaussians) -> tuple[dict, dict[str, np.ndarray]]:
    """meta.json and map name -> [H, W, 4] u8 RGBA."""
    width = -(-int(np.ceil(np.sqrt(len(g)))) // 4) * 4
    height = -(-len(g) // width)

    def grid(*channels: np.ndarray) -> np.ndarray:
        columns = np.concatenate([c.reshape(len(g), -1) for c in channels], 1).astype(np.uint8)
        out = np.full((height * width, 4), 255, np.uint8)
        out[: len(g), : columns.shape[1]] = columns
        return out.reshape(height, width, 4)

    log = np.sign(g.means) * np.log1p(np.abs(g.means.astype(np.float64)))
    low, high = log.min(0), log.max(0)
    position = np.rint((log - low) / np.where(high > low, high - low, 1) * 65535).astype(np.int64)
    small, largest = split_smallest_three(g.quats)
    scale_book, scales = codebook(g.log_scales)
    color_book, colors = codebook(g.sh0)
    opacity = np.clip(np.rint(sigmoid(g.logit_opacities) * 255), 1, 255)
    maps = {
        "means_l.webp": grid(position & 255),
        "means_u.webp": grid(position >> 8),
        "scales.webp": grid(scales),
        "quats.webp": grid(np.rint((small / np.sqrt(2) + 0.5) * 255), 252 + largest),
        "sh0.webp": grid(colors, opacity),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "gscodec"},
        "count": len(g),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_book, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book, "files": ["sh0.webp"]},
    }
    if g.shN.shape[1]:
        meta["shN"], maps["shN_centroids.webp"], label = _write_sh(g.shN)
        maps["shN_labels.webp"] = grid(label & 255, label >> 8, np.zeros(len(g)))
    return meta, maps


def _write_sh(shN: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray]:
    """The shN entry of meta.json, the palette's map and the label of each Gaussian."""
    k = shN.shape[1]
    entries, label = palette(shN.reshape(len(shN), 3 * k), PALETTE_MAX)
    book, code = codebook(entries)
    rows = -(-len(entries) // PALETTE_WIDTH)
    pixels = np.zeros((rows * PALETTE_WIDTH, k, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[: len(entries), :, :3] = code.reshape(len(entries), k, 3)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {"count": len(entries), "bands": SH_COUNTS[k], "codebook": book, "files": files}
    return meta, pixels.reshape(rows, PALETTE_WIDTH * k, 4), label
