"""`gscodec info`: content of a file as lines or JSON, and its attribute maps as images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from .inputs import open_stream_warning
from .options import Json, StreamPath, stdout


def info(
    stream: StreamPath,
    as_json: Json = False,
    maps: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the attribute maps as 16-bit images.")] = None,
) -> None:
    """What is in a file: groups, bits by attribute and unit."""
    from ..decode.report import describe, write_maps

    s = open_stream_warning(stream)
    facts = describe(s)
    if maps:
        write_maps(s, maps)
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
    if len(facts["layers"]) > 1:
        stdout.print("bytes of the layers: " + ", ".join(str(layer["bytes"]) for layer in facts["layers"]))
    for name, u in facts["units"].items():
        stdout.print(
            f"  {name:<32}{u['bytes']:>10} bytes {u['share']:>6.1%} {u['bits_per_gaussian']:>8.2f} bits/Gaussian/group"
        )
