"""`gscodec bench`: measurements of bench/, a line for each entry as it comes, or JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError, require
from .checkout import require_bench
from .options import PRESET, Json, Preset, Quality, stdout

Data = Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with captures and splats.")]
Captures = Annotated[Path | None, typer.Option(envvar="GSCODEC_DATA", help="Folder with the captures.")]
Results = Annotated[Path, typer.Option(help="The result file; its other entries stay.")]

bench = typer.Typer(help="Measurements, as JSON that charts are drawn from.", no_args_is_help=True)


@bench.command()
def raster(
    scenes: Annotated[str | None, typer.Option(help="Comma-separated: capsule, statue, playbot, lumberjack.")] = None,
    simd: Annotated[str | None, typer.Option(help="Comma-separated instruction sets.")] = None,
    threads: Annotated[str | None, typer.Option(help="Comma-separated numbers of threads.")] = None,
    repeats: Annotated[int, typer.Option(help="Runs of which the median counts.")] = 15,
    data: Data = None,
    work: Annotated[Path, typer.Option(help="Where the trained lumberjack is made and kept.")] = Path("build/bench"),
    out: Annotated[Path | None, typer.Option(help="Also write machine, commit, settings and entries here.")] = None,
    as_json: Json = False,
) -> None:
    """Speed of the rasterizer and of a training step, by scene, size, instruction set and threads."""
    require_bench()
    require("torch", "measuring training steps")
    from bench.raster import SCENES, run

    from ..render.workspace import simd_levels

    numbers = _names("--threads", threads, [str(n) for n in range(1, 257)])
    entries = run(
        scenes=_names("--scenes", scenes, SCENES) or SCENES,
        simd=_names("--simd", simd, simd_levels()),
        threads=[int(n) for n in numbers] if numbers else None,
        repeats=repeats,
        data=data,
        work=work,
        out=out,
        say=_say,
    )

    def line(e: dict) -> str:
        return (
            f"{e['scene']:<11}{e['gaussians']:>8} {e['width']:>4}x{e['height']:<5}{e['simd']:>8} x{e['threads']:<3}"
            f"project {e['project_ms']:8.2f}  forward {e['forward_ms']:8.2f}  backward {e['backward_ms']:8.2f}  "
            f"step {e['step_ms']:8.2f} ms"
        )

    _show_entries(entries, as_json, line)


@bench.command()
def rd(
    codec: Annotated[str | None, typer.Option(help="Comma-separated codecs, gscodec is ours.")] = None,
    sequence: Annotated[str | None, typer.Option(help="Comma-separated sequences.")] = None,
    data: Data = None,
    work: Annotated[Path, typer.Option(help="Where sequences are made and kept.")] = Path("build/bench"),
    out: Results = Path("bench/results/rd.json"),
    as_json: Json = False,
) -> None:
    """Size against quality of gscodec and its peers, with BD-rates."""
    require_bench()
    from bench.rd import CODECS, run
    from bench.sequences import SEQUENCES

    folder = _needed("rd", data)
    sequences = _names("--sequence", sequence, SEQUENCES) or SEQUENCES
    entries = run(sequences, _names("--codec", codec, CODECS) or CODECS, folder, work, out, say=_say)

    def line(e: dict) -> str:
        return (
            f"{e['sequence']:<11}{e['codec']:<12}{e['setting']:<12}{e['kb_per_frame']:9.2f} kB/frame  "
            f"{e['codec_psnr']:6.2f} dB  encode {e['encode_s_per_frame']:7.3f} s  "
            f"decode {e['decode_ms_per_frame']:7.1f} ms a frame"
        )

    _show_entries(entries, as_json, line)
    if as_json:
        return
    for r in json.loads(out.read_text())["bd_rate"] if out.exists() else []:
        span = "{:.1f} to {:.1f} dB".format(*r["psnr"])
        stdout.print(f"{r['sequence']:<11}BD-rate against {r['anchor']:<12}{r['percent']:7.1f} %, {span}")


@bench.command()
def train(
    capture: Annotated[str | None, typer.Option(help="Comma-separated cases, see bench/train.py.")] = None,
    recipe: Annotated[str | None, typer.Option(help="Comma-separated: gscodec, alone (every frame), full, v3.")] = None,
    preset: Preset = PRESET,
    frames: Annotated[str | None, typer.Option(metavar="A:B:STEP", help="Only these frames.")] = None,
    quality: Quality = None,
    also: Annotated[str | None, typer.Option(help="Comma-separated qualities at which ours is coded, too.")] = None,
    data: Captures = None,
    out: Results = Path("bench/results/train.json"),
    as_json: Json = False,
) -> None:
    """Quality against time and size of training, ours and every frame alone."""
    require_bench()
    require("torch", "measuring training")
    from bench.train import CASES, RECIPES, Run, run

    folder = _needed("train", data)
    captures = _names("--capture", capture, CASES) or CASES
    recipes = _names("--recipe", recipe, RECIPES) or RECIPES
    try:
        others = tuple(map(float, also.split(","))) if also else ()
    except ValueError:
        raise UsageError(f"--also {also}: expected qualities of 0 to 100, such as 46,52") from None
    runs = [Run(c, r, preset, frames, quality, others) for c in captures for r in recipes]

    def line(e: dict) -> str:
        size = "-" if e["kb_per_frame"] is None else f"{e['kb_per_frame']:.2f} kB/frame"
        return (
            f"{e['capture']:<17}{e['recipe']:<12}{e['preset']:<7}{e['seconds_per_frame']:7.2f} s/frame  "
            f"{e['psnr_fg'] or e['psnr']:6.2f} dB  {e['gaussians']:>6} Gaussians  {size}"
        )

    _show_entries(run(runs, folder, out), as_json, line)


@bench.command()
def ablation(
    capture: Annotated[
        str, typer.Option(help="Comma-separated: lumberjack (bundled), stage, basketball, fast motion, 4 cameras.")
    ] = "lumberjack",
    variant: Annotated[str | None, typer.Option(help="Comma-separated variants, see bench/ablation.py.")] = None,
    preset: Preset = "fast",
    quality: Quality = 50.0,
    data: Captures = None,
    out: Results = Path("bench/results/ablation.json"),
    as_json: Json = False,
) -> None:
    """Training without one of its losses and tools at a time."""
    require_bench()
    require("torch", "measuring training")
    from bench.ablation import FRAMES, VARIANTS, run

    variants = _names("--variant", variant, VARIANTS)
    captures = _names("--capture", capture, FRAMES) or []

    def line(e: dict) -> str:
        return (
            f"{e['capture']:<11}{e['variant']:<30}{e['preset']:<7}{e['psnr']:6.2f} dB, coded {e['psnr_coded']:6.2f}  "
            f"{e['kb_per_frame']:6.2f} kB/frame  {e['seconds_per_frame']:6.2f} s/frame"
        )

    _show_entries(run(captures, variants, preset, quality, data, out), as_json, line)


@bench.command()
def stress(
    case: Annotated[str | None, typer.Option(help="Comma-separated cases, see bench/stress_scenes.py.")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames of each case, at most.", show_default="all")] = None,
    out: Results = Path("bench/results/stress.json"),
    as_json: Json = False,
) -> None:
    """Training on small captures that break 4D methods; fails if one is worse than its floor in bench/stress.py."""
    require_bench()
    require("torch", "measuring training")
    from bench.stress import measure
    from bench.stress_scenes import CASES

    def line(e: dict) -> str:
        if "psnr_fg" not in e or e["psnr_fg"] is None:
            return f"{e['case']:<24}{e['verdict']}"
        return (
            f"{e['case']:<24}{e['psnr_fg']:6.2f} dB, alone {e['psnr_fg_alone']:6.2f}, worst frame "
            f"{e['psnr_fg_worst']:6.2f}  {e['gaussians']:>5} Gaussians  "
            f"{e['kb_per_frame']:6.2f} kB/frame, alone {e['kb_per_frame_alone']:6.2f}  {e['verdict']}"
        )

    entries = measure(_names("--case", case, CASES) or list(CASES), out, frames)
    if any(e["verdict"].startswith("fails") for e in _show_entries(entries, as_json, line)):
        raise typer.Exit(1)


def _names(option: str, text: str | None, known: Collection[str]) -> list[str] | None:
    """ "a,b" -> ["a", "b"], all of them known; None stays None."""
    names = text.split(",") if text else None
    for name in names or []:
        if name not in known:
            raise UsageError(f"{option} {name} is not known here, expected some of {', '.join(known)}")
    return names


def _needed(command: str, data: Path | None) -> Path:
    if data is None:
        raise UsageError(f"bench {command} needs the data folder, set --data or GSCODEC_DATA")
    return data


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _show_entries(entries: Iterable[dict], as_json: bool, line: Callable[[dict], str]) -> list[dict]:
    """Prints measurements, a line for each as it comes, or the JSON of all, and returns them."""
    found = []
    for e in entries:
        found.append(e)
        if not as_json:
            stdout.print(line(e))
    if as_json:
        print(json.dumps(found, indent=1))
    return found
