"""PNG writer (ISO/IEC 15948) on zlib alone, so that the player's side renders without an image library."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np


def encode_png(image: np.ndarray) -> bytes:
    """[H, W] u8 or u16 (grey), [H, W, 3] u8 (RGB) -> bytes of a PNG file."""
    depth = 16 if image.dtype == np.uint16 else 8
    color = 2 if image.ndim == 3 else 0
    h, w = image.shape[:2]
    rows = image.astype(">u2" if depth == 16 else "u1").reshape(h, -1).view(np.uint8).reshape(h, -1)
    filtered = np.zeros((h, rows.shape[1] + 1), np.uint8)
    filtered[:, 1:] = rows
    if h > 1:  # filter type 2: difference to the row above
        filtered[1:, 0] = 2
        filtered[1:, 1:] = rows[1:] - rows[:-1]

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", w, h, depth, color, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(filtered.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def write_png(path: Path, image: np.ndarray) -> None:
    """Writes `image` (see `encode_png`) to `path`, complete or not at all."""
    path = Path(path)
    part = path.with_name(path.name + ".part")
    part.write_bytes(encode_png(image))
    os.replace(part, path)
