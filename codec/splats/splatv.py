"""antimatter15's .splatv <-> Spacetime Gaussians.

Eight bytes (magic, length of the header), a JSON list of chunks, and their data; the chunk of type "splat" is a texture
with 64 bytes per Gaussian. A Gaussian without a finite position or orientation is left out, since viewers do not draw
it. Only files that this module wrote state the number of frames; other files count as 50, the usual clip of Spacetime
Gaussians.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError
from ..model.camera import Camera, cameras_around
from ..model.gaussians import SH_C0, Gaussians, logit
from .spacetime import SpacetimeGaussians

MAGIC = 0x674B
HEADER_MAX = 1 << 20  # bytes of JSON
FRAMES, FPS = 50, 30.0  # over the time from 0 to 1, if the file does not state them; frame t is at t / FRAMES
FRAMES_MAX = 100_000
FAR = 1e9  # a position beyond it is invalid
SCALE_MIN = 6e-8  # the least f16; a scale of 0 has no logarithm
ROW = np.dtype(
    [
        ("means", "<f4", 3), ("quats", "<f2", 4), ("scales", "<f2", 3), ("unused", "<f2"), ("rgba", "u1", 4),
        ("motion", "<f2", (3, 3)), ("unused2", "<f2"), ("turn", "<f2", 4), ("center", "<f2"), ("width", "<f2"),
    ]
)  # fmt: skip
LINE = 1024  # Gaussians in a line of the texture; writers may omit the rest of the last line


@dataclass(frozen=True)
class SplatvHeader:
    """The header of a file.

    Attributes:
        start: byte of the first Gaussian.
        count: number of Gaussians; some may not be drawable.
        frames, fps: number of frames of the clip, and frames per second.
    """

    start: int
    count: int
    frames: int
    fps: float


def read_splatv(path: Path) -> SpacetimeGaussians:
    """Reads a .splatv.

    Raises:
        CaptureError: not a .splatv, truncated, or no Gaussian can be drawn.
    """
    head = splatv_header(path)
    count = head.count
    rows = np.fromfile(path, ROW, count, offset=head.start)
    parts = {n: rows[n].astype(np.float64) for n in ROW.names}
    finite = np.all([np.isfinite(parts[n].reshape(count, -1)).all(1) for n in ROW.names if n != "width"], 0)
    finite &= (np.abs(parts["means"]) < FAR).all(1)
    drawn = finite & ~np.isnan(parts["width"]) & (np.abs(parts["quats"]) + np.abs(parts["turn"])).any(1)
    if not drawn.any():
        raise CaptureError(f"{path}: none of its {count} Gaussians has a finite position and an orientation")
    p = {n: v[drawn] for n, v in parts.items()}
    rest = Gaussians(
        means=p["means"],
        quats=p["quats"],
        log_scales=np.log(np.maximum(p["scales"], SCALE_MIN)),
        logit_opacities=logit(p["rgba"][:, 3] / 255),
        sh0=(p["rgba"][:, :3] / 255 - 0.5) / SH_C0,
        shN=np.zeros((len(p["means"]), 0, 3), np.float32),
    )
    widths = np.abs(p["width"])
    return SpacetimeGaussians(rest, p["motion"].transpose(1, 0, 2), p["turn"], p["center"], widths)


def splatv_header(path: Path) -> SplatvHeader:
    """The header.

    Raises:
        CaptureError: not a .splatv, or truncated.
    """
    size = path.stat().st_size
    with path.open("rb") as f:
        magic, length = struct.unpack("<II", f.read(8).ljust(8, b"\0"))
        if magic != MAGIC:
            raise CaptureError(f"{path}: not a .splatv, expected it to open with {MAGIC:#x}, found {magic:#x}")
        if length > min(HEADER_MAX, size - 8):
            raise CaptureError(f"{path}: a header of {length} bytes, expected at most {min(HEADER_MAX, size - 8)}")
        text = f.read(length)
    try:
        chunks = json.loads(text)
        at = [c["type"] for c in chunks].index("splat")
        sizes = [int(c["size"]) for c in chunks[: at + 1]]
        frames, fps = int(chunks[at].get("frames", FRAMES)), float(chunks[at].get("fps", FPS))
    except (ValueError, KeyError, TypeError, AttributeError) as e:
        raise CaptureError(f"{path}: its header has no chunk of type splat with a size ({e})") from None
    if not 0 < frames <= FRAMES_MAX or not 0 < fps < 1e4:
        raise CaptureError(f"{path}: {frames} frames at {fps:g} a second, expected 1 to {FRAMES_MAX} and a usual rate")
    start, promised = 8 + length + sum(sizes[:at]), sizes[at]
    there = min(promised, size - start)
    if min(sizes) < 0 or there <= 0 or there % ROW.itemsize or promised - there >= LINE * ROW.itemsize:
        raise CaptureError(f"{path}: truncated, {max(there, 0)} of {promised} bytes of its Gaussians are there")
    return SplatvHeader(start, there // ROW.itemsize, frames, fps)


def write_splatv(
    path: Path, scene: SpacetimeGaussians, frames: int, fps: float, cameras: Sequence[Camera] = ()
) -> None:
    """Writes a .splatv; colours are clipped to 8 bits.

    Args:
        frames, fps: number of frames of the clip, and frames per second; viewers do not need them.
        cameras: start cameras for a viewer; none: one in front of the scene.
    """
    lines = -(-len(scene) // LINE)
    rows = np.zeros(lines * LINE, ROW)
    own, g = rows[: len(scene)], scene.rest
    with np.errstate(over="ignore"):  # an infinite width becomes the largest f16
        own["means"], own["quats"], own["scales"] = g.means, g.quats, np.exp(g.log_scales)
        own["rgba"][:, :3] = np.clip(np.rint((g.sh0 * SH_C0 + 0.5) * 255), 0, 255)
        own["rgba"][:, 3] = np.rint(255 / (1 + np.exp(-g.logit_opacities.astype(np.float64))))
        own["motion"], own["turn"] = scene.motion.transpose(1, 0, 2), scene.turn
        own["center"], own["width"] = scene.centers, np.minimum(scene.widths, np.finfo("f2").max)
    views = list(cameras) or cameras_around(g.means, 1, name="front")
    splat = {"type": "splat", "size": rows.nbytes, "texwidth": 4 * LINE, "texheight": lines}
    splat |= {"cameras": [_camera(i, c) for i, c in enumerate(views)], "frames": frames, "fps": fps}
    text = json.dumps([splat], separators=(",", ":")).encode()
    with part_file(path) as part, part.open("wb") as f:
        f.write(struct.pack("<II", MAGIC, len(text)) + text + rows.tobytes())


def _camera(i: int, c: Camera) -> dict:
    """A camera in the viewers' form: rotation from the camera to the world."""
    pose = {"position": c.center.tolist(), "rotation": c.viewmat[:3, :3].T.tolist()}
    size = {"width": c.width, "height": c.height, "fx": float(c.K[0, 0]), "fy": float(c.K[1, 1])}
    return {"id": i, "img_name": c.name} | size | pose
