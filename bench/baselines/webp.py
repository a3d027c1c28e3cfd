"""A static codec over all frames of a group at once: the maps of maps.py as lossless WebP images, as in SOG.

Each map holds the frames of the group one below the other, so that one dictionary and one predictor serve all of them.
Nothing is predicted from frame to frame. Positions have 16 bits, all else `bits`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.errors import require
from gscodec.model.gaussians import Gaussians

from .maps import LOSSLESS, pack, unpack

SETTINGS = {f"{b} bit": {"bits": b} for b in (4, 5, 6, 7, 8)}
LOSSLESS_QUALITY = 101  # OpenCV's value for lossless
SIDE_MAX = 16383  # of a WebP image, pixels


def encode(frames: Sequence[Gaussians], bits: int) -> dict[str, bytes]:
    """Codes a group of SH degree 0; returns its files."""
    cv2 = require("cv2", "a WebP baseline", "bench")
    maps, ranges = pack(frames)
    files = {"ranges": ranges, "shape": np.array([len(frames), maps["sh0"].shape[2], bits], np.uint32).tobytes()}
    for name, planes in _images(maps).items():
        code = planes if name in LOSSLESS else np.rint(planes / 255 * (2**bits - 1)).astype(np.uint8)
        for part, image in enumerate(_parts(code)):
            done, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, LOSSLESS_QUALITY])
            assert done
            files[f"{name}.{part}"] = data.tobytes()
    return files


def _images(maps: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Maps of three channels: one of rotation xyz; one of rotation w, opacity and zeros; the others as they are."""
    wide = dict(maps)
    quats, opacity = wide.pop("quats"), wide.pop("logit_opacities")
    none = np.zeros_like(opacity)
    return wide | {"quat_xyz": quats[:, 1:], "quat_w": np.concatenate([quats[:, :1], opacity, none], 1)}


def _parts(code: np.ndarray) -> list[np.ndarray]:
    """[T, 3, side, side] -> images [rows, side, 3] of as many whole frames as WebP allows."""
    side = code.shape[2]
    tall = max(1, SIDE_MAX // side)
    stacked = np.ascontiguousarray(np.moveaxis(code, 1, 3))
    return [stacked[t : t + tall].reshape(-1, side, 3) for t in range(0, len(code), tall)]


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    cv2 = require("cv2", "a WebP baseline", "bench")
    length, side, bits = (int(x) for x in np.frombuffer(files["shape"], np.uint32))
    maps = {}
    for name in (*LOSSLESS, "sh0", "log_scales", "quat_xyz", "quat_w"):
        count = sum(key.startswith(f"{name}.") for key in files)
        parts = [np.frombuffer(files[f"{name}.{i}"], np.uint8) for i in range(count)]
        rows = np.concatenate([cv2.imdecode(part, cv2.IMREAD_COLOR) for part in parts])
        planes = np.moveaxis(rows.reshape(length, side, side, 3), 3, 1)
        maps[name] = planes if name in LOSSLESS else planes * (255 / (2**bits - 1))
    shared = maps.pop("quat_w")
    maps["quats"] = np.concatenate([shared[:, :1], maps.pop("quat_xyz")], 1)
    maps["logit_opacities"] = shared[:, 1:2]
    return unpack(maps, files["ranges"])
