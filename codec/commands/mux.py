"""`gscodec mux`: streams -> one file in which each is a track."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .inputs import open_tracks, scene_output
from .options import stdout
from .tracks import Tracks, checked_name, place


def mux(
    inputs: Annotated[list[str], typer.Argument(metavar="[NAME=]FILE.gsv...", help="Streams, or scenes of several.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="OUT.gsv", help="The scene to write.")],
    track: Tracks = None,
) -> None:
    """Streams to one scene: each is a track with a name, and a place and a time of its own. Nothing is coded anew."""
    from ..decode import Scene
    from ..decode.scene import Track
    from ..encode.tracks import TrackPlan, write_tracks

    scene_output(out)
    tracks = []
    for text in inputs:
        name, _, file = ("", "", text) if Path(text).exists() else text.rpartition("=")
        opened = open_tracks(Path(file))
        if name and len(opened.tracks) > 1:
            raise UsageError(
                f"{text}: the file has {len(opened.tracks)} tracks, expected one for the name {name!r}; --track "
                f"OLD:name=NEW names them"
            )
        for t in opened.tracks:
            own = checked_name(name) if name else t.placement.name or Path(file).stem
            tracks.append(Track(t.stream, replace(t.placement, name=own)))
    scene = place(Scene(tracks, str(out)), track)
    names = [t.placement.name for t in scene.tracks]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"two tracks are named {name!r}; name them: gscodec mux left=a.gsv right=b.gsv -o c.gsv")
    plans = [TrackPlan.of(t) for t in scene.tracks]
    for plan in plans[1:]:
        name, up = plan.placement.name, plan.config["up"]
        if up != plans[0].config["up"]:
            stdout.print(
                f"up is {up} in {name} and {plans[0].config['up']} in the scene; --track {name}:turn=X,Y,Z turns it"
            )
        if plan.has_sound:
            stdout.print(f"a scene has the sound of its first track; that of {name} is left out")
    size = write_tracks(out, plans)
    stdout.print(f"{out}: {', '.join(names)}; {scene.frame_count} frames, {size} bytes")
