"""bench/results/rd.json -> charts of size, time and single frames against quality; each line has its codec's name."""

from __future__ import annotations

from collections.abc import Sequence

from gscodec.metrics import rising

from ..machine import stamp

OURS = "gscodec"
LOOK = {  # codec -> (name on the chart, colour)
    OURS: ("gscodec", "#c8102e"),
    "videogs": ("VideoGS packing, x264", "#1f5fa8"),
    "videogs-raw": ("VideoGS, raw attributes", "#6fa3d8"),
    "x265": ("MPEG-style anchor, x265", "#2e7d4f"),
    "svt-av1": ("same packing, SVT-AV1", "#8fbf9f"),
    "gsav": ("GSAV-like, VP9 lossless", "#8a5a00"),
    "webp": ("WebP of all frames", "#c49a00"),
    "zstd": ("zstd of planes", "#7a7a7a"),
    "draco": ("Draco each frame", "#7d4f9e"),
    "gpcc": ("G-PCC each frame", "#d0679b"),
    "sog": ("SOG each frame", "#111111"),
    "spz": ("SPZ each frame", "#b07aa1"),
}
SEQUENCES = {
    "statue": "Statue, 20 frames, 101,275 Gaussians",
    "lumberjack": "Trained lumberjack, 30 frames",
    "statue-0": "statue (SH 0)",
    "playbot": "playbot (SH 2)",
    "fruit": "fruit (SH 3)",
}
SAVED_AGAINST = {"zstd": "zstd", "x265": "x265"}  # the strongest peer, and the anchor of MPEG
PSNR_MIN = 35  # dB, the lowest quality shown
LABEL_GAP = 0.062  # between two names, in heights of the axes


def size_chart(result: dict):
    """kB per frame against codec PSNR, a panel per sequence (matplotlib)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2), ("statue", "lumberjack"), strict=True):
        curves = _curves(result["entries"], name, "kb_per_frame")
        swapped = {c: [(kb, psnr) for psnr, kb in points] for c, points in curves.items()}
        sizes, tops = zip(*(p for points in swapped.values() for p in points), strict=True)
        axes.set(xlabel="kB a frame", ylabel="codec PSNR, dB", xscale="log")
        axes.set(xlim=_limits(sizes), ylim=(PSNR_MIN, max(tops) + 1))
        _plain_ticks(axes.xaxis, (2, 5, 10, 20, 50, 100, 200, 500, 1000))
        _lines(axes, swapped, end_by=1)
        axes.set_title(f"{SEQUENCES[name]}\n{_saving(result, name)}", loc="left", fontsize=9.5)
    figure.suptitle("Size against quality: up and to the left is better", x=0.01, ha="left", fontsize=11, weight="bold")
    _footer(figure, result)
    return figure


def time_chart(result: dict):
    """Seconds to encode and ms to decode a frame against codec PSNR, on the statue (matplotlib)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 4.6), layout="constrained")
    panels = {
        "encode_s_per_frame": ("Encoding, seconds a frame", (0.05, 0.1, 0.2, 0.5, 1, 2, 5)),
        "decode_ms_per_frame": ("Decoding to float attributes, ms a frame", (5, 10, 20, 50, 100, 200, 500)),
    }
    for axes, (key, (title, ticks)) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        curves = _curves(result["entries"], "statue", key)
        right, values = zip(*(p for points in curves.values() for p in points), strict=True)
        axes.set(xlabel="codec PSNR, dB", yscale="log", xlim=(PSNR_MIN - 4, max(right) + 1), ylim=_limits(values))
        _plain_ticks(axes.yaxis, ticks)
        _lines(axes, curves, end_by=0)
        axes.set_title(title, loc="left", fontsize=9.5)
    heading = f"Time against quality, lower is faster ({SEQUENCES['statue']})"
    figure.suptitle(heading, x=0.01, ha="left", fontsize=11, weight="bold")
    _footer(figure, result)
    return figure


