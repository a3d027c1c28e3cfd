"""Groups of frames in playing order. Dense groups, one set of splats per frame, are for exchange with other tools."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .gaussians import Gaussians, shown_at
from .parametric_group import ParametricGroup


@dataclass(frozen=True)
class DenseGroup:
    """T consecutive frames with one set of N Gaussians, frame by frame: index i is the same Gaussian in all of them.

    Attributes:
        frames: T items; may be a lazy sequence that loads on access.
        lifetimes, parents: as in `ParametricGroup`.
    """

    frames: Sequence[Gaussians]
    lifetimes: np.ndarray | None = None
    parents: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, t: int) -> Gaussians:
        """All N Gaussians at frame `t` of the group."""
        return self.frames[t]

    def visible(self, t: int) -> Gaussians:
        """The Gaussians that frame `t` of the group shows."""
        return shown_at(self.frames[t], self.lifetimes, t)


@dataclass(frozen=True)
class GaussianSequence:
    """Groups in playing order.

    Attributes:
        fps: frames a second.
        groups: in playing order.
        cameras: reference cameras (`Camera`), shown to the viewer.
    """

    fps: float
    groups: Sequence[DenseGroup | ParametricGroup]
    cameras: list = field(default_factory=list)

    @property
    def frame_count(self) -> int:
        """Frames of all groups."""
        return sum(len(g) for g in self.groups)

    def with_groups(self, groups: Sequence[DenseGroup | ParametricGroup]) -> GaussianSequence:
        """This sequence with other groups."""
        return replace(self, groups=groups)

    def frame(self, t: int) -> Gaussians:
        """Frame `t` of the sequence as shown.

        Raises:
            IndexError: `t` is outside the sequence.
        """
        for g in self.groups:
            if 0 <= t < len(g):
                return g.visible(t)
            t -= len(g)
        raise IndexError("frame outside the sequence")
