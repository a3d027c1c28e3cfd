"""Spacetime Gaussians (Li et al. 2024): a moving scene as functions of time <-> the frames of a sequence.

Each Gaussian has a cubic position, a linear rotation rate and an opacity that is a Gaussian in time. Its index is its
identity, and the frames in which its opacity is negligible are outside its lifetime. splatv.py reads and writes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ..model.gaussian_sequence import DenseGroup
from ..model.gaussians import Gaussians, logit, sigmoid

ALPHA_MIN = 1 / 255  # an opacity below it shows nothing (spec 14)
FADE_MIN = 0.02  # a share of the peak opacity below it is not drawn by antimatter15/splaTV
WIDTH_MIN = 1e-6  # least width of an opacity in time


@dataclass(frozen=True)
class SpacetimeGaussians:
    """N Gaussians over a time of 0 to 1.

    Attributes:
        rest: the Gaussians at time `centers`, with their highest opacities; quats may have any length.
        motion: [3, N, 3] f64, linear, quadratic and cubic coefficients of the position in time from `centers`.
        turn: [N, 4] f64, change of the quaternion per unit of time, before it is normalized.
        centers: [N] f64, time of the highest opacity.
        widths: [N] f64, opacity falls by exp(-((time - center) / width)^2); inf: it stays.
    """

    rest: Gaussians
    motion: np.ndarray
    turn: np.ndarray
    centers: np.ndarray
    widths: np.ndarray

    def __len__(self) -> int:
        return len(self.rest)

    def take(self, index: np.ndarray) -> SpacetimeGaussians:
        """The Gaussians at `index` ([M] int or [N] bool)."""
        own = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name not in ("rest", "motion")}
        return SpacetimeGaussians(self.rest.take(index), self.motion[:, index], **own)

    def fade(self, time: float) -> np.ndarray:
        """[N] f64 in 0..1, share of the highest opacity at `time`."""
        return np.exp(-(((time - self.centers) / np.maximum(self.widths, WIDTH_MIN)) ** 2))

    def shown(self, time: float) -> np.ndarray:
        """[N] bool: Gaussians that are visible at `time`."""
        fade = self.fade(time)
        return (fade >= FADE_MIN) & (fade * sigmoid(self.rest.logit_opacities) >= ALPHA_MIN)

    def at(self, time: float) -> Gaussians:
        """All Gaussians as they are at `time`."""
        dt = (time - self.centers)[:, None]
        a, b, c = self.motion
        quats = self.rest.quats + self.turn * dt
        length = np.linalg.norm(quats, axis=1, keepdims=True)
        still = length[:, 0] < 1e-9  # the quaternion passes through 0: as at rest
        quats = np.where(still[:, None], self.rest.quats, quats / np.maximum(length, 1e-9))
        logits = logit(self.fade(time) * sigmoid(self.rest.logit_opacities))
        means = self.rest.means + dt * (a + dt * (b + dt * c))
        return replace(self.rest, means=means, quats=quats, logit_opacities=logits).validate(f"time {time:.3f}")


class SpacetimeFrames(Sequence):
    """Frames at the given times, made on demand."""

    def __init__(self, scene: SpacetimeGaussians, times: Sequence[float]):
        self._scene, self._times = scene, times

    def __len__(self) -> int:
        return len(self._times)

    def __getitem__(self, t):
        if isinstance(t, slice):
            return SpacetimeFrames(self._scene, self._times[t])
        return self._scene.at(self._times[t])


def spacetime_groups(scene: SpacetimeGaussians, times: np.ndarray, gop: int) -> list[DenseGroup]:
    """Groups of at most `gop` frames at `times` ([T]); each has the Gaussians that any of its frames shows."""
    groups, before = [], None
    for start in range(0, len(times), gop):
        own = times[start : start + gop]
        shown = np.stack([scene.shown(t) for t in own])
        index = np.flatnonzero(shown.any(0))
        shown = shown[:, index]
        first, last = shown.argmax(0), len(own) - shown[::-1].argmax(0)  # one span: opacity has one peak
        parents = None if before is None else _positions(before, index, len(scene))
        lifetimes = np.stack([first, last], 1).astype(np.int32)
        groups.append(DenseGroup(SpacetimeFrames(scene.take(index), own), lifetimes, parents))
        before = index
    return groups


def _positions(before: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
    """[len(index)] int32, where each of `index` is in `before`; -1: nowhere. Both are indices below `count`."""
    place = np.full(count, -1, np.int32)
    place[before] = np.arange(len(before))
    return place[index]