def frames_chart(result: dict):
    """Bytes of single frames, compared with SOG's and SPZ's at the same PSNR (matplotlib)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 0.8 + 0.65 * max(len(result["shares"]), 2)), layout="constrained")
    axes, shares = figure.subplots(), result["shares"]
    for i, share in enumerate(shares):
        name, color = LOOK[share["peer"]]
        _bar(axes, i - 0.2, share["peer_kb"], f" {name.split()[0]} {share['peer_kb']:.0f} kB", color, alpha=0.55)
        own, label = share["kb"], f" {OURS} does not reach this quality"
        if own is not None:
            label = f" {OURS} {own:.0f} kB, {100 * own / share['peer_kb']:.0f} %"
        _bar(axes, i + 0.2, own or 0, label, LOOK[OURS][1], text={"color": LOOK[OURS][1], "weight": "bold"})
    axes.set_yticks(range(len(shares)), [f"{SEQUENCES[s['sequence']]}\nat {s['psnr']:.1f} dB" for s in shares])
    axes.invert_yaxis()
    axes.set(xlabel="kB", xlim=(0, 1.25 * max((s["peer_kb"] for s in shares), default=1)))
    axes.set_title("Single frames at the same codec PSNR", loc="left", fontsize=11, weight="bold")
    _footer(figure, result)
    return figure


def _bar(axes, y: float, size: float, label: str, color: str, *, alpha: float = 1.0, text: dict | None = None) -> None:
    axes.barh(y, size, 0.38, color=color, alpha=alpha)
    axes.text(size, y, label, va="center", fontsize=8, **(text or {}))


def _curves(entries: Sequence[dict], sequence: str, key: str) -> dict[str, list[tuple[float, float]]]:
    """Codec -> (PSNR, value of `key`) of the points on its Pareto front of size and quality."""
    curves = {}
    for codec in LOOK:
        of = {
            (e["kb_per_frame"], e["codec_psnr"]): e for e in entries if (e["sequence"], e["codec"]) == (sequence, codec)
        }
        points = [(e["codec_psnr"], e[key]) for e in (of[p] for p in rising(list(of)))]
        if points := [p for p in points if p[0] >= PSNR_MIN]:
            curves[codec] = points
    return curves


def _lines(axes, curves: dict[str, list[tuple[float, float]]], end_by: int) -> None:
    """Draws and names the curves: ours at its start, the others in a column beside their ends.

    Limits and scales of the axes must be set before, since the positions of the names depend on them.

    Args:
        end_by: the coordinate (0 or 1) that is greatest at the end of a curve.
    """
    ends = {}
    for codec, points in curves.items():
        ours = codec == OURS
        look = {"color": LOOK[codec][1], "linewidth": 2.6 if ours else 1.3, "markersize": 5 if ours else 3.5}
        axes.plot(*zip(*points, strict=True), marker="o", zorder=3 if ours else 2, **look)
        ends[codec] = max(points, key=lambda p: p[end_by])
    axes.grid(alpha=0.25)
    to_axes = axes.transScale + axes.transLimits
    if OURS in ends:
        name, color = LOOK[OURS]
        side = {"ha": "left" if end_by else "right", "va": "center", "fontsize": 11, "color": color, "weight": "bold"}
        start = min(curves[OURS])
        axes.annotate(name, start, (9 if end_by else -7, 0), textcoords="offset points", **side)
    height = {c: to_axes.transform(p)[1] for c, p in ends.items()}
    names = sorted((c for c in ends if c != OURS), key=height.__getitem__)
    for codec, y in zip(names, _spread([height[c] for c in names]), strict=True):
        axes.annotate(
            LOOK[codec][0],
            ends[codec],
            (1.03, y),
            textcoords="axes fraction",
            va="center",
            fontsize=8.5,
            color=LOOK[codec][1],
            arrowprops={"arrowstyle": "-", "color": "#bbbbbb", "linewidth": 0.6, "relpos": (0, 0.5)},
        )


def _spread(heights: list[float]) -> list[float]:
    """Rising heights in 0..1, moved apart to LABEL_GAP where they are closer, none above 1."""
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + LABEL_GAP)
    top = 1.0
    for i in reversed(range(len(heights))):
        heights[i] = min(heights[i], top)
        top = heights[i] - LABEL_GAP
    return heights


def _limits(values: Sequence[float]) -> tuple[float, float]:
    """Range of the values with a margin, for a logarithmic axis."""
    return 0.8 * min(values), 1.25 * max(values)


def _plain_ticks(axis, ticks: Sequence[float]) -> None:
    from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FixedFormatter([f"{t:g}" for t in ticks]))
    axis.set_minor_locator(NullLocator())


def _saving(result: dict, sequence: str) -> str:
    rates = {r["anchor"]: r["percent"] for r in result["bd_rate"] if r["sequence"] == sequence}
    known = [f"{rates[a]:.0f} % against {name}" for a, name in SAVED_AGAINST.items() if a in rates]
    return "BD-rate " + ", ".join(known) if known else ""


def _footer(figure, result: dict) -> None:
    text = f"{stamp(result['entries'])}; PSNR on every {result['settings']['psnr_every']}th frame"
    figure.supxlabel(text, x=0.995, ha="right", fontsize=7, color="#888888")
