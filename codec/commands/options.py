"""Arguments and options that several commands share, and the console of their results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

SequencePath = Annotated[
    Path,
    typer.Argument(metavar="SEQ", help="A capture (folder or transforms.json), or splats: file, folder, zip."),
]
StreamPath = Annotated[Path, typer.Argument(metavar="OUT.gsv", help="A .gsv file.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Only frames A to B-1.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Gop = Annotated[int, typer.Option(help="Frames in a group at most.")]
RandomAccess = Annotated[
    int, typer.Option(metavar="N", help="Frames from one independent group to the next at most; 0: no prediction.")
]
PRESET = "medium"  # the usual one
Preset = Annotated[str, typer.Option(help="Training budget: fast, medium or slow.")]
Motion = Annotated[str, typer.Option(help="Motion model: field (hash grid and MLP beside the nodes) or nodes (alone).")]
RigPath = Annotated[
    Path | None,
    typer.Option("--rig", metavar="RIG.npz", help="A skeleton whose poses predict the motion, one for each frame."),
]
Quality = Annotated[
    float | None, typer.Option(help="0 (small) to 100 (fine).", show_default="as the capture needs; 50 for splats")
]

stdout = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)  # prints names as they are
