"""The public part of GSAV (OpsiClear's gscodec): attributes as one lossless VP9 atlas, in Morton order.

14 channels of 8 bit (position high bytes, scales, asin of the rotation, opacity, colour as YCbCr) lie side by side in
the luma; zstd codes the low bytes of the positions. The only rate control is `snap`: a code that differs from the code
in the previous frame by at most `snap` is replaced by that code. Ranges are those of the group, the order is that of
its first frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.model.gaussians import Gaussians

from .ffmpeg import VP9, decode_videos, encode_videos
from .grid import morton_order, side_of
from .zstd import compress, decompress

SETTINGS = {f"snap {s}": {"snap": s} for s in (0, 1, 2, 4, 8, 16)}
CHANNELS, WIDE = 14, 4  # channels, of which 4 lie side by side
YCBCR = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])  # BT.601


def encode(frames: Sequence[Gaussians], snap: int) -> dict[str, bytes]:
    """Codes a group of SH degree 0; returns its files."""
    order = morton_order(frames[0].means)
    values = np.stack([_columns(g)[order] for g in frames])  # [T, N, 14]
    low, high = values.min((0, 1)), values.max((0, 1))
    unit = (values - low) / np.where(high > low, high - low, 1)
    position = np.rint(unit[..., :3] * 65535).astype(np.uint16)
    codes = np.concatenate([position >> 8, np.rint(unit[..., 3:] * 255)], 2).astype(np.uint8)
    held = codes.astype(np.int16)
    for t in range(1, len(held)):  # the high bytes of positions stay exact, since low bytes belong to them
        near = np.abs(held[t] - held[t - 1]) <= snap
        near[:, :3] = False
        held[t][near] = held[t - 1][near]
    count, side = len(order), side_of(len(order))
    cells = np.zeros((len(frames), WIDE * WIDE, side * side), np.uint8)
    cells[:, :CHANNELS, :count] = held.swapaxes(1, 2)
    atlas = cells.reshape(-1, WIDE, WIDE, side, side).swapaxes(2, 3).reshape(len(frames), WIDE * side, WIDE * side)
    options = ["-lossless", "1", "-deadline", "good", "-cpu-used", "2", "-row-mt", "1", *VP9]
    return {
        "atlas": encode_videos({"atlas": atlas}, {"atlas": options})["atlas"],
        "low": compress((position & 255).astype(np.uint8).swapaxes(1, 2).tobytes()),
        "ranges": np.stack([low, high]).astype(np.float32).tobytes(),
        "shape": np.array([len(frames), count], np.uint32).tobytes(),
    }


def _columns(g: Gaussians) -> np.ndarray:
    """[N, 14] position, scale, rotation, opacity and colour in the form that is quantized."""
    quats = g.quats * np.where(g.quats[:, :1] < 0, -1, 1)
    parts = (g.means, g.log_scales, np.arcsin(np.clip(quats, -1, 1)), g.logit_opacities[:, None], g.sh0 @ YCBCR.T)
    return np.concatenate(parts, 1, dtype=np.float64)


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    length, count = (int(x) for x in np.frombuffer(files["shape"], np.uint32))
    low, high = np.frombuffer(files["ranges"], np.float32).reshape(2, CHANNELS)
    side = side_of(count)
    atlas = decode_videos({"atlas": files["atlas"]}, "ivf", {"atlas": (length, WIDE * side, WIDE * side)})["atlas"]
    cells = atlas.reshape(length, WIDE, side, WIDE, side).swapaxes(2, 3).reshape(length, WIDE * WIDE, -1)
    codes = cells[:, :CHANNELS, :count].swapaxes(1, 2)
    low_bytes = np.frombuffer(decompress(files["low"]), np.uint8).reshape(length, 3, count).swapaxes(1, 2)
    frames = []
    for t in range(length):
        unit = np.concatenate([(codes[t, :, :3] * 256.0 + low_bytes[t]) / 65535, codes[t, :, 3:] / 255], 1)
        v = unit * (high - low) + low
        color = v[:, 11:] @ np.linalg.inv(YCBCR).T
        g = Gaussians(v[:, :3], np.sin(v[:, 6:10]), v[:, 3:6], v[:, 10], color, np.zeros((count, 0, 3)))
        frames.append(g.validate("GSAV"))
    return frames
