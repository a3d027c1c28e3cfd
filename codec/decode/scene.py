"""File with several tracks -> frames (spec 2.8). Each track is a `Stream`, placed by its `Placement`; a frame is the
concatenated Gaussians of all visible tracks.

A track with damaged boxes or groups, or a track that is not in the file yet, is left out of the frames that it cannot
give, with a warning; the other tracks are shown.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from .. import _native
from ..errors import BitstreamError, LimitError, UsageError
from ..model.camera import Camera
from ..model.gaussian_sequence import DenseGroup, GaussianSequence
from ..model.gaussians import Gaussians, concatenate
from ..model.placement import Placement, Rate
from .stream import Stream, open_bytes


@dataclass(frozen=True)
class Track:
    """A track of a scene: its groups and its placement."""

    stream: Stream
    placement: Placement

    @property
    def rate(self) -> Rate:
        """Timescale, and frame duration in its units."""
        return tuple(self.stream.config["fps"])


class Scene:
    """Frames of all tracks of a .gsv file, with the interface of a `Stream`.

    Attributes:
        tracks: in the order of the file, with hidden tracks; unreadable tracks are left out.
        config: of the first track, whose clock, up axis, background and cameras are those of the scene.
        complete: no track ends inside a group.
    """

    def __init__(self, tracks: Sequence[Track], name: str = "scene", lost: Sequence[str] = ()):
        self.tracks, self.name, self._told = list(tracks), name, set()
        self.config = self.tracks[0].stream.config
        self.complete = not lost and all(t.stream.complete for t in self.tracks)
        for message in lost:
            self._tell(message)

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.tracks[0].stream.fps

    @property
    def frame_count(self) -> int:
        """Frames of the scene until the last visible track ends."""
        n, d = self.tracks[0].rate
        ends = [
            -(-t.placement.end(t.stream.frame_count, t.rate) * n // (t.rate[0] * d))
            for t in self.tracks
            if not t.placement.hidden
        ]
        return max([0, *ends])

    @property
    def byte_count(self) -> int:
        """Size of the file in bytes."""
        return self.tracks[0].stream.file_size

    @property
    def groups(self) -> list[dict]:
        """The groups of all tracks, as `Stream.groups`."""
        return [g for t in self.tracks for g in t.stream.groups]

    @property
    def cameras(self) -> list[Camera]:
        """Reference cameras of the first track."""
        return self.tracks[0].stream.cameras

    @property
    def damage(self) -> list[dict]:
        """As `Stream.damage`, with the number of the track."""
        return [{"track": i, **d} for i, t in enumerate(self.tracks) for d in t.stream.damage]

    def frame(self, t: int) -> Gaussians:
        """Frame `t` of the scene: the Gaussians of the tracks that it shows.

        Raises:
            IndexError: `t` is not in the scene.
        """
        if not 0 <= t < self.frame_count:
            raise IndexError(f"{self.name} has {self.frame_count} frames")
        parts = [part for track in self.tracks if (part := self._part(track, t)) is not None]
        return _joined(parts)

    def _part(self, track: Track, t: int) -> Gaussians | None:
        """Gaussians of a track in frame `t` of the scene; None: the track is hidden, not playing, or damaged there."""
        (n, d), placement = self.tracks[0].rate, track.placement
        u = Fraction(t * d * track.rate[0], n)
        own = placement.frame(u, track.stream.frame_count, track.rate)
        if placement.hidden or own is None:
            return None
        try:
            return track.stream.frame(own, placement.pose(u))
        except (BitstreamError, LimitError) as e:
            if len(self.tracks) == 1:
                raise
            self._tell(str(e))
            return None

    def _tell(self, message: str) -> None:
        if message not in self._told:
            self._told.add(message)
            warnings.warn(f"a track is left out where it is damaged: {message}", stacklevel=3)

    def sequence(self) -> GaussianSequence:
        """The whole scene; every frame is a group of its own, decoded when read."""
        return GaussianSequence(self.fps, [DenseGroup(_Frame(self, t)) for t in range(self.frame_count)], self.cameras)

    def plain(self) -> Stream | None:
        """The stream of the only track if its placement changes nothing; otherwise None."""
        only = self.tracks[0]
        return only.stream if len(self.tracks) == 1 and _unplaced(only.placement) else None

    def alone(self, purpose: str) -> Stream:
        """The stream of the only visible track, without its placement.

        Raises:
            UsageError: several tracks are visible, or none.
        """
        shown = [t for t in self.tracks if not t.placement.hidden]
        if len(shown) != 1:
            names = ", ".join(t.placement.name for t in self.tracks)
            raise UsageError(
                f"{purpose} takes one track, {self.name} shows {len(shown)}; add --track NAME:only ({names})"
            )
        return shown[0].stream


def _unplaced(p: Placement) -> bool:
    return not (p.hidden or p.offset or p.keys) and p.repeats == 1


class _Frame(Sequence):
    """One frame of a scene as the sequence of frames of a group."""

    def __init__(self, scene: Scene, t: int):
        self.scene, self.t = scene, t

    def __len__(self) -> int:
        return 1

    def __getitem__(self, i: int) -> Gaussians:
        return self.scene.frame(range(self.t, self.t + 1)[i])


def _joined(parts: list[Gaussians]) -> Gaussians:
    """Concatenates sets whose SH degrees may differ; missing coefficients are 0."""
    most = max((p.shN.shape[1] for p in parts), default=0)
    if not parts:
        return Gaussians.none()
    widths = [((0, 0), (0, most - p.shN.shape[1]), (0, 0)) for p in parts]
    return concatenate([replace(p, shN=np.pad(p.shN, w)) for p, w in zip(parts, widths, strict=True)])


def open_scene(path: str | Path, *, strict: bool = True, layers: int | None = None) -> Scene:
    """Opens a .gsv file with all of its tracks.

    Args:
        strict, layers: see `open_stream`.

    Raises:
        FileNotFoundError: the file does not exist.
        BitstreamError: it is not a .gsv file, or its first track is damaged.
        LimitError: its first track exceeds a limit.
    """
    data, name = open_bytes(path), str(path)
    try:
        return read_scene(data, name, strict=strict, layers=layers)
    except BitstreamError as e:
        raise BitstreamError(f"{path}: {e}") from None


def read_scene(data, name: str = "scene", *, strict: bool = True, layers: int | None = None) -> Scene:
    """`open_scene` of the bytes of a file."""
    count = _native.track_count(data)
    streams, lost = [], []
    for k in range(count):
        try:
            streams.append(Stream(data, name, strict=strict, layers=layers, track=k if count > 1 else None))
        except (BitstreamError, LimitError) as e:
            if k == 0:
                raise  # the first track has the clock and the world of the scene
            lost.append(f"track {k + 1} of {name}: {e}")
    return Scene([Track(s, Placement(**s.config["placement"])) for s in streams], name, lost)
