"""`gscodec edit`: streams or scenes -> one, cut, joined and placed anew, without coding anything again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..frame_range import frame_range
from ..model.rig_file import read_rig
from .inputs import open_tracks, scene_output
from .options import stdout
from .tracks import Tracks, find, place

if TYPE_CHECKING:
    from ..decode import Scene


def edit(
    inputs: Annotated[list[Path], typer.Argument(metavar="FILE.gsv...", help="Several are joined, track by track.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT.gsv", help="The file to write.")],
    frames: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[NAME=]A:B", help="Keep frames A to B-1 of a track; several ranges follow in their order."
        ),
    ] = None,
    pose: Annotated[
        list[str] | None, typer.Option(metavar="[NAME=]RIG.npz", help="Other poses for a track that has a rig.")
    ] = None,
    drop: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Leave a track out.")] = None,
    track: Tracks = None,
) -> None:
    """Trim, join and reorder at group boundaries, rename, place, pose and drop tracks. Nothing is coded anew."""
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
        ranges.setdefault(i, []).append(frame_range(part, plans[i].frame_count))
    for i, own in ranges.items():
        plans[i] = plans[i].cut(own)
    for text in pose or ():
        i, path = _posed_track(first, text)
        plans[i] = replace(plans[i], rig=read_rig(path, plans[i].frame_count))
    dropped = {find(first.tracks, name) for name in drop or ()}
    kept = [p for i, p in enumerate(plans) if i not in dropped]
    if kept and not kept[0].config["cameras"]:  # the first track had those of all
        kept[0] = replace(kept[0], config=kept[0].config | {"cameras": first.config["cameras"]})
    size = write_tracks(out, kept)
    if kept[0].has_sound and "audio" not in kept[0].config:
        silent = ", ".join(s.name for s in scenes if "audio" not in s.config)
        why = f"there is no sound in {silent}" if silent else "the files to join have sound of different forms"
        stdout.print(f"{why}, so the file has none")
    elif 0 in dropped and plans[0].has_sound:
        stdout.print("the sound goes with the first track, which is dropped")
    stdout.print(f"{out}: {len(kept)} tracks, {size} bytes")


def _posed_track(scene: Scene, text: str) -> tuple[int, Path]:
    """Index of the track, and the file of the rig, of an option --pose.

    Raises:
        UsageError: the track is not named.
    """
    name, is_named, path = text.partition("=")
    if is_named and name in [t.placement.name for t in scene.tracks]:
        return find(scene.tracks, name), Path(path)
    if len(scene.tracks) > 1:
        raise UsageError(f"--pose {text}: {scene.name} has {len(scene.tracks)} tracks, expected NAME=RIG.npz")
    return 0, Path(text)
