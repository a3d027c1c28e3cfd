"""PlayCanvas' splat-transform, the reference writer of .sog and .spz: frames -> one file each.

It is on the PATH or named by the environment variable SPLAT_TRANSFORM; `npm i -g @playcanvas/splat-transform@3`
installs it. Its times contain the start of node and the reading of a .ply.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gscodec.errors import UsageError
from gscodec.model.gaussians import Gaussians
from gscodec.splats import write_splat


def splat_transform() -> str:
    """The command.

    Raises:
        UsageError: it is not installed.
    """
    found = shutil.which(os.environ.get("SPLAT_TRANSFORM", "splat-transform"))
    if not found:
        raise UsageError(
            "the SOG and SPZ baselines need splat-transform; npm i -g @playcanvas/splat-transform@3, "
            "or name it in SPLAT_TRANSFORM"
        )
    return found


def convert(frames: Sequence[Gaussians], ending: str, *options: str) -> dict[str, bytes]:
    """Each frame as a file of the format of `ending`, e.g. ".sog"."""
    command, files = splat_transform(), {}
    with tempfile.TemporaryDirectory() as folder:
        for t, frame in enumerate(frames):
            write_splat(ply := Path(folder, f"{t}.ply"), frame)
            out = Path(folder, f"{t}{ending}")
            done = subprocess.run([command, "-q", *options, ply, out], capture_output=True, text=True)
            if done.returncode:
                raise UsageError(f"splat-transform failed: {(done.stderr or done.stdout).strip()[-500:]}")
            files[out.name] = out.read_bytes()
    return files
