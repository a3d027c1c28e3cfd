"""External programs that a baseline calls."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

from gscodec.errors import UsageError


def run_tool(name: str, variable: str, needed: str, arguments: Iterable[str | Path]) -> None:
    """Runs the program `name` of the PATH, or the one that the environment variable names.

    Args:
        needed: start of the error message: the baseline that needs the program, and the program's source.

    Raises:
        UsageError: it is not installed, or it failed.
    """
    command = shutil.which(os.environ.get(variable, name))
    if not command:
        raise UsageError(f"{needed}, or name it in {variable}")
    done = subprocess.run([command, *arguments], capture_output=True, text=True)
    if done.returncode:
        raise UsageError(f"{name} failed: {(done.stderr or done.stdout).strip()[-500:]}")
