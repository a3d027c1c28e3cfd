"""Tracks of .gsv files -> one file: mux, and edits without re-encoding. Every unit stays byte-identical, except the
poses of a track with a rig that gets new poses.

A `TrackPlan` says which groups of which files a track consists of, and where it is placed. Only boxes are written: moov
with the placements, an index of each track, and the fragments, whose times follow from their order.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from .. import _native
from ..atomic_write import part_file
from ..decode.scene import Track
from ..decode.stream import Stream
from ..errors import UsageError
from ..model.placement import Placement
from ..model.rig import Rig
from .reposing import reposed
from .writer import layer_ends

SAME = ("fps", "color_space", "up", "metres_per_unit")  # config fields that joined tracks must share


@dataclass(frozen=True)
class TrackPlan:
    """A track to write.

    Attributes:
        config: gsvC, as `_native.init_segment` takes it.
        placement: gsvT.
        groups: (file, number of the group in it) in playing order.
        rig: new poses for all of their frames; None: unchanged.
    """

    config: dict
    placement: Placement
    groups: Sequence[tuple[Stream, int]]
    rig: Rig | None = None

    @property
    def frame_count(self) -> int:
        """Frames of all groups."""
        return sum(stream.groups[i]["frames"] for stream, i in self.groups)

    @property
    def has_sound(self) -> bool:
        """Whether a group has sound."""
        return any("audio" in stream.groups[i] for stream, i in self.groups)

    @staticmethod
    def of(track: Track) -> TrackPlan:
        """The plan of a track of a file, unchanged."""
        config = {k: v for k, v in track.stream.config.items() if k not in ("track", "placement")}
        return TrackPlan(config, track.placement, [(track.stream, i) for i in range(len(track.stream.groups))])

    def joined(self, other: TrackPlan) -> TrackPlan:
        """This track, then the other one. Sound stays if both have the same form of it.

        Raises:
            UsageError: a field of `SAME` differs, such as the frame rate or the up axis.
        """
        for key in SAME:
            if self.config[key] != other.config[key]:
                raise UsageError(
                    f"tracks to join must have the same {key}, found {self.config[key]} and {other.config[key]}"
                )
        config = self.config | {key: max(self.config[key], other.config[key]) for key in ("level", "sh_degree")}
        if config.get("audio") != other.config.get("audio"):
            config.pop("audio", None)
        return replace(self, config=config, groups=[*self.groups, *other.groups])

    def cut(self, ranges: Sequence[range]) -> TrackPlan:
        """The frames of `ranges`, one range after the other; each must begin and end with groups.

        Raises:
            UsageError: a range does not begin and end with groups. (`check` looks for lost references.)
        """
        starts = [0]
        for stream, i in self.groups:
            starts.append(starts[-1] + stream.groups[i]["frames"])
        chosen = []
        for r in ranges:
            if r.start not in starts or r.stop not in starts:
                raise UsageError(
                    f"frames {r.start}:{r.stop} do not begin and end with groups; these begin at frames "
                    f"{', '.join(map(str, starts[:-1]))}, and the last one ends at {starts[-1]}"
                )
            chosen += self.groups[starts.index(r.start) : starts.index(r.stop)]
        return replace(self, groups=chosen)

    def check(self) -> None:
        """Raises UsageError if a predicted group has lost its reference."""
        for k, (stream, i) in enumerate(self.groups):
            back = _native.reference_of(stream.payload(i))
            if back and (k < back or self.groups[k - back] != (stream, i - back)):
                start = stream.groups[i]["start_frame"]
                first = stream.groups[i - back]["start_frame"] if back <= i else 0
                raise UsageError(
                    f"{stream.name}: the group of frame {start} is predicted from that of frame {first}, which "
                    f"must stay {back} groups before it; cut at groups that are not predicted"
                )


def write_tracks(out: Path, plans: Sequence[TrackPlan]) -> int:
    """Writes a file of these tracks; returns its size in bytes. Sound is that of the first track; cameras that equal
    those of the first track are written with it alone.

    Raises:
        UsageError: there is no track, a predicted group has lost its reference, or a group to be posed has no rig.
    """
    if not plans:
        raise UsageError(f"{out}: no track is left, expected at least one")
    for plan in plans:
        plan.check()
    configs = [p.config | {"track": k, "placement": p.placement.to_config()} for k, p in enumerate(plans)]
    for config in configs[1:]:
        config.pop("audio", None)
        if repr(config["cameras"]) == repr(configs[0]["cameras"]):
            config["cameras"] = []  # those of the scene are those of its first track (spec 2.8)
    init = _native.init_segment(configs[0], configs[1:])
    body = out.with_name(out.name + ".body")
    try:
        with body.open("wb") as f:
            number, indices = 0, []
            for plan, config in zip(plans, configs, strict=True):
                indices.append(_write_groups(f, plan, config, number))
                number += len(plan.groups)
        with part_file(out) as part, part.open("wb") as f, body.open("rb") as fragments:
            f.write(_native.finish(init, indices))
            shutil.copyfileobj(fragments, f, 1 << 20)
    finally:
        body.unlink(missing_ok=True)
    return os.path.getsize(out)


def _write_groups(f, plan: TrackPlan, config: dict, number: int) -> list[tuple[int, int, bool, list[int]]]:
    """Appends the fragments of a track; returns its index, as `_native.finish` takes it."""
    start, index = 0, []
    for stream, i in plan.groups:
        g, number = stream.groups[i], number + 1
        if plan.rig is None:
            payload = stream.payload(i)
        else:
            payload = reposed(stream, i, plan.rig.frames(range(start, start + g["frames"])))
        sound = _sound(stream, g, start, config)
        data = _native.fragment(payload, number, start, g["frames"], g["sync"], config, sound)
        f.write(data)
        head = len(data) - len(payload)
        index.append((len(data), g["frames"], g["sync"], [head + e for e in layer_ends(_native.units(payload))]))
        start += g["frames"]
    return index


def _sound(stream: Stream, g: dict, start: int, config: dict) -> tuple | None:
    """Media time, samples and bytes of the sound of a group that now begins at frame `start`; None: no sound."""
    if "audio" not in config or "audio" not in g:
        return None
    offset, time, samples = g["audio"]
    (n, d), rate = config["fps"], config["audio"]["timescale"]
    time += round(Fraction((start - g["start_frame"]) * d * rate, n))
    return max(time, 0), samples, stream.bytes_at(offset, sum(size for size, _ in samples))
