"""zstd on plain quantized planes: the size of a sequence without a model.

Positions have 2 x `bits`, all else `bits`, ranges are over the group. Frames are differences from the previous frame,
split into a low and a high byte plane.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.errors import require
from gscodec.model.gaussians import Gaussians

SETTINGS = {f"{b} bit": {"bits": b} for b in (4, 5, 6, 7, 8)}
LEVEL = 19


def compress(data: bytes) -> bytes:
    """zstd at the highest of its ordinary levels."""
    return require("zstandard", "a zstd baseline", "bench").ZstdCompressor(level=LEVEL).compress(data)


def decompress(data: bytes) -> bytes:
    """The mirror of `compress`."""
    return require("zstandard", "a zstd baseline", "bench").ZstdDecompressor().decompress(data)


def encode(frames: Sequence[Gaussians], bits: int) -> dict[str, bytes]:
    """Codes a group; returns its files."""
    values = np.stack([_columns(g) for g in frames])  # [T, N, C]
    low, high = values.min((0, 1)), values.max((0, 1))
    levels = _levels(values.shape[2], bits)
    codes = np.rint((values - low) / np.where(high > low, high - low, 1) * levels).astype(np.uint16)
    codes[1:] -= codes[:-1].copy()  # modulo 2^16
    shape = np.array([*codes.shape, bits], np.uint32)
    planes = codes.transpose(0, 2, 1)
    return {
        "planes": compress(np.stack([planes & 255, planes >> 8]).astype(np.uint8).tobytes()),
        "ranges": np.stack([low, high]).astype(np.float32).tobytes(),
        "shape": shape.tobytes(),
    }


def _columns(g: Gaussians) -> np.ndarray:
    shN = g.shN.reshape(len(g), -1)
    return np.concatenate([g.means, g.quats, g.log_scales, g.logit_opacities[:, None], g.sh0, shN], 1)


def _levels(channels: int, bits: int) -> np.ndarray:
    return np.where(np.arange(channels) < 3, 2.0 ** (2 * bits) - 1, 2.0**bits - 1)


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    length, count, channels, bits = (int(x) for x in np.frombuffer(files["shape"], np.uint32))
    low, high = np.frombuffer(files["ranges"], np.float32).reshape(2, channels)
    planes = np.frombuffer(decompress(files["planes"]), np.uint8).reshape(2, length, channels, count)
    codes = np.cumsum(planes[0] + (planes[1].astype(np.uint16) << 8), axis=0, dtype=np.uint16)
    frames = []
    for code in codes:
        v = code.T / _levels(channels, bits) * (high - low) + low
        quats = np.where(v[:, 3:7].any(1, keepdims=True), v[:, 3:7], (1, 0, 0, 0))
        shN = v[:, 14:].reshape(count, -1, 3)
        frames.append(Gaussians(v[:, :3], quats, v[:, 7:10], v[:, 10], v[:, 11:14], shN).validate("zstd"))
    return frames
