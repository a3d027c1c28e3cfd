"""Frames of one camera -> temporal stability and flicker.

PSNR does not tell a constant error from one that changes in each frame. `stability` is the PSNR of differences of
consecutive frames. `flicker` is measured at still pixels, whose reference changes by less than 2 levels over 5 frames:
it is the standard deviation of the image over these frames, in 8-bit levels. A moving camera has few still pixels.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from .image import psnr_of_mse

WINDOW = 5  # frames
STILL = 2  # 8-bit levels


class TemporalMeter:
    """Takes the frames of one camera in order; keeps the last WINDOW of them."""

    def __init__(self):
        self._references: deque[np.ndarray] = deque(maxlen=WINDOW)
        self._images: deque[np.ndarray] = deque(maxlen=WINDOW)
        self._differences: list[float] = []
        self._deviation, self._samples = 0.0, 0

    def add(self, reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float | None:
        """Adds a frame, [H, W, 3] u8; flicker is measured inside `mask` ([H, W] bool) of the last frame.

        Returns:
            Flicker over the last WINDOW frames; None: there are fewer, or no pixel is still.
        """
        if self._images:
            change = reference.astype(np.float32) - self._references[-1]
            seen = image.astype(np.float32) - self._images[-1]
            self._differences.append(psnr_of_mse(float(np.mean((change - seen) ** 2, dtype=np.float64))))
        self._references.append(reference)
        self._images.append(image)
        if len(self._images) < WINDOW:
            return None
        window = np.stack(self._references)
        still = window.max(0) - window.min(0) < STILL  # [H, W, 3]
        if mask is not None:
            still &= mask[..., None]
        deviation = np.stack(self._images).std(0, dtype=np.float32)[still]
        self._deviation += float(deviation.sum(dtype=np.float64))
        self._samples += deviation.size
        return float(deviation.mean(dtype=np.float64)) if deviation.size else None

    @property
    def stability(self) -> float | None:
        """Mean PSNR of temporal differences in dB; None for a single frame."""
        return float(np.mean(self._differences)) if self._differences else None

    @property
    def flicker(self) -> float | None:
        """8-bit levels, over all frames; None: fewer than 5 frames, or no pixel was still."""
        return self._deviation / self._samples if self._samples else None
