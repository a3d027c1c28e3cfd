"""`gscodec info`: what is in a stream, splats or a capture, as lines or JSON; a picture of its maps or its rig."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .inputs import open_stream_warning
from .options import Json, stdout
from .tracks import Tracks

CALIBRATIONS = (".json", ".txt", ".npy", ".csv", ".yml", ".bin")
SPLATS = (".ply", ".sog", ".drc", ".spz", ".splat", ".splatv", ".zip")
NOT_STREAMS = CALIBRATIONS + SPLATS


def info(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A .gsv file, splats or a capture.")],
    as_json: Json = False,
    maps: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.png", help="Of a stream: draw the attribute maps of its first group with their tiles."
        ),
    ] = None,
    sheet: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Of a capture: draw its cameras and its rig.")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Of a capture: the frame to examine.")] = 0,
    track: Tracks = None,
) -> None:
    """Contents of a file: groups, bits by attribute and unit; the format of splats; the layout of a capture."""
    if sheet and sheet.suffix.lower() != ".png":
        raise UsageError(f"--sheet {sheet}: the picture must be named *.png")
    kind = _kind(path)
    if maps and kind != "stream":
        what = {"capture": "a capture", "splats": "made of splats"}[kind]
        raise UsageError(f"--maps {maps}: {path} is {what}, expected a .gsv file; --sheet draws a capture")
    if sheet and kind != "capture":
        raise UsageError(f"--sheet {sheet}: {path} is not a capture, expected its folder or calibration file")
    if kind == "capture":
        _of_capture(path, frame, sheet, as_json)
    elif kind == "splats":
        _of_splats(path, as_json)
    else:
        _of_stream(path, maps, track, as_json)


def _kind(path: Path) -> str:
    """stream, splats or capture."""
    from ..splats import detect_input

    if path.is_dir() or path.name.lower().endswith(NOT_STREAMS):
        return detect_input(path)
    return "stream"


def _of_stream(path: Path, maps: Path | None, track: list[str] | None, as_json: bool) -> None:
    from ..decode import Scene
    from ..decode.maps import draw_maps
    from ..decode.report import describe, describe_scene

    if maps and maps.suffix != ".png":
        raise UsageError(
            f"--maps {maps}: the picture must be named *.png; `gscodec decode --maps DIR` writes the planes"
        )
    s = open_stream_warning(path, track)
    if isinstance(s, Scene):
        if maps:
            draw_maps(s.alone("--maps"), maps)
        _print_scene(path, describe_scene(s), as_json)
        return
    facts = describe(s)
    if maps and not s.groups:
        raise UsageError(f"{path}: no groups, so there are no maps to draw")
    rows = draw_maps(s, maps) if maps else []
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    stdout.print(
        f"{path}: {facts['frames']} frames at {facts['fps']:g} fps in {facts['groups']} groups, "
        f"{facts['gaussians']} Gaussians, SH degree {facts['sh_degree']}, level {facts['level']}"
    )
    per_gaussian = facts["bits_per_gaussian_frame"]  # None where all frames are empty
    if facts["frames"]:
        stdout.print(
            f"{facts['bytes']} bytes, {facts['kb_per_frame']:.2f} kB/frame, {facts['mbit_per_s']:.2f} Mbit/s"
            + ("" if per_gaussian is None else f", {per_gaussian:.3f} bits per Gaussian and frame")
        )
    if sound := facts["sound"]:
        stdout.print(
            f"sound: {sound['codec']}, {sound['rate']} Hz, {sound['channels']} channels, "
            f"{sound['seconds']:.2f} s, {sound['bytes']} bytes"
        )
    if rows:
        stdout.print(f"{maps}: from the top " + ", ".join(rows))
    if len(facts["layers"]) > 1:
        stdout.print("bytes of the layers: " + ", ".join(str(layer["bytes"]) for layer in facts["layers"]))
    for name, u in facts["units"].items():
        per_gaussian = u["bits_per_gaussian"]  # None where there are none
        per_gaussian = "" if per_gaussian is None else f" {per_gaussian:>8.2f} bits/Gaussian/group"
        stdout.print(f"  {name:<32}{u['bytes']:>10} bytes {u['share']:>6.1%}{per_gaussian}")


def _print_scene(path: Path, facts: dict, as_json: bool) -> None:
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    stdout.print(f"{path}: {len(facts['tracks'])} tracks, {facts['frames']} frames at {facts['fps']:g} fps")
    rate = "" if facts["kb_per_frame"] is None else f", {facts['kb_per_frame']:.2f} kB/frame"
    stdout.print(f"{facts['bytes']} bytes{rate}")
    for t in facts["tracks"]:
        played = {0: ", without end", 1: ""}.get(t["repeats"], f", {t['repeats']} times")
        moves = {0: "", 1: ", placed"}.get(t["keys"], f", {t['keys']} transforms")
        hidden = ", hidden" if t["hidden"] else ""
        stdout.print(
            f"  {t['name'] or '(no name)'}: {t['frames']} frames at {t['fps']:g} fps from {t['offset']:g} s"
            f"{played}{moves}{hidden}; {t['gaussians']} Gaussians, {t['bytes']} bytes"
        )


def _of_splats(path: Path, as_json: bool) -> None:
    from ..splats.describe import describe_splats

    facts = describe_splats(path)
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    stdout.print(
        f"{path}: {facts['format']}, {facts['frames']} frames at {facts['fps']:g} fps ({facts['mode']}), "
        f"{facts['gaussians']} Gaussians, SH degree {facts['sh_degree']}, {facts['bytes']} bytes"
    )


def _of_capture(path: Path, frame: int, sheet: Path | None, as_json: bool) -> None:
    from ..capture.report import describe_capture
    from ..capture.sheet import contact_sheet
    from ..render.png import write_png

    capture, facts = describe_capture(path, frame)
    if sheet:
        write_png(sheet, contact_sheet(capture, frame))
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    split = [len(capture.indices(s)) for s in ("train", "test")]
    stdout.print(
        f"{path}: {facts['layout']}, {split[0]} training and {split[1]} test cameras"
        f"{' that move' if facts['moves'] else ''}, {facts['frames']} frames at {facts['fps']:g} fps"
    )
    masks = "no masks" if facts["masks"] is None else f"masks from {facts['masks']}"
    points = "no sparse points" if facts["points"] is None else f"{facts['points']} sparse points"
    error, ratio = facts["epipolar_error"], facts["colour_ratio"]
    checked = "unknown" if error is None else f"{error:.2f} pixels from epipolar lines ({facts['matches']} matches)"
    colours = "unknown" if ratio is None else f"{ratio:.2f} from the darkest to the brightest camera"
    depth = f", depth images of {facts['depth']} cameras" if facts["depth"] else ""
    stdout.print(f"{masks}, {points}{depth}; calibration: {checked}; colours: {colours}")
    for c in facts["cameras"]:
        stdout.print(f"  {_line(c)}")
    for sentence in (*facts["left_out"], *facts["missing"]):
        stdout.print(f"! {sentence}")


def _line(c: dict) -> str:
    """Facts of one camera."""
    words = [f"{c['name']:<12}{c['split']:<6}{c['width']}x{c['height']}", f"{c['angle']:5.1f} degrees wide"]
    words.append(f"near {c['near']:g}, scene at {c['distance']:g}")
    if c["subject"] is not None:
        words.append(f"subject {c['subject']:.1%}")
    if c["depth"] is not None and c["depth"]["known"]:
        d = c["depth"]
        words.append(f"depth {d['near']:g} to {d['far']:g} in {d['known']:.0%}")
    if c["epipolar_error"] is not None:
        words.append(f"{c['epipolar_error']:.2f} pixels off")
    if c["gain"]:
        words.append("gain " + " ".join(f"{g:.2f}" for g in c["gain"]))
    return ", ".join(words)
