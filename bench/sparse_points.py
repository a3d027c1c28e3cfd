"""Gain of sparse points at the start of training: points that a capture brings, here triangulated from its own training
cameras, against none (`python -m bench.sparse_points --help`)."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

from gscodec.capture import Capture
from gscodec.train.settings import InitializationSettings
from gscodec.train.sparse_points import triangulated

from .machine import update_entries
from .train import CASES, every_frame_alone, held_out, part

VALIDATION = {
    "basketball": ("cam05", "cam13", "cam20", "cam27"),
    "lumberjack": ("cam03", "cam09", "cam17"),
    "stage": ("cam03", "cam08"),
}  # training cameras that are held out: test cameras must not choose anything


def measure(capture: Capture, preset: str, frame: int) -> dict:
    """PSNR on the held-out cameras, seconds, and seconds of all threads of one keyframe."""
    from gscodec.metrics.evaluate import evaluate_capture
    from gscodec.train.settings import train_settings

    settings, start = train_settings(preset), time.process_time()
    own = replace(settings.initialization, triangulate=False)  # the points of `capture`, or none
    (alone,), seconds = every_frame_alone(capture, [frame], replace(settings, initialization=own))
    model = alone.canonical
    cpu = round(time.process_time() - start, 1)
    found = evaluate_capture(lambda _: model, part(capture, range(frame, frame + 1)), "test")
    quality = {k: round(found[k], 3) for k in ("psnr", "psnr_fg", "psnr_corrected", "ssim")}
    return {**quality, "seconds": round(seconds, 1), "cpu_seconds": cpu, "gaussians": len(model)}


def main() -> None:
    p = argparse.ArgumentParser(description="The capture's points against none: one frame, trained alone.")
    p.add_argument("case", choices=VALIDATION)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--preset", default="fast")
    p.add_argument("--frame", type=int, default=0)
    p.add_argument("--out", type=Path, default=Path("bench/results/points.json"))
    a = p.parse_args()
    capture = held_out(CASES[a.case].open(a.data), VALIDATION[a.case])
    points = triangulated(capture, 0, InitializationSettings())
    head = {"case": a.case, "frame": a.frame, "preset": a.preset}
    entries = (
        {**head, "points": len(own or ()), **measure(replace(capture, points=own), a.preset, a.frame)}
        for own in (None, points)
    )
    for entry in update_entries(a.out, entries, lambda e: (*(e[k] for k in head), e["points"] > 0)):
        print(entry, flush=True)


if __name__ == "__main__":
    main()
