"""`gscodec masks`: masks of a capture that has none, as files that its reader finds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from ..progress import Bar
from .options import stdout


def masks(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture (folder or calibration file).")],
    plate: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Pictures without the subject, CAMERA.png each.", show_default="plate/"),
    ] = None,
    moving: Annotated[bool, typer.Option("--moving", help="Moving objects are the subject, even with plate/.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace masks that are there.")] = False,
) -> None:
    """Masks for a capture without masks: from an empty plate, or of moving objects."""
    from ..capture import open_capture
    from ..capture.detect import capture_folder
    from ..capture.masks import make_masks

    if plate and moving:
        raise UsageError(f"--moving and --plate {plate} exclude each other: leave one of them away")
    opened = open_capture(capture)
    beside = capture_folder(capture) / "plate"
    plates = plate or (beside if beside.is_dir() and not moving else None)
    with Bar() as bar:
        count = make_masks(opened, plates, overwrite=overwrite, on_progress=lambda d, n: bar.update("cameras", d, n))
    where = opened.footage[0].mask_files[0]
    stdout.print(f"{count} masks from {'plates' if plates else 'moving objects'}, the first one is {where}")
