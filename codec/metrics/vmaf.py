"""Two videos of one camera -> VMAF (libvmaf, model v0.6.1) through the ffmpeg of the imageio-ffmpeg wheel.

VMAF was trained on pictures that fill the screen; an empty background would dominate the score. So captures with masks
are cropped to the subject: one crop for the whole video, around the subject in all frames, with a margin. A small crop
is enlarged by an integer factor. Crop and factor are in the report. Frames are stored in raw files until `score`.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np

from ..errors import UsageError, require

MODEL = "version=vmaf_v0.6.1"
MARGIN = 16  # px around the subject
SIDE_MIN = 192  # px: a smaller crop grows to this, or is enlarged to it if the image is smaller


@cache
def _ffmpeg() -> str | None:
    """Path of the binary; None: it has no libvmaf."""
    path = require("imageio_ffmpeg", "VMAF").get_ffmpeg_exe()
    filters = subprocess.run([path, "-hide_banner", "-filters"], capture_output=True, text=True, check=False).stdout
    return path if " libvmaf " in filters else None


class VmafMeter:
    """Takes the frames of one camera in order; `score` runs ffmpeg. A context manager, which removes its files."""

    def __init__(self, fps: float):
        self._fps = fps
        self._folder = tempfile.TemporaryDirectory(prefix="gscodec-vmaf-")
        names = ("reference.rgb", "image.rgb")
        self._files = [(Path(self._folder.name) / n).open("wb") for n in names]
        self._size: tuple[int, int] | None = None  # width, height
        self._box: list[int] | None = None  # x0, y0, x1, y1 of the subject over all frames

    def __enter__(self) -> VmafMeter:
        return self

    def __exit__(self, *_) -> None:
        for f in self._files:
            f.close()
        self._folder.cleanup()

    def add(self, reference: np.ndarray, image: np.ndarray, alpha: np.ndarray | None = None) -> None:
        """Adds a frame, [H, W, 3] u8; `alpha` [H, W] marks the subject."""
        size = reference.shape[1], reference.shape[0]
        if image.shape != reference.shape or (self._size or size) != size:
            raise UsageError(f"VMAF needs frames of one size, got {image.shape} for the reference {reference.shape}")
        self._size = size
        for f, frame in zip(self._files, (reference, image), strict=True):
            f.write(np.ascontiguousarray(frame).tobytes())
        covered = np.ones(size[::-1], bool) if alpha is None else alpha > 0
        x, y = np.flatnonzero(covered.any(0)), np.flatnonzero(covered.any(1))
        if len(x):
            own = [x[0], y[0], x[-1] + 1, y[-1] + 1]
            box = self._box or own
            self._box = [*(min(a, b) for a, b in zip(box[:2], own[:2], strict=True)),
                         *(max(a, b) for a, b in zip(box[2:], own[2:], strict=True))]  # fmt: skip

    def crop(self) -> dict[str, int]:
        """x, y, width, height of the crop, pixels, and the integer factor `scale` that it is enlarged by."""
        width, height = self._size or (0, 0)
        box = self._box or [0, 0, width, height]
        x, w = _span(box[0], box[2], width)
        y, h = _span(box[1], box[3], height)
        return {"x": x, "y": y, "width": w, "height": h, "scale": -(-SIDE_MIN // min(w, h))}

    def score(self) -> float | None:
        """Mean VMAF over the frames, 0 to 100; None with a warning if this ffmpeg has no libvmaf.

        Raises:
            UsageError: there are no frames, or imageio-ffmpeg is not installed.
        """
        if self._size is None:
            raise UsageError("VMAF of no frames")
        binary = _ffmpeg()
        if binary is None:
            warnings.warn("VMAF is left out: the ffmpeg of imageio-ffmpeg has no libvmaf", stacklevel=2)
            return None
        for f in self._files:
            f.flush()
        c = self.crop()
        crop = f"crop={c['width']}:{c['height']}:{c['x']}:{c['y']}"
        chain = f"{crop},scale=iw*{c['scale']}:-1:flags=bicubic,format=yuv444p"
        graph = f"[0:v]{chain}[r];[1:v]{chain}[i];[i][r]libvmaf=model={MODEL}:log_fmt=json:log_path=vmaf.json"
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{self._size[0]}x{self._size[1]}", "-r", f"{self._fps:g}"]
        inputs = [*raw, "-i", "reference.rgb", *raw, "-i", "image.rgb"]
        command = [binary, "-v", "error", "-nostdin", *inputs, "-lavfi", graph, "-f", "null", "-"]
        done = subprocess.run(command, cwd=self._folder.name, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"ffmpeg failed on VMAF: {done.stderr.strip()}")
        return float(json.loads((Path(self._folder.name) / "vmaf.json").read_text())["pooled_metrics"]["vmaf"]["mean"])


def _span(low: int, high: int, size: int) -> tuple[int, int]:
    """Start and length of a crop along one axis: low to high with margin, at least SIDE_MIN, inside the image."""
    low, high = max(0, int(low) - MARGIN), min(size, int(high) + MARGIN)
    length = min(size, max(high - low, SIDE_MIN))
    return int(np.clip((low + high - length) // 2, 0, size - length)), length
