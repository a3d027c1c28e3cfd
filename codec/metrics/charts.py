"""Result files (.json) -> charts as .svg and .png, by matplotlib."""

from __future__ import annotations

import json
from pathlib import Path

from ..errors import UsageError, require
from .ablation_chart import ablation_chart
from .rd_chart import frames_chart, size_chart, time_chart
from .speed_chart import speed_chart
from .train_chart import train_chart

CHARTS = {  # result file without .json -> chart -> function(result) that returns a matplotlib Figure
    "ablation": {"ablation": ablation_chart},
    "raster": {"raster": speed_chart},
    "rd": {"rd_size": size_chart, "rd_time": time_chart, "rd_frames": frames_chart},
    "train": {"train": train_chart},
}
STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}


def draw_charts(results: Path, charts: Path) -> list[Path]:
    """Draws the charts of the results in a folder; returns the files written.

    Raises:
        UsageError: no result has a chart, or matplotlib is not installed.
    """
    require("matplotlib", "drawing charts", "charts")
    from matplotlib import rc_context

    found = [p for p in sorted(Path(results).glob("*.json")) if p.stem in CHARTS]
    if not found:
        names = ", ".join(f"{n}.json" for n in CHARTS)
        raise UsageError(f"{results}: no results that have a chart, expected one of {names}")
    Path(charts).mkdir(parents=True, exist_ok=True)
    written = []
    for path in found:
        result = json.loads(path.read_text())
        for name, draw in CHARTS[path.stem].items():
            # with a fixed salt and no date the same results give the same bytes
            with rc_context({"svg.hashsalt": name, "svg.fonttype": "none", **STYLE}):
                figure = draw(result)
                for suffix, options in ((".svg", {"metadata": {"Date": None}}), (".png", {"dpi": 110})):
                    written.append(Path(charts) / (name + suffix))
                    figure.savefig(written[-1], bbox_inches="tight", **options)
    return written
