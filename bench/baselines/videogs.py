"""The packing of VideoGS (V3, Wang et al. 2024) with x264: a grey video for each byte plane of a group.

20 videos per group: positions as 16 bit in a high and a low byte plane, all else 8 bit with the minimum and maximum of
each frame and attribute, in order of opacity. High bytes are lossless, low bytes and opacity have `qp`, the rest at
most 22. All this is as in the published scripts, as are truncation instead of rounding and three unused planes of
normals. The script of the README stores exp(scale) and sigmoid(opacity); another one stores both as trained (`raw`),
which is better at the same bits. Both are measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.model.gaussians import Gaussians, logit, sigmoid

from .ffmpeg import X264, decode_videos, encode_videos

SETTINGS = {f"qp {qp}": {"qp": qp} for qp in (8, 12, 15, 18, 20, 25, 35, 45, 51)}
SETTINGS |= {f"qp 51/{rest}": {"qp": 51, "rest": rest} for rest in (26, 30, 34)}  # lower rates than the scripts reach
RAW_SETTINGS = {name: {**setting, "raw": True} for name, setting in SETTINGS.items()}
REST_QP_MAX = 22
EPS = 1e-6


def _columns(g: Gaussians, raw: bool) -> np.ndarray:
    """[N, 17] position, normal, colour, opacity, scale, rotation."""
    scale, opacity = g.log_scales.astype(np.float64), g.logit_opacities[:, None]
    if not raw:
        scale, opacity = np.exp(scale), sigmoid(opacity)
    return np.concatenate([g.means, np.zeros((len(g), 3)), g.sh0, opacity, scale, g.quats], 1)


def encode(frames: Sequence[Gaussians], qp: int, rest: int = REST_QP_MAX, raw: bool = False) -> dict[str, bytes]:
    """Codes a group of SH degree 0; returns its files."""
    order = np.argsort(-frames[0].logit_opacities, kind="stable")
    count, side = len(order), 8 * int(np.ceil(np.sqrt(len(order)) / 8))
    planes = np.zeros((20, len(frames), side * side), np.uint8)
    ranges = np.zeros((len(frames), 17, 2), np.float32)
    for t, frame in enumerate(frames):
        columns = _columns(frame, raw)[order]
        low, high = columns.min(0), columns.max(0)
        ranges[t] = np.stack([low, high], 1)
        unit = (columns - low) / np.where(high > low, high - low, 1)
        position = (unit[:, :3] * 65535).astype(np.uint16)
        planes[0:6:2, t, :count] = (position & 255).T
        planes[1:6:2, t, :count] = (position >> 8).T
        planes[6:, t, :count] = (unit[:, 3:] * 255).astype(np.uint8).T
    videos = {str(i): p.reshape(len(frames), side, side) for i, p in enumerate(planes)}
    streams = encode_videos(videos, {name: ["-qp", str(_qp(int(name), qp, rest)), *X264] for name in videos})
    return streams | {"ranges": ranges.tobytes(), "count": np.uint32(count).tobytes(), "raw": bytes([raw])}


def _qp(video: int, qp: int, rest: int) -> int:
    if video in (1, 3, 5):
        return 0
    return qp if video in (0, 2, 4, 12) else min(qp, rest)


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    ranges = np.frombuffer(files["ranges"], np.float32).reshape(-1, 17, 2)
    count, length = int(np.frombuffer(files["count"], np.uint32)[0]), len(ranges)
    side = 8 * int(np.ceil(np.sqrt(count) / 8))
    names = [str(i) for i in range(20)]
    videos = decode_videos({n: files[n] for n in names}, "h264", dict.fromkeys(names, (length, side, side)))
    planes = np.stack([videos[n] for n in names]).reshape(20, length, -1)[:, :, :count]
    frames = []
    for t in range(length):
        low, high = ranges[t].T
        position = (planes[0:6:2, t] + 256.0 * planes[1:6:2, t]) / 65535
        c = np.concatenate([position, planes[6:, t] / 255]).T * (high - low) + low
        quats = np.where(np.any(c[:, 13:], 1, keepdims=True), c[:, 13:], (1, 0, 0, 0))
        opacity, scales = c[:, 9], c[:, 10:13]
        if not files["raw"][0]:
            opacity, scales = logit(opacity), np.log(np.maximum(scales, EPS))
        shN = np.zeros((count, 0, 3))
        frames.append(Gaussians(c[:, :3], quats, scales, opacity, c[:, 6:9], shN).validate("VideoGS"))
    return frames
