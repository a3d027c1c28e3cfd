"""bench/results/raster.json -> time of the rasterizer against Gaussians, pixels and cores."""

from __future__ import annotations

PASSES = {
    "project_ms": "project, sort, bin",
    "forward_ms": "forward",
    "backward_ms": "backward",
    "step_ms": "training step",
}


def speed_chart(result: dict):
    """A figure of three panels (matplotlib)."""
    from matplotlib.figure import Figure

    entries = [e for e in result["entries"] if e["scene"] == "capsule"]
    best, most = result["settings"]["simd"][0], max(e["threads"] for e in entries)
    fast = [e for e in entries if e["simd"] == best and e["threads"] == most]
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    by_count, by_pixels, by_cores = figure.subplots(1, 3)
    square = [e for e in fast if (e["width"], e["height"]) == (1024, 1024)]
    _lines(by_count, _usual(square), lambda e: e["gaussians"], "Gaussians (1024 x 1024)")
    hundred = [e for e in fast if e["gaussians"] == 100_000]
    _lines(by_pixels, hundred, lambda e: e["width"] * e["height"] / 1e6, "megapixels (100,000 Gaussians)")
    by_pixels.legend(frameon=False, loc="upper left")
    _bars(by_cores, entries)
    machine = result["machine"]
    figure.suptitle(
        f"Capsule, {machine['cpu']}, {machine['cores']} cores, {best}; commit {result['commit']}", fontsize=9
    )
    return figure


def _usual(entries: list[dict]) -> list[dict]:
    """The entries whose covered share of the image is that of the entry with 100,000 Gaussians."""
    share = next((e["covered"] for e in entries if e["gaussians"] == 100_000), None)
    return [e for e in entries if share is None or abs(e["covered"] - share) < 0.25 * share]


def _lines(axes, entries: list[dict], x, label: str) -> None:
    entries = sorted(entries, key=x)
    for key, name in PASSES.items():
        axes.loglog([x(e) for e in entries], [e[key] for e in entries], marker="o", markersize=3, label=name)
    axes.set(xlabel=label, ylabel="ms")
    axes.xaxis.set_minor_formatter("")
    ticks = sorted({x(e) for e in entries})
    axes.set_xticks(ticks, [f"{t:,.3g}" if t < 1000 else f"{t:,.0f}" for t in ticks], rotation=30, ha="right")
    axes.grid(alpha=0.3)


def _bars(axes, entries: list[dict]) -> None:
    """50,000 Gaussians at 512 x 512: project + forward + backward by instruction set and threads."""
    chosen = [e for e in entries if (e["gaussians"], e["width"]) == (50_000, 512)]
    levels = list(dict.fromkeys(e["simd"] for e in chosen))
    counts = sorted({e["threads"] for e in chosen})
    for i, count in enumerate(counts):
        total = {
            e["simd"]: e["project_ms"] + e["forward_ms"] + e["backward_ms"] for e in chosen if e["threads"] == count
        }
        places = [levels.index(s) + (i - (len(counts) - 1) / 2) * 0.4 for s in total]
        bars = axes.bar(places, list(total.values()), 0.38, label=f"{count} thread{'s' if count > 1 else ''}")
        axes.bar_label(bars, fmt="%.3g", fontsize=8)
    axes.set_xticks(range(len(levels)), levels)
    axes.set(
        yscale="log", ylim=(1, None), ylabel="ms", xlabel="project + forward + backward, 50,000 Gaussians, 512 x 512"
    )
    axes.legend(frameon=False)
