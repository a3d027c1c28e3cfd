"""A group as arrays over time: what all stages of the encoder look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..bitstream.color import decorrelate
from ..model.gaussians import Gaussians, Group
from .axis_order import quat_multiply
from .parallel import each_frame


@dataclass(frozen=True)
class Stack:
    """All frames of a group as arrays, T first; values outside a lifetime repeat the nearest frame inside."""

    means: np.ndarray  # [T, N, 3]
    quats: np.ndarray  # [T, N, 4]
    log_scales: np.ndarray  # [T, N, 3]
    logit_opacities: np.ndarray  # [T, N]
    sh0: np.ndarray  # [T, N, 3]
    shN: np.ndarray  # [T, N, K, 3]
    lifetimes: np.ndarray | None  # [N, 2]

    def held(self, a: np.ndarray) -> np.ndarray:
        """[T, N, ...] of these Gaussians; outside a lifetime it repeats the nearest frame inside."""
        return a[self.near(np.arange(len(a))[:, None]), np.arange(a.shape[1])] if self.lifetimes is not None else a

    def near(self, t: np.ndarray) -> np.ndarray:
        """[..., N] the frame nearest to `t` ([...] or [..., 1]) in which each Gaussian is shown."""
        life = np.array([[0, len(self.means)]]) if self.lifetimes is None else self.lifetimes
        return np.clip(t, life[:, 0], life[:, 1] - 1)

    def take(self, index: np.ndarray) -> Stack:
        """The Gaussians at `index`, in that order."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Stack(*(a[:, index] for a in arrays), None if self.lifetimes is None else self.lifetimes[index])

    def only(self, t: int) -> Stack:
        """Frame `t` alone."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Stack(*(a[t : t + 1] for a in arrays), None)

    def frame(self, t: int) -> Gaussians:
        """All Gaussians as they are at frame `t`."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Gaussians(*(a[t] for a in arrays))

    @cached_property
    def appearance(self) -> dict[str, np.ndarray]:
        """[T, N, C] f32 of each attribute that only adds up over time."""
        frames, n, k, _ = self.shN.shape
        arrays = {
            "log_scales": self.log_scales,
            "logit_opacities": self.logit_opacities[..., None],
            "sh0": decorrelate(self.sh0),
        }
        if k:
            arrays["shN"] = decorrelate(self.shN).reshape(frames, n, 3 * k)
        return arrays


def stack_group(group: Group) -> Stack:
    """Loads all frames of `group` (f32)."""
    frames = each_frame(lambda t: group.frames[t], len(group))
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    arrays = each_frame(lambda k: np.stack([getattr(f, names[k]) for f in frames]), len(names))
    raw = Stack(*arrays, group.lifetimes)
    return Stack(*(raw.held(a) for a in arrays), group.lifetimes)


def align_axes(s: Stack, middle: int, turn: np.ndarray, order: np.ndarray) -> Stack:
    """Every Gaussian in the form that `canonical_axes` chose, in all frames, quaternions continuous in time."""
    quats = quat_multiply(s.quats, turn[None].astype(np.float32))
    quats[middle] *= np.where(quats[middle, :, :1] < 0, -1, 1)
    for t in [*range(middle + 1, len(quats)), *range(middle - 1, -1, -1)]:
        before = quats[t - 1] if t > middle else quats[t + 1]
        quats[t] *= np.where(np.einsum("nc,nc->n", quats[t], before) < 0, -1, 1).astype(np.float32)[:, None]
    scales = np.take_along_axis(s.log_scales, order[None], 2)
    return Stack(s.means, quats, scales, s.logit_opacities, s.sh0, s.shN, s.lifetimes)


def canonical_appearance(s: Stack) -> dict[str, np.ndarray]:
    """[N, C] f64 of each attribute that only adds up over time: the mean over the frames."""
    return {n: v.mean(0, dtype=np.float64) for n, v in s.appearance.items()}
