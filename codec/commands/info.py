"""`gscodec info`: content of a stream as lines or JSON, its attribute maps as images; of splats what they are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from .inputs import open_stream_warning
from .options import Json, StreamPath, stdout

SPLATS = (".ply", ".sog", ".drc", ".spz", ".splat", ".splatv", ".zip")


def info(
    stream: StreamPath,
    as_json: Json = False,
    maps: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the attribute maps as 16-bit images.")] = None,
) -> None:
    """What is in a file: groups, bits by attribute and unit; of splats their format, frames and Gaussians."""
    from ..decode.report import describe, write_maps

    if stream.is_dir() or stream.suffix.lower() in SPLATS:
        _splats(stream, as_json)
        return
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


def _splats(path: Path, as_json: bool) -> None:
    from ..splats import detect_input
    from ..splats.describe import describe_splats

    if detect_input(path) != "splats":
        raise UsageError(f"{path} is a capture; info tells of streams and of splats, gscodec encode takes captures")
    facts = describe_splats(path)
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    stdout.print(
        f"{path}: {facts['format']}, {facts['frames']} frames at {facts['fps']:g} fps ({facts['mode']}), "
        f"{facts['gaussians']} Gaussians, SH degree {facts['sh_degree']}, {facts['bytes']} bytes"
    )
