"""Where and when a track is shown in its scene (spec 2.8): name, offset, repeats, and a similarity transform over time.

Times are integers in units of the track's timescale. `_native.pose_at` interpolates, `DecodedGroup.frame` applies it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from fractions import Fraction

import numpy as np

from .. import _native
from .rotations import quat_multiply

Pose = tuple[tuple[float, ...], tuple[float, ...], float]  # rotation (wxyz), translation, scale: x -> s R x + T
Key = tuple[int, tuple[float, ...], tuple[float, ...], float]  # time of the scene, then a pose
STILL: Key = (0, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
Rate = tuple[int, int]  # timescale, and frame duration in its units


@dataclass(frozen=True)
class Placement:
    """Placement of a track in its scene.

    Attributes:
        name: for people.
        hidden: the track is not shown.
        offset: time of the scene at which frame 0 is shown.
        repeats: how often the track is played; 0: without end.
        keys: by time; before the first key and after the last one the transform is constant. No keys: the identity.
    """

    name: str = ""
    hidden: bool = False
    offset: int = 0
    repeats: int = 1
    keys: tuple[Key, ...] = ()

    def to_config(self) -> dict:
        """The dict that `_native.init_segment` takes."""
        return asdict(self)

    def pose(self, u: Fraction | float) -> Pose | None:
        """The transform at time `u` of the scene; None: the identity."""
        return _native.pose_at(self.to_config(), float(u)) if self.keys else None

    def changed(self, *, turn=STILL[1], move=(0.0, 0.0, 0.0), scale: float = 1.0) -> Placement:
        """The track rotated by `turn` (wxyz) and scaled about its own origin, then moved, in addition to its keys."""
        turn = np.asarray(turn, float)
        keys = []
        for time, rotation, translation, own in self.keys or (STILL,):
            rotation = quat_multiply(turn, np.asarray(rotation, float))
            rotation = tuple((rotation / np.linalg.norm(rotation)).tolist())
            shifted = tuple(float(a + b) for a, b in zip(translation, move, strict=True))
            keys.append((time, rotation, shifted, own * scale))
        return replace(self, keys=tuple(keys))

    def frame(self, u: Fraction, frames: int, rate: Rate) -> int | None:
        """Index, below `frames`, of the track's frame at time `u` of the scene; None: it shows nothing."""
        n = int((u - self.offset) // rate[1])
        if n < 0 or not frames or (self.repeats and n >= self.repeats * frames):
            return None
        return n % frames

    def end(self, frames: int, rate: Rate) -> int:
        """Time of the scene at which the track ends; an endless track counts as played once."""
        return self.offset + max(self.repeats, 1) * frames * rate[1]
