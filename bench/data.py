"""The data folder, named by GSCODEC_DATA: captures and splats that are too large for the repository."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from gscodec.errors import UsageError


def data_folder() -> Path:
    """The data folder; ends the script with an error message if GSCODEC_DATA is not set."""
    if not os.environ.get("GSCODEC_DATA"):
        sys.exit("error: GSCODEC_DATA is not set, expected the folder with the captures and splats")
    return Path(os.environ["GSCODEC_DATA"])


def existing(path: Path) -> Path:
    """Returns a path of the data folder.

    Raises:
        UsageError: it does not exist.
    """
    if not path.exists():
        raise UsageError(f"{path} is not there; the data folder (GSCODEC_DATA) must have it")
    return path
