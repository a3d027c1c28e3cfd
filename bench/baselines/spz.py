"""SPZ version 4 (Niantic) per frame: written by splat-transform with its defaults, read here after its description.

A header of 32 bytes, a table of (compressed, plain) sizes, and zstd streams of positions (24 bit fixed point), opacity,
colour, log scales (8 bit each), rotations (xyzw, the smallest three as sign and 9 bits, the index of the largest on
top) and SH (8 bit).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from gscodec.model.gaussians import SH_COUNTS, Gaussians, logit
from gscodec.splats.smallest_three import join_smallest_three

from .splat_transform import convert
from .zstd import decompress

SETTINGS = {"default": {}}
COLOR_SCALE = 0.15


def encode(frames: Sequence[Gaussians]) -> dict[str, bytes]:
    """One .spz for each frame."""
    return convert(frames, ".spz")


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames, in the axes of the input."""
    return [_read(data) for data in files.values()]


def _read(data: bytes) -> Gaussians:
    magic, version, count, degree, fraction, _, streams, start = struct.unpack_from("<4sIIBBBBI", data)
    if magic != b"NGSP" or version != 4:
        raise ValueError(f"SPZ version {version}, expected 4")
    sizes = np.frombuffer(data, "<u8", 2 * streams, start).reshape(-1, 2)[:, 0].astype(int)
    at = start + 16 * streams + np.concatenate([[0], np.cumsum(sizes)])
    parts = [np.frombuffer(decompress(data[a:b]), np.uint8).reshape(count, -1) for a, b in pairwise(at)]
    position, alpha, color, scale, rotation = parts[:5]
    shifted = position.reshape(count, 3, 3).astype(np.int64) @ (1 << np.array([8, 16, 24]))
    fixed = shifted.astype(np.int32) >> 8  # with its sign
    packed = rotation.view("<u4")[:, 0]
    field = packed[:, None] >> np.array([20, 10, 0], np.uint32)
    small = (field & 511) / 511 * np.sqrt(0.5) * np.where(field & 512, -1, 1)
    k = {d: k for k, d in SH_COUNTS.items()}[degree]
    shN = (parts[5].reshape(count, k, 3) - 128.0) / 128 if k else np.zeros((count, 0, 3))
    return Gaussians(
        means=fixed / (1 << fraction),
        quats=np.roll(join_smallest_three(small, packed >> 30), 1, 1),
        log_scales=scale / 16 - 10,
        logit_opacities=logit(alpha[:, 0] / 255),
        sh0=(color / 255 - 0.5) / COLOR_SCALE,
        shN=shN,
    ).validate("SPZ")
