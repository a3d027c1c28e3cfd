"""What the option --track says: "NAME:change:change ...", applied to the placements of a scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from ..decode import Scene
from ..decode.scene import Track
from ..errors import UsageError
from ..model.placement import STILL, Key, Placement
from ..model.rotations import rotvec_to_quat

CHANGES = (
    "hide, show, only, name=TEXT, move=X,Y,Z, turn=X,Y,Z (degrees), scale=S, offset=SECONDS, repeat=N, "
    "repeat=forever, transform=FILE.json or transform=none"
)
Tracks = Annotated[
    list[str] | None,
    typer.Option("--track", metavar="NAME:CHANGE[:CHANGE]", help=f"Change a track, by name or number: {CHANGES}."),
]


def place(scene: Scene, changes: Sequence[str] | None) -> Scene:
    """The scene with its tracks as the options say. Moves add to what the file tells; the rest replaces it.

    Raises:
        UsageError: there is no such track, or no such change.
    """
    if not changes:
        return scene
    tracks = list(scene.tracks)
    for text in changes:
        name, *steps = text.split(":")
        i = find(tracks, name)
        if not steps:
            raise UsageError(f"--track {text}: expected NAME:CHANGE, of the changes {CHANGES}")
        for step in steps:
            if step == "only":
                tracks = [_with(t, replace(t.placement, hidden=k != i)) for k, t in enumerate(tracks)]
            else:
                tracks[i] = _with(tracks[i], _change(tracks[i], step, text))
    return Scene(tracks, scene.name)


def find(tracks: Sequence[Track], name: str) -> int:
    """Which track has a name, or else a number from 1 on.

    Raises:
        UsageError: none has.
    """
    names = [t.placement.name for t in tracks]
    if name in names:
        return names.index(name)
    if name.isdecimal() and 1 <= int(name) <= len(names):
        return int(name) - 1
    known = ", ".join(f"{k} {own}".strip() for k, own in enumerate(names, 1))
    raise UsageError(f"there is no track {name!r}, expected one of: {known}")


def _with(track: Track, placement: Placement) -> Track:
    return Track(track.stream, placement)


def _change(track: Track, step: str, text: str) -> Placement:
    """One change of a placement."""
    p, (key, _, value), timescale = track.placement, step.partition("="), track.rate[0]
    numbers: dict[str, Callable[[], Placement]] = {
        "move": lambda: p.changed(move=_numbers(value, 3)),
        "turn": lambda: p.changed(turn=rotvec_to_quat(np.radians(_numbers(value, 3)))),
        "scale": lambda: p.changed(scale=_positive(value)),
        "offset": lambda: replace(p, offset=round(_numbers(value, 1)[0] * timescale)),
        "repeat": lambda: replace(p, repeats=0 if value == "forever" else _count(value)),
        "hide": lambda: replace(p, hidden=True),
        "show": lambda: replace(p, hidden=False),
        "name": lambda: replace(p, name=checked_name(value)),
        "transform": lambda: replace(p, keys=() if value == "none" else read_keys(Path(value), timescale)),
    }
    if key not in numbers or (key in ("hide", "show") and "=" in step):
        raise UsageError(f"--track {text}: {step!r} is no change of a track, expected {CHANGES}")
    try:
        changed = numbers[key]()
        changed.pose(0)  # checks the keys
    except (ValueError, OverflowError) as e:
        raise UsageError(f"--track {text}: {step!r}: {e}") from None
    return changed


def checked_name(name: str) -> str:
    """A name that options can say.

    Raises:
        UsageError: they cannot.
    """
    if not name or ":" in name or "=" in name or len(name.encode()) > 255:
        raise UsageError(f"track name {name!r}: expected 1 to 255 bytes without ':' and '='")
    return name


def _numbers(value: str, count: int) -> list[float]:
    found = [float(v) for v in value.split(",")]
    if len(found) != count or not np.isfinite(found).all():
        raise ValueError(f"expected {count} finite number{'s' * (count > 1)}")
    return found


def _positive(value: str) -> float:
    (found,) = _numbers(value, 1)
    if not found > 0:
        raise ValueError("expected a number above 0")
    return found


def _count(value: str) -> int:
    if not value.isdecimal() or not 1 <= int(value) < 2**32:
        raise ValueError("expected a whole number from 1 on, or forever")
    return int(value)


def read_keys(path: Path, timescale: int) -> tuple[Key, ...]:
    """A transform over time from a .json file: a list of objects with time (seconds of the scene), rotation (wxyz),
    translation and scale, of which any may be missing.

    Raises:
        UsageError: it is not such a file.
    """
    try:
        keys = []
        for k in json.loads(path.read_text()):
            if unknown := set(k) - {"time", "rotation", "translation", "scale"}:
                raise ValueError(f"unknown: {', '.join(sorted(unknown))}")
            rotation = np.array(k.get("rotation", STILL[1]), float)
            translation = tuple(float(v) for v in k.get("translation", STILL[2]))
            length = np.linalg.norm(rotation)
            if rotation.shape != (4,) or len(translation) != 3 or not length > 0:
                raise ValueError("a rotation has 4 numbers that are not all 0, a translation 3")
            turn = tuple((rotation / length).tolist())
            keys.append((round(float(k.get("time", 0)) * timescale), turn, translation, float(k.get("scale", 1))))
        return tuple(keys)
    except (OSError, ValueError, TypeError, AttributeError) as e:
        raise UsageError(
            f"{path}: expected a JSON list of objects with time (seconds), rotation (wxyz), translation and scale ({e})"
        ) from None
