"""`gscodec chart`: results of the benchmarks -> charts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .checkout import require_bench
from .options import stdout


def chart(
    results: Annotated[Path, typer.Argument(help="Folder of results.")] = Path("bench/results"),
    charts: Annotated[Path, typer.Argument(help="Folder for the charts.")] = Path("bench/charts"),
) -> None:
    """Charts (.svg and .png) of all results that have one."""
    require_bench()
    from bench.plots.charts import draw_charts

    for path in draw_charts(results, charts):
        stdout.print(str(path))
