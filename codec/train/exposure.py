"""Exposure of the training cameras: by how much each is brighter than the Gaussians, channel by channel.

Learned with a keyframe and kept while it is followed: what is drawn for a training camera is multiplied by its gains,
what a viewer sees is not. What all cameras share is the scene's own brightness: the mean of the log gains stays 0.

Shading looks like exposure as long as colours are not right yet (the lit side is brighter than they are), so that gains
are learned late; and cameras that are all alike within what shading alone makes of them (2 % on plain procedural
captures, 1 % on lumberjack) are taken as equal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gscodec import _native
from gscodec.gaussians import SH_C0, Gaussians
from gscodec.train.model import BETAS, EPS

RATE = 0.02
PULL = 0.02  # towards 1: this times half the square of a log gain is added to the loss
LEAST = 0.04  # root mean square of log gains that are kept


class Exposure:
    """Gains of the cameras of a capture.

    Attributes:
        log_gains: [C, 3] f32; 0 for cameras that are not `trained` on.
    """

    def __init__(self, count: int, trained: list[int]):
        self._count, self._trained = count, trained
        self.restart()

    def restart(self) -> None:
        """All cameras are equal."""
        self.log_gains, self._first, self._second = np.zeros((3, self._count, 3), np.float32)
        self._steps = np.zeros(self._count, int)
        self._equal = False

    def gain(self, camera: int) -> np.ndarray:
        """[3] f32."""
        return np.exp(self.log_gains[camera])

    def seen(self, g: Gaussians, camera: int) -> Gaussians:
        """The Gaussians in the colours that `camera` shows them in."""
        gain, grey = self.gain(camera), 0.5 / SH_C0
        return replace(g, sh0=gain * (g.sh0 + grey) - grey, shN=gain * g.shN)

    def learn(self, camera: int, grad: np.ndarray, fade: float) -> None:
        """One step of Adam for one camera; `grad`: [3], of the loss by its gain; rate times `fade`."""
        if self._equal:
            return
        row = self.log_gains[camera]
        grad = (grad * np.exp(row) + PULL * row).astype(np.float32)
        self._steps[camera] += 1
        tensors = (row, grad, self._first[camera], self._second[camera])
        _native.adam(tensors, RATE * fade, BETAS, EPS, int(self._steps[camera]))
        self.log_gains[self._trained] -= self.log_gains[self._trained].mean(0)

    def settle(self) -> None:
        """Cameras that hardly differ are equal from now on."""
        if np.sqrt(np.mean(self.log_gains[self._trained] ** 2)) < LEAST:
            self.restart()
            self._equal = True
