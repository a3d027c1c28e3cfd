"""Benchmarks of the whole pipeline through the command line: a JSON in bench/results per case.

usage: python -m bench.run [statue] [statue40] [splatv] [demo]

All cases but `demo` need the data folder that the environment variable GSCODEC_DATA names, with
splats/statue.ply and splats/yellow_clip3.splatv; without it they are left out, and a line says so. `demo` also draws
bench/charts/demo.png.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from gscodec.capture import View, composite, cropped, open_capture
from gscodec.decode import open_stream
from gscodec.errors import UsageError
from gscodec.metrics.evaluate import BACKGROUND
from gscodec.render.image import render_image
from gscodec.render.png import write_png

from .animate_splat import animate_splat
from .data import existing
from .machine import RESULTS, ROOT, write_result

GSCODEC = [sys.executable, "-c", "from gscodec.cli import main; main()"]


def gscodec(*args) -> tuple[str, float]:
    """Runs a command; returns its stdout and seconds."""
    start = time.perf_counter()
    done = subprocess.run([*GSCODEC, *map(str, args)], stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout, time.perf_counter() - start


def measure(name: str, source: Path, folder: Path, *encode_options: str) -> dict:
    """Encodes `source`, evaluates the stream and returns the figures."""
    out, report = folder / f"{name}.gsv", folder / f"{name}.json"
    _, seconds = gscodec("encode", source, out, "--json", report, *encode_options)
    evaluated = json.loads(gscodec("eval", out, source, "--json")[0])
    evaluated.pop("per_frame")
    units = json.loads(gscodec("info", out, "--json")[0])["units"]
    return {
        "case": name,
        "command": f"gscodec encode {source.name} {name}.gsv {' '.join(encode_options)}".strip(),
        "encode_seconds": round(seconds, 2),
        **evaluated,
        "units": {n: u["bytes"] for n, u in units.items()},
        "stage_seconds": json.loads(report.read_text())["seconds"],
    }


def statue(data: Path, folder: Path) -> dict:
    """The size-quality case: 20 frames, 101,275 Gaussians."""
    return measure("statue", animated(data, folder, 20), folder)


def statue40(data: Path, folder: Path) -> dict:
    """40 frames of the statue: the second group is predicted from the first."""
    return measure("statue40", animated(data, folder, 40), folder, "--quality", "52")


def splatv(data: Path, folder: Path) -> dict:
    """A trained Spacetime scene as its authors publish it, 20 of its 50 frames, at the default quality."""
    return measure("splatv", existing(data / "splats" / "yellow_clip3.splatv"), folder, "--frames", "0:20")


def animated(data: Path, folder: Path, frames: int) -> Path:
    """The moving statue as a folder of .ply files."""
    plys = folder / f"statue{frames}"
    animate_splat(existing(data / "splats" / "statue.ply"), plys, frames)
    return plys


def demo(_: Path | None, folder: Path) -> dict:
    """The bundled example of `make demo`; also draws its picture."""
    source = ROOT / "examples" / "lumberjack"
    result = measure("demo", source, folder)
    write_png(ROOT / "bench" / "charts" / "demo.png", beside(folder / "demo.gsv", source, (0, 10, 19)))
    return result


def beside(stream: Path, source: Path, frames: tuple[int, ...]) -> np.ndarray:
    """[H, W, 3] u8: for each of `frames`, side by side, the first test view of the capture and of the stream."""
    capture, decoded = open_capture(source), open_stream(stream)
    test, pictures = capture.indices("test")[0], []
    views = [capture.view(test, t) for t in frames]
    covered = np.max([v.alpha for v in views], 0)
    for t, view in zip(frames, views, strict=True):
        reference, camera = cropped(View(composite(view, BACKGROUND), covered), capture.camera(test, t))
        pictures += [reference.rgb, render_image(decoded.frame(t), camera, BACKGROUND)]
    return np.hstack(pictures)


CASES = {"demo": demo, "statue": statue, "statue40": statue40, "splatv": splatv}


def main() -> None:
    """Runs the cases named on the command line, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"one of {', '.join(CASES)}; all by default")
    named = parser.parse_args().cases or list(CASES)
    unknown = set(named) - set(CASES)
    if unknown:
        sys.exit(f"error: no such benchmark: {', '.join(unknown)}, expected {', '.join(CASES)}")
    data = os.environ.get("GSCODEC_DATA")
    for name in named:
        if name != "demo" and not data:
            print(f"{name}: left out, GSCODEC_DATA is not set", file=sys.stderr)
            continue
        try:
            with tempfile.TemporaryDirectory() as folder:
                result = CASES[name](Path(data) if data else None, Path(folder))
        except UsageError as e:
            print(f"{name}: left out, {e}", file=sys.stderr)
            continue
        write_result(RESULTS / f"{name}.json", result)
        print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
