"""The command line: each command parses, calls one library function and prints.

Results go to stdout (`--json` for machines), progress to stderr. What a user can cause and mend ends as one sentence
and exit code 1 (2 for a wrong call); anything else is a bug and shows its traceback.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from . import __version__
from .errors import GscodecError, UsageError
from .frame_range import frame_range
from .model.gaussians import GOP

app = typer.Typer(
    help="Streaming volumetric video: captures and Gaussian sequences to one small playable file.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
_out = Console(soft_wrap=True, highlight=False)

Sequence = Annotated[
    Path, typer.Argument(metavar="SEQ", help="A capture (folder or transforms.json) or a splat, or a folder of splats.")
]
Stream = Annotated[Path, typer.Argument(metavar="OUT.gsv", help="A .gsv file.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Only frames A to B-1.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Gop = Annotated[int, typer.Option(help="Frames in a group at most.")]
RandomAccess = Annotated[
    int, typer.Option(metavar="N", help="Frames from one independent group to the next at most; 0: no prediction.")
]
Preset = Annotated[str, typer.Option(help="Training budget: fast, medium or slow.")]
Quality = Annotated[float, typer.Option(help="0 (small) to 100 (fine).")]


def _show_version(value: bool) -> None:
    if value:
        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def encode(
    seq: Sequence,
    out: Stream,
    quality: Quality = 50.0,
    bitrate: Annotated[
        str | None, typer.Option(metavar="RATE", help="Bits per second instead of a quality: 8M, 500k.")
    ] = None,
    preset: Preset = "medium",
    frames: Frames = None,
    gop: Gop = GOP,
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Keep Gaussians that nobody can see.")] = False,
    random_access: RandomAccess = 60,
    layers: Annotated[
        int | None,
        typer.Option(help="Layers of importance; the first ones alone are a coarser picture.", show_default="auto"),
    ] = None,
    refine: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Views to refine each group by.", show_default="4 times each picture of a capture"
        ),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Train on this Ray cluster; its machines see SEQ too.")
    ] = None,
    report: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the report there.")] = None,
) -> None:
    """Capture or Gaussian sequence to a stream. A second run resumes; Ctrl-C leaves a playable file."""
    from .commands import encode_input
    from .encode.encode import EncodeSettings
    from .progress import Bar

    with Bar() as bar:
        settings = EncodeSettings(quality, _bits(bitrate), keep_all, random_access, layers, refine)
        result = encode_input(seq, out, settings, preset=preset, frames=frames, gop=gop, cluster=ray, bar=bar)
    if report:
        report.write_text(json.dumps(result.to_json(), indent=1))
    if result.groups == 0:
        raise UsageError("stopped before the first group was done; run the same command to go on")
    r = result.to_json()
    _out.print(
        f"{out}: {r['frames']} frames, {r['gaussians']} Gaussians, {r['bytes']} bytes, "
        f"{r['kb_per_frame']:.2f} kB/frame, {r['bits_per_gaussian_frame']:.2f} bits per Gaussian and frame"
    )
    if result.interrupted:
        print("stopped early: the file holds the groups done, the same command goes on", file=sys.stderr)
        raise typer.Exit(130)


def _bits(rate: str | None) -> float | None:
    """Bits per second of "8M", "500k" or "250000"."""
    if rate is None:
        return None
    try:
        return float(rate.rstrip("kM")) * {"k": 1e3, "M": 1e6}.get(rate[-1:], 1.0)
    except ValueError:
        raise UsageError(f"--bitrate {rate}: expected bits per second, such as 8M, 500k or 250000") from None


@app.command()
def train(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="A capture (folder or transforms.json).")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    preset: Preset = "medium",
    frames: Frames = None,
    gop: Gop = GOP,
    random_access: RandomAccess = 60,
    quality: Quality = 50.0,
) -> None:
    """Capture to one .ply per frame, the first half of encode."""
    from .commands import train_to_folder
    from .progress import Bar

    with Bar() as bar:
        options = {"preset": preset, "frames": frames, "gop": gop, "random_access": random_access, "quality": quality}
        count = train_to_folder(capture, folder, **options, bar=bar)
    _out.print(f"{folder}: {count} frames")


@app.command()
def decode(
    stream: Stream,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the .ply files go.")],
    drc: Annotated[bool, typer.Option("--drc", help="Only the points, as Draco files.")] = False,
) -> None:
    """Stream to one standard 3DGS .ply per frame."""
    from .decode import open_stream
    from .splats import write_sequence, write_splat

    s = open_stream(stream)
    _warn_if_cut(s)
    if drc:
        folder.mkdir(parents=True, exist_ok=True)
        for t in range(s.frame_count):
            write_splat(folder / f"{t:06d}.drc", s.frame(t))
    else:
        write_sequence(s.sequence(), folder)
    _out.print(f"{folder}: {s.frame_count} frames")


@app.command()
def render(
    stream: Stream,
    dest: Annotated[Path, typer.Argument(metavar="DEST", help="A .mp4 file or a folder for .png images.")],
    camera: Annotated[str, typer.Option(help="orbit, the name of a reference camera, or a camera .json.")] = "orbit",
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Picture size.")] = None,
    frames: Frames = None,
) -> None:
    """Render a stream on the CPU to a video or images."""
    from .decode import open_stream
    from .progress import Bar
    from .render.movie import render_stream

    s = open_stream(stream)
    _warn_if_cut(s)
    with Bar() as bar:
        count = render_stream(s, dest, camera=camera, size=size, frames=frame_range(frames, s.frame_count), bar=bar)
    _out.print(f"{dest}: {count} frames")


@app.command()
def play(
    stream: Stream,
    port: Annotated[int, typer.Option(help="Port of the local server, 0: any free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 lets other machines watch.")] = "127.0.0.1",
) -> None:
    """Play a stream in the browser. Needs no GPU; Ctrl-C ends it."""
    from gscodec.player.play import play_stream

    play_stream(stream, host=host, port=port, browser=not no_browser, say=_out.print)


@app.command()
def info(
    stream: Stream,
    as_json: Json = False,
    maps: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the attribute maps as 16-bit images.")] = None,
) -> None:
    """What is in a file: groups, bits by attribute and unit."""
    from .decode import open_stream
    from .decode.report import describe, write_maps

    s = open_stream(stream)
    _warn_if_cut(s)
    facts = describe(s)
    if maps:
        write_maps(s, maps)
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    _out.print(
        f"{stream}: {facts['frames']} frames at {facts['fps']:g} fps in {facts['groups']} groups, "
        f"{facts['gaussians']} Gaussians, SH degree {facts['sh_degree']}, level {facts['level']}"
    )
    _out.print(
        f"{facts['bytes']} bytes, {facts['kb_per_frame']:.2f} kB/frame, {facts['mbit_per_s']:.2f} Mbit/s, "
        f"{facts['bits_per_gaussian_frame']:.3f} bits per Gaussian and frame"
    )
    if len(facts["layers"]) > 1:
        _out.print("bytes of the layers: " + ", ".join(str(layer["bytes"]) for layer in facts["layers"]))
    for name, u in facts["units"].items():
        _out.print(
            f"  {name:<32}{u['bytes']:>10} bytes {u['share']:>6.1%} {u['bits_per_gaussian']:>8.2f} bits/Gaussian/group"
        )


@app.command(name="eval")
def evaluate(
    stream: Stream,
    seq: Sequence,
    split: Annotated[str, typer.Option(help="Cameras of a capture: test or train.")] = "test",
    frames: Frames = None,
    as_json: Json = False,
) -> None:
    """PSNR, SSIM, VMAF and temporal stability against a capture or the splats that were encoded."""
    from .commands import evaluate_stream
    from .progress import Bar

    with Bar() as bar:
        result = evaluate_stream(stream, seq, split=split, frames=frames, bar=bar)
    if as_json:
        print(json.dumps(result, indent=1))
        return
    for key, value in result.items():
        if isinstance(value, float):
            _out.print(f"{key:<26}{value:.4f}")
        elif isinstance(value, int | str):
            _out.print(f"{key:<26}{value}")
    for p in result.get("prefixes", ()):
        psnr = p["codec_psnr"] if p["psnr"] is None else p["psnr"]
        _out.print(f"first {p['layers']} layers: {p['kb_per_frame']:.2f} kB/frame, {psnr:.2f} dB")


bench = typer.Typer(help="Measurements, as JSON that charts are drawn from.", no_args_is_help=True)
app.add_typer(bench, name="bench")


def _show_entries(entries: Iterable[dict], as_json: bool, line: Callable[[dict], str]) -> list[dict]:
    """Prints measurements, a line for each as it comes, or the JSON of all, and returns them."""
    found = []
    for e in entries:
        found.append(e)
        if not as_json:
            _out.print(line(e))
    if as_json:
        print(json.dumps(found, indent=1))
    return found


@bench.command("raster")
def bench_raster(
    scenes: Annotated[str | None, typer.Option(help="Comma-separated: capsule, statue, playbot, lumberjack.")] = None,
    simd: Annotated[str | None, typer.Option(help="Comma-separated instruction sets.")] = None,
    threads: Annotated[str | None, typer.Option(help="Comma-separated numbers of threads.")] = None,
    repeats: Annotated[int, typer.Option(help="Runs of which the median counts.")] = 15,
    data: Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with captures and splats.")] = None,
    work: Annotated[Path, typer.Option(help="Where the trained lumberjack is made and kept.")] = Path("build/bench"),
    out: Annotated[Path | None, typer.Option(help="Also write machine, commit, settings and entries here.")] = None,
    as_json: Json = False,
) -> None:
    """Speed of the rasterizer and of a training step, by scene, size, instruction set and threads."""
    from .commands import bench_raster as measure

    def line(e: dict) -> str:
        return (
            f"{e['scene']:<11}{e['gaussians']:>8} {e['width']:>4}x{e['height']:<5}{e['simd']:>8} x{e['threads']:<3}"
            f"project {e['project_ms']:8.2f}  forward {e['forward_ms']:8.2f}  backward {e['backward_ms']:8.2f}  "
            f"step {e['step_ms']:8.2f} ms"
        )

    _show_entries(measure(scenes, simd, threads, repeats=repeats, data=data, work=work, out=out), as_json, line)


@bench.command("rd")
def bench_rd(
    codec: Annotated[str | None, typer.Option(help="Comma-separated codecs, gscodec is ours.")] = None,
    sequence: Annotated[str | None, typer.Option(help="Comma-separated sequences.")] = None,
    data: Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with captures and splats.")] = None,
    work: Annotated[Path, typer.Option(help="Where sequences are made and kept.")] = Path("build/bench"),
    out: Annotated[Path, typer.Option(help="The result file; its other entries stay.")] = Path("bench/results/rd.json"),
    as_json: Json = False,
) -> None:
    """Size against quality of gscodec and its peers, with BD-rates."""
    from .commands import bench_rd as measure

    def line(e: dict) -> str:
        return (
            f"{e['sequence']:<11}{e['codec']:<12}{e['setting']:<12}{e['kb_per_frame']:9.2f} kB/frame  "
            f"{e['codec_psnr']:6.2f} dB  encode {e['encode_s_per_frame']:7.3f} s  "
            f"decode {e['decode_ms_per_frame']:7.1f} ms a frame"
        )

    _show_entries(measure(codec, sequence, data=data, work=work, out=out), as_json, line)
    if as_json:
        return
    for r in json.loads(out.read_text())["bd_rate"] if out.exists() else []:
        span = "{:.1f} to {:.1f} dB".format(*r["psnr"])
        _out.print(f"{r['sequence']:<11}BD-rate against {r['anchor']:<12}{r['percent']:7.1f} %, {span}")


@bench.command("train")
def bench_train(
    capture: Annotated[str | None, typer.Option(help="Comma-separated cases, see bench/train.py.")] = None,
    recipe: Annotated[str | None, typer.Option(help="Comma-separated: gscodec, alone (every frame), v3.")] = None,
    preset: Preset = "medium",
    frames: Annotated[str | None, typer.Option(metavar="A:B:STEP", help="Only these frames.")] = None,
    quality: Quality = 50.0,
    data: Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with the captures.")] = None,
    out: Annotated[Path, typer.Option(help="The result file; its other entries stay.")] = Path(
        "bench/results/train.json"
    ),
    as_json: Json = False,
) -> None:
    """Quality against time and size of training, ours and every frame alone."""
    from .commands import bench_train as measure

    def line(e: dict) -> str:
        size = "-" if e["kb_per_frame"] is None else f"{e['kb_per_frame']:.2f} kB/frame"
        return (
            f"{e['capture']:<17}{e['recipe']:<12}{e['preset']:<7}{e['seconds_per_frame']:7.2f} s/frame  "
            f"{e['psnr_fg'] or e['psnr']:6.2f} dB  {e['gaussians']:>6} Gaussians  {size}"
        )

    _show_entries(
        measure(capture, recipe, preset=preset, frames=frames, quality=quality, data=data, out=out), as_json, line
    )


@bench.command("ablation")
def bench_ablation(
    capture: Annotated[str, typer.Option(help="Comma-separated: lumberjack (bundled), stage.")] = "lumberjack",
    variant: Annotated[str | None, typer.Option(help="Comma-separated variants, see bench/ablation.py.")] = None,
    preset: Preset = "fast",
    quality: Quality = 50.0,
    data: Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with the captures.")] = None,
    out: Annotated[Path, typer.Option(help="The result file; its other entries stay.")] = Path(
        "bench/results/ablation.json"
    ),
    as_json: Json = False,
) -> None:
    """Training without one of its losses and tools at a time."""
    from .commands import bench_ablation as measure

    def line(e: dict) -> str:
        return (
            f"{e['capture']:<11}{e['variant']:<30}{e['preset']:<7}{e['psnr']:6.2f} dB, coded {e['psnr_coded']:6.2f}  "
            f"{e['kb_per_frame']:6.2f} kB/frame  {e['seconds_per_frame']:6.2f} s/frame"
        )

    _show_entries(measure(capture, variant, preset=preset, quality=quality, data=data, out=out), as_json, line)


@bench.command("stress")
def bench_stress(
    case: Annotated[str | None, typer.Option(help="Comma-separated cases, see bench/stress_scenes.py.")] = None,
    out: Annotated[Path, typer.Option(help="The result file; its other entries stay.")] = Path(
        "bench/results/stress.json"
    ),
    as_json: Json = False,
) -> None:
    """Training on small captures of what breaks 4D methods; fails if one does worse than bench/stress.py states."""
    from .commands import bench_stress as measure

    def line(e: dict) -> str:
        if "psnr_fg" not in e or e["psnr_fg"] is None:
            return f"{e['case']:<20}{e['verdict']}"
        return (
            f"{e['case']:<20}{e['psnr_fg']:6.2f} dB, alone {e['psnr_fg_alone']:6.2f}  {e['gaussians']:>5} Gaussians  "
            f"{e['kb_per_frame']:6.2f} kB/frame, alone {e['kb_per_frame_alone']:6.2f}  {e['verdict']}"
        )

    if any(e["verdict"].startswith("fails") for e in _show_entries(measure(case, out=out), as_json, line)):
        raise typer.Exit(1)


@app.command()
def chart(
    results: Annotated[Path, typer.Argument(help="Folder of results.")] = Path("bench/results"),
    charts: Annotated[Path, typer.Argument(help="Folder for the charts.")] = Path("bench/charts"),
) -> None:
    """Charts (.svg and .png) of all results that have one."""
    from .metrics.charts import draw_charts

    for path in draw_charts(results, charts):
        _out.print(str(path))


def _warn_if_cut(stream) -> None:
    if not stream.complete:
        print(
            f"warning: {stream.name} is unfinished or cut short; its {stream.frame_count} whole frames are used",
            file=sys.stderr,
        )


def _say(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"warning: {message}", file=sys.stderr)


def main() -> None:
    """Entry point of the `gscodec` command."""
    warnings.showwarning = _say
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is there; the encoder has threads
    try:
        sys.exit(app(standalone_mode=False))  # what a command returns, None, or the code of a typer.Exit
    except (typer.Abort, KeyboardInterrupt):
        print("stopped", file=sys.stderr)
        sys.exit(130)
    except GscodecError as e:
        print(f"error: {e}", file=sys.stderr)
        sys.exit(1)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        print(f"error: {where}{e.strerror or e}", file=sys.stderr)
        sys.exit(1)
    except Exception as e:
        if type(e).__module__.startswith(("click", "typer")):  # a wrong call
            show = getattr(e, "show", None)
            show() if show else print(f"error: {e}", file=sys.stderr)
            sys.exit(getattr(e, "exit_code", 2))
        raise
