"""PlayCanvas' splat-transform, the reference writer of .sog and .spz: frames -> one file each.

It is on the PATH or named by the environment variable SPLAT_TRANSFORM; `npm i -g @playcanvas/splat-transform@3`
installs it. Its times contain the start of node and the reading of a .ply.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from gscodec.model.gaussians import Gaussians
from gscodec.splats import write_splat

from .tool import run_tool

NEEDED = "the SOG and SPZ baselines need splat-transform; npm i -g @playcanvas/splat-transform@3"


def convert(frames: Sequence[Gaussians], ending: str, *options: str) -> dict[str, bytes]:
    """Each frame as a file of the format of `ending`, e.g. ".sog"."""
    files = {}
    with tempfile.TemporaryDirectory() as folder:
        for t, frame in enumerate(frames):
            write_splat(ply := Path(folder, f"{t}.ply"), frame)
            out = Path(folder, f"{t}{ending}")
            run_tool("splat-transform", "SPLAT_TRANSFORM", NEEDED, ["-q", *options, ply, out])
            files[out.name] = out.read_bytes()
    return files
