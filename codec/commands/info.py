"""`gscodec info`: content of a file as lines or JSON, and a picture of its attribute maps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .inputs import open_stream_warning
from .options import Json, StreamPath, stdout


def info(
    stream: StreamPath,
    as_json: Json = False,
    maps: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Draw the attribute maps of the first group with their tiles."),
    ] = None,
) -> None:
    """What is in a file: groups, bits by attribute and unit."""
    from ..decode.maps import draw_maps
    from ..decode.report import describe

    if maps and maps.suffix != ".png":
        raise UsageError(
            f"--maps {maps}: the picture must be named *.png; `gscodec decode --maps DIR` writes the planes"
        )
    s = open_stream_warning(stream)
    facts = describe(s)
    if maps and not s.groups:
        raise UsageError(f"{stream}: no groups, so there are no maps to draw")
    rows = draw_maps(s, maps) if maps else []
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    stdout.print(
        f"{stream}: {facts['frames']} frames at {facts['fps']:g} fps in {facts['groups']} groups, "
        f"{facts['gaussians']} Gaussians, SH degree {facts['sh_degree']}, level {facts['level']}"
    )
    per_gaussian = facts["bits_per_gaussian_frame"]  # None where all frames are empty
    if facts["frames"]:
        stdout.print(
            f"{facts['bytes']} bytes, {facts['kb_per_frame']:.2f} kB/frame, {facts['mbit_per_s']:.2f} Mbit/s"
            + ("" if per_gaussian is None else f", {per_gaussian:.3f} bits per Gaussian and frame")
        )
    if rows:
        stdout.print(f"{maps}: from the top " + ", ".join(rows))
    if len(facts["layers"]) > 1:
        stdout.print("bytes of the layers: " + ", ".join(str(layer["bytes"]) for layer in facts["layers"]))
    for name, u in facts["units"].items():
        stdout.print(
            f"  {name:<32}{u['bytes']:>10} bytes {u['share']:>6.1%} {u['bits_per_gaussian']:>8.2f} bits/Gaussian/group"
        )
