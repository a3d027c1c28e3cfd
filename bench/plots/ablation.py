"""bench/results/ablation.json -> change of PSNR, size and flicker where training lacks one of its losses or tools."""

from __future__ import annotations

import math
import re

from ..machine import stamp

WHOLE = "whole recipe"
MORE_SEEDS = re.compile(r"seed ([2-9]|\d\d)$")  # one seed is enough to show the effect of chance
PANELS = {"psnr_coded": "PSNR decoded, dB", "kb_per_frame": "kB a frame", "flicker": "flicker"}
LESS, MORE = "#1f5fb4", "#c76f14"


def ablation_chart(result: dict):
    """A row per capture, bars of the difference from the whole recipe (matplotlib)."""
    from matplotlib.figure import Figure

    found = [e for e in result["entries"] if not MORE_SEEDS.search(e["variant"])]
    captures = list(dict.fromkeys(e["capture"] for e in found))
    heights = [0.24 * sum(e["capture"] == c for e in found) + 0.8 for c in captures]
    figure = Figure(figsize=(11, sum(heights)), layout="constrained")
    rows = figure.subplots(len(captures), 3, squeeze=False, height_ratios=heights)
    for row, capture in zip(rows, captures, strict=True):
        entries = {e["variant"]: e for e in found if e["capture"] == capture}
        whole = entries.pop(WHOLE)
        for axes, (key, label) in zip(row, PANELS.items(), strict=True):
            at = whole[key]  # None: no pixel stands still, so that none flickers
            change = [math.nan if None in (at, e[key]) else e[key] - at for e in entries.values()]
            colors = [LESS if c < 0 else MORE for c in change]
            axes.barh(list(entries), change, color=colors, height=0.7)
            axes.axvline(0, color="#444444", linewidth=0.8)
            axes.invert_yaxis()
            axes.grid(axis="x", alpha=0.25)
            axes.set(xlabel=f"{label}, less {math.nan if at is None else at:.2f} of the whole recipe")
            axes.tick_params(axis="y", length=0, labelleft=key == "psnr_coded")
        row[0].set_title(f"{capture}, {whole['frames']} frames, {whole['preset']}", loc="left", weight="bold")
    figure.supxlabel(f"test cameras; {stamp(result['entries'])}", fontsize=7, color="#888888")
    return figure
