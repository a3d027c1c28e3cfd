"""`gscodec edit`: streams or scenes -> one, cut, joined and placed anew, without coding anything again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from ..frame_range import frame_range
from .inputs import open_tracks, scene_output
from .options import stdout
from .tracks import Tracks, find, place


def edit(
    inputs: Annotated[list[Path], typer.Argument(metavar="FILE.gsv...", help="Several are joined, track by track.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT.gsv", help="The file to write.")],
    frames: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]A:B", help="Keep frames A to B-1 of a track; several ranges follow in their order."
        ),
    ] = None,
    drop: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Leave a track out.")] = None,
    track: Tracks = None,
) -> None:
    """Trim, join and reorder at group boundaries, rename, place and drop tracks. Nothing is coded anew."""
    from ..encode.tracks import TrackPlan, write_tracks

    scene_output(out)
    scenes = [open_tracks(path) for path in inputs]
    first = scenes[0]
    plans = [TrackPlan.of(t) for t in place(first, track).tracks]
    for other in scenes[1:]:
        if len(other.tracks) != len(plans):
            raise UsageError(
                f"{other.name} has {len(other.tracks)} tracks and {first.name} {len(plans)}; files to join have as many"
            )
        plans = [p.joined(TrackPlan.of(t)) for p, t in zip(plans, other.tracks, strict=True)]
    ranges: dict[int, list[range]] = {}
    for text in frames or ():
        name, _, part = text.rpartition("=")
        if not name and len(plans) > 1:
            raise UsageError(f"--frames {text}: {first.name} has {len(plans)} tracks, expected NAME=A:B")
        i = find(first.tracks, name) if name else 0
        count = sum(stream.groups[g]["frames"] for stream, g in plans[i].groups)
        ranges.setdefault(i, []).append(frame_range(part, count))
    for i, own in ranges.items():
        plans[i] = plans[i].cut(own)
    dropped = {find(first.tracks, name) for name in drop or ()}
    kept = [p for i, p in enumerate(plans) if i not in dropped]
    if kept and not kept[0].config["cameras"]:  # the first track had those of all
        kept[0] = replace(kept[0], config=kept[0].config | {"cameras": first.config["cameras"]})
    size = write_tracks(out, kept)
    if kept[0].has_sound and "audio" not in kept[0].config:
        stdout.print("the files to join have sound of different forms, which is left out")
    elif 0 in dropped and plans[0].has_sound:
        stdout.print("the sound goes with the first track, which is dropped")
    stdout.print(f"{out}: {len(kept)} tracks, {size} bytes")
