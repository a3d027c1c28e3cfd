"""AV1 (SVT-AV1) on the maps of maps.py: the packing of MPEG's anchor with a current encoder.

SVT-AV1 codes 4:2:0 only, so that each channel is the luma of a video of its own; chroma is flat. Preset 6 is the one
for video on demand in the project's guide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.model.gaussians import Gaussians

from .ffmpeg import SVT_AV1, decode_videos, encode_videos
from .maps import CHANNELS, LOSSLESS, pack, unpack

SETTINGS = {f"qp {qp}": {"qp": qp} for qp in (4, 10, 18, 26, 34, 42)}
PRESET = 6


def encode(frames: Sequence[Gaussians], qp: int) -> dict[str, bytes]:
    """Codes a group of SH degree 0 with quantizer `qp` (0 to 63) for all but the means; returns its files."""
    maps, ranges = pack(frames)
    videos = {f"{name}_{c}": planes[:, c] for name, planes in maps.items() for c in range(planes.shape[1])}
    options = {name: [*SVT_AV1, "-preset", str(PRESET), *_quantizer(name, qp)] for name in videos}
    shape = np.array([len(frames), maps["sh0"].shape[2]], np.uint32)
    return encode_videos(videos, options) | {"ranges": ranges, "shape": shape.tobytes()}


def _quantizer(name: str, qp: int) -> list[str]:
    if name.startswith(LOSSLESS):
        return ["-svtav1-params", "lossless=1"]
    return ["-qp", str(qp), "-svtav1-params", "rc=0:aq-mode=0"]


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    length, side = (int(x) for x in np.frombuffer(files["shape"], np.uint32))
    channels = {name: 3 for name in LOSSLESS} | {k: v for k, v in CHANNELS.items() if k != "means"}
    names = [f"{name}_{c}" for name, count in channels.items() for c in range(count)]
    videos = decode_videos({n: files[n] for n in names}, "obu", dict.fromkeys(names, (length, side, side)))
    maps = {name: np.stack([videos[f"{name}_{c}"] for c in range(n)], 1) for name, n in channels.items()}
    return unpack(maps, files["ranges"])
