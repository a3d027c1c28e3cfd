"""MPEG's video anchor for Gaussian sequences (GSCodec Studio) with x265: the maps of maps.py as seven videos a group.

Means, scales, colour and the vector part of the rotation are 4:4:4 videos of three channels; opacity and the real part
of the rotation are grey. rp0 to rp3 are the anchor's rate points; rp4 and rp5 continue their spacing, since the anchor
starts above the range of interest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gscodec.model.gaussians import Gaussians

from .ffmpeg import X265, decode_videos, encode_videos
from .maps import LOSSLESS, pack, unpack

QPS = {"rp0": (4, 4, 4), "rp1": (4, 10, 4), "rp2": (10, 16, 10), "rp3": (16, 22, 16), "rp4": (22, 28, 22)}
QPS |= {"rp5": (28, 34, 28)}  # opacity; scales and rotation; colour
SETTINGS = {name: dict(zip(("opacity", "shape", "color"), qps, strict=True)) for name, qps in QPS.items()}


def encode(frames: Sequence[Gaussians], opacity: int, shape: int, color: int) -> dict[str, bytes]:
    """Codes a group of SH degree 0 at the given QPs; returns its files."""
    maps, ranges = pack(frames)
    quats = maps.pop("quats")
    videos = maps | {"quat_w": quats[:, :1], "quat_xyz": quats[:, 1:]}
    qps = {"logit_opacities": opacity, "log_scales": shape, "quat_w": shape, "quat_xyz": shape, "sh0": color}
    options = {name: [*X265, "-x265-params", _params(qps.get(name))] for name in videos}
    streams = encode_videos({name: _planes(v) for name, v in videos.items()}, options)
    shapes = np.array([len(frames), maps["sh0"].shape[2]], np.uint32)
    return streams | {"ranges": ranges, "shape": shapes.tobytes()}


def _params(qp: int | None) -> str:
    return "info=0:log-level=none:" + ("lossless=1" if qp is None else f"qp={qp}")


def _planes(video: np.ndarray) -> np.ndarray:
    """[T, 1 or 3, H, W] -> planes of ffmpeg's formats: grey, or green, blue, red."""
    return video[:, 0] if video.shape[1] == 1 else video[:, [1, 2, 0]]


def decode(files: dict[str, bytes]) -> list[Gaussians]:
    """The frames of a group."""
    length, side = (int(x) for x in np.frombuffer(files["shape"], np.uint32))
    color = (length, 3, side, side)
    shapes = dict.fromkeys((*LOSSLESS, "sh0", "log_scales", "quat_xyz"), color)
    shapes |= dict.fromkeys(("logit_opacities", "quat_w"), (length, side, side))
    videos = decode_videos({name: files[name] for name in shapes}, "hevc", shapes)
    maps = {name: v[:, None] if v.ndim == 3 else v[:, [2, 0, 1]] for name, v in videos.items()}
    maps["quats"] = np.concatenate([maps.pop("quat_w"), maps.pop("quat_xyz")], 1)
    return unpack(maps, files["ranges"])
