"""Raw planes <-> video streams through the ffmpeg of the imageio-ffmpeg wheel, many small videos in one call.

All videos of a group take one call and become elementary streams without the name of the encoder, so that the peers
are not charged for twenty process starts and MP4 headers per group, which a product would avoid too.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from gscodec.errors import UsageError, require

X264 = ["-c:v", "libx264", "-bsf:v", "filter_units=remove_types=6", "-f", "h264"]
X265 = ["-c:v", "libx265", "-f", "hevc"]
FLAT_CHROMA = ["-pix_fmt", "yuv420p", "-color_range", "pc"]  # grey for encoders without a grey format; pc: full range
SVT_AV1 = ["-c:v", "libsvtav1", *FLAT_CHROMA, "-f", "obu"]
VP9 = ["-c:v", "libvpx-vp9", *FLAT_CHROMA, "-f", "ivf"]
FORMATS = {1: "gray", 3: "gbrp"}


def encode_videos(videos: dict[str, np.ndarray], options: dict[str, list[str]]) -> dict[str, bytes]:
    """Codes each video with its own options.

    Args:
        videos: name -> [T, H, W] u8 (grey) or [T, 3, H, W] u8 (green, blue, red planes).
        options: name -> ffmpeg's output options: codec, its settings and the format.

    Returns:
        name -> stream.
    """
    with tempfile.TemporaryDirectory() as folder:
        inputs, outputs = [], []
        for i, (name, planes) in enumerate(videos.items()):
            planes.tofile(raw := Path(folder, f"{i}.raw"))
            height, width = planes.shape[-2:]
            layout = FORMATS[1 if planes.ndim == 3 else planes.shape[1]]
            inputs += ["-f", "rawvideo", "-pix_fmt", layout, "-s", f"{width}x{height}", "-r", "30", "-i", str(raw)]
            outputs += ["-map", f"{i}:v", *options[name], str(Path(folder, f"{i}.coded"))]
        _run(inputs, outputs)
        return {name: Path(folder, f"{i}.coded").read_bytes() for i, name in enumerate(videos)}


def decode_videos(streams: dict[str, bytes], kind: str, shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """The mirror of `encode_videos`.

    Args:
        kind: the format of all streams: h264, hevc, obu or ivf.
        shapes: name -> the shape of its planes, [T, H, W] or [T, 3, H, W].
    """
    with tempfile.TemporaryDirectory() as folder:
        inputs, outputs = [], []
        for i, (name, data) in enumerate(streams.items()):
            coded = Path(folder, f"{i}.coded")
            coded.write_bytes(data)
            layout = FORMATS[1 if len(shapes[name]) == 3 else shapes[name][1]]
            inputs += ["-f", kind, "-i", str(coded)]
            outputs += ["-map", f"{i}:v", "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", layout]
            outputs += [str(Path(folder, f"{i}.raw"))]
        _run(inputs, outputs)
        planes = {}
        for i, name in enumerate(streams):
            planes[name] = np.fromfile(Path(folder, f"{i}.raw"), np.uint8).reshape(shapes[name])
        return planes


def _run(inputs: list[str], outputs: list[str]) -> None:
    ffmpeg = require("imageio_ffmpeg", "a video baseline").get_ffmpeg_exe()
    done = subprocess.run([ffmpeg, "-v", "error", "-y", *inputs, *outputs], capture_output=True, text=True)
    if done.returncode:
        raise UsageError(f"ffmpeg could not code a baseline: {done.stderr.strip()[-500:]}")
