"""Dense frames of a group as arrays over time."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..model.gaussian_sequence import DenseGroup
from ..model.gaussians import Gaussians
from ..threads import each_frame


@dataclass(frozen=True)
class DenseStack:
    """All frames of a group, T first; values outside a lifetime repeat the nearest frame inside.

    Attributes:
        frames: means [T, N, 3], quats [T, N, 4], log_scales [T, N, 3], logit_opacities [T, N], sh0 [T, N, 3] and shN
            [T, N, K, 3] f32, in a `Gaussians` with T in front.
        lifetimes: [N, 2] int32, or None.
    """

    frames: Gaussians
    lifetimes: np.ndarray | None

    @staticmethod
    def of(group: DenseGroup) -> DenseStack:
        """Loads all frames; quaternions become continuous over time (q and -q are the same rotation)."""
        loaded = each_frame(lambda t: group.frames[t], len(group))
        names = [f.name for f in fields(Gaussians)]
        arrays = each_frame(lambda k: np.stack([getattr(g, names[k]) for g in loaded]), len(names))
        raw = DenseStack(Gaussians(**dict(zip(names, arrays, strict=True))), group.lifetimes)
        held = {n: raw.held(a) for n, a in zip(names, arrays, strict=True)}
        held["quats"] = _continuous(held["quats"])
        return DenseStack(Gaussians(**held), group.lifetimes)

    def __len__(self) -> int:
        return len(self.frames.means)

    def held(self, a: np.ndarray) -> np.ndarray:
        """Values [T, N, ...] of these Gaussians; outside a lifetime they repeat the nearest frame inside."""
        if self.lifetimes is None:
            return a
        return a[self.nearest_frame(np.arange(len(a))[:, None]), np.arange(a.shape[1])]

    def nearest_frame(self, t: np.ndarray | int) -> np.ndarray:
        """[..., N] the frame nearest to `t` ([..., 1] or a number) in which each Gaussian is shown."""
        life = np.array([[0, len(self)]]) if self.lifetimes is None else self.lifetimes
        return np.clip(t, life[:, 0], life[:, 1] - 1)

    def at(self, t: int) -> Gaussians:
        """Each Gaussian as it is in the frame nearest to `t` in which it is shown."""
        at, each = self.nearest_frame(t), np.arange(self.frames.means.shape[1])
        return Gaussians(**{f.name: getattr(self.frames, f.name)[at, each] for f in fields(Gaussians)})


def _continuous(quats: np.ndarray) -> np.ndarray:
    """[T, N, 4], each with the sign nearer to its neighbour in time, from the middle frame outwards."""
    quats, middle = quats.copy(), len(quats) // 2
    for t in [*range(middle + 1, len(quats)), *range(middle - 1, -1, -1)]:
        before = quats[t - 1] if t > middle else quats[t + 1]
        quats[t] *= np.where(np.einsum("nc,nc->n", quats[t], before) < 0, -1, 1).astype(np.float32)[:, None]
    return quats
