"""bench/results/train.json -> quality of training against its time and its size, by recipe and preset."""

from __future__ import annotations

from collections.abc import Sequence

from ..machine import stamp

LOOK = {  # recipe -> name, colour
    "model": ("gscodec, before coding", "#8fb4e3"),
    "gscodec": ("gscodec", "#1f5fb4"),
    "alone": ("every frame alone", "#e0a96d"),
    "alone-coded": ("every frame alone, coded", "#c76f14"),
    "full": ("every frame alone, in full", "#5a9a4a"),
    "v3": ("V3's recipe", "#9a9a9a"),
    "v3-coded": ("V3's recipe and packing", "#555555"),
}
BUSY_MOST = 0.5  # largest number of cores that other work kept busy while a drawn time was measured
SPAN_X, SPAN_Y = 1.6, 0.25  # margin around the points: a factor, dB
PANELS = {"seconds_per_frame": "training, seconds a frame", "kb_per_frame": "kB a frame"}


def train_chart(result: dict):
    """A row for each capture, a panel for time and one for size (matplotlib)."""
    from matplotlib.figure import Figure

    shown = [e for e in result["entries"] if e["frames"][0] == 0]  # others are runs of a few frames for flicker
    captures = list(dict.fromkeys(e["capture"] for e in shown))
    figure = Figure(figsize=(10, 3.4 * len(captures)), layout="constrained")
    for row, capture in zip(figure.subplots(len(captures), 2, squeeze=False), captures, strict=True):
        entries = [e for e in shown if e["capture"] == capture]
        for axes, (key, label) in zip(row, PANELS.items(), strict=True):
            axes.set(xlabel=label, ylabel="PSNR of the subject, dB", xscale="log")
            timed = key == "seconds_per_frame"
            placed = [e for e in entries if e[key] and not (timed and _time_says_nothing(e))]
            _panel(axes, placed, key)
            for full in [e for e in entries if e["recipe"] == "full" and e not in placed]:  # the line to reach
                axes.axhline(full["psnr_fg"], color=LOOK["full"][1], linestyle="--", label=LOOK["full"][0])
                axes.set_ylim(top=max(axes.get_ylim()[1], full["psnr_fg"] + SPAN_Y))
                axes.legend(frameon=False, fontsize=7)
        row[0].set_title(capture, loc="left", weight="bold")
    figure.supxlabel(f"test cameras; {stamp(result['entries'])}", fontsize=7, color="#888888")
    return figure


def _time_says_nothing(entry: dict) -> bool:
    """Whether its time belongs to another quality of the same training, or other work ran beside it."""
    return bool(entry["quality"]) or entry.get("measured", {}).get("busy_beside", 0.0) > BUSY_MOST


def _name(entry: dict) -> str:
    return entry["preset"] if entry["quality"] is None else f"{entry['preset']}, quality {entry['quality']:g}"


def _panel(axes, entries: Sequence[dict], key: str) -> None:
    from matplotlib.ticker import LogLocator

    for recipe, (name, color) in LOOK.items():
        points = sorted((e[key], e["psnr_fg"], _name(e)) for e in entries if e["recipe"] == recipe)
        if not points:
            continue
        x, y, presets = zip(*points, strict=True)
        ours = recipe == "gscodec"
        axes.plot(x, y, marker="o", color=color, label=name, linewidth=2.4 if ours else 1.2, zorder=3 if ours else 2)
        if recipe == "full":  # it has no preset
            continue
        for at, preset in zip(zip(x, y, strict=True), presets, strict=True):
            axes.annotate(preset, at, (4, -9), textcoords="offset points", fontsize=7, color=color)
    axes.grid(alpha=0.25)
    axes.margins(0.14)
    if entries:  # at least this span, so that equal results look equal
        x, y = ([e[k] for e in entries] for k in (key, "psnr_fg"))
        axes.set_xlim(min(x) / SPAN_X, max(x) * SPAN_X)
        axes.set_ylim(min(y) - SPAN_Y, max(y) + SPAN_Y)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    if axes.has_data():
        axes.legend(frameon=False, fontsize=7)
