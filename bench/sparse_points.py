"""Sparse points as structure from motion gives them, from the known cameras of a capture: matched features of its
training cameras, triangulated. For captures whose publisher has left the points out; a reference for what they are
worth at the start of training (`python -m bench.sparse_points --help`)."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.capture import Capture
from gscodec.capture.matching import matched_features
from gscodec.capture.points import Points

from .train import CASES, every_frame_alone, held_out, part

NEIGHBOURS, FEATURES = 4, 8000
REPROJECTION = 1.5  # pixels, farther a match is wrong
ANGLE = 2.0  # degrees between the rays of a point at least
VALIDATION = {
    "basketball": ("cam05", "cam13", "cam20", "cam27"),
    "lumberjack": ("cam03", "cam09", "cam17"),
    "stage": ("cam03", "cam08"),
}  # of the training cameras, held out: the test cameras choose nothing


def triangulated(capture: Capture, frame: int) -> Points:
    """Points of matched features between neighbouring training cameras."""
    import cv2

    trained, means, colors = capture.indices("train"), [], []
    for m in matched_features(capture, frame, trained, neighbours=NEIGHBOURS, features=FEATURES):
        if not len(m.p):
            continue
        a, b = (capture.camera(trained[i], frame) for i in (m.first, m.second))
        x = cv2.triangulatePoints(a.K @ a.viewmat[:3], b.K @ b.viewmat[:3], m.p.T, m.q.T)
        x = (x[:3] / x[3]).T
        good = np.isfinite(x).all(1)
        for camera, seen in ((a, m.p), (b, m.q)):
            y = x @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            u = y @ camera.K.T
            good &= (y[:, 2] > camera.near) & (np.linalg.norm(u[:, :2] / u[:, 2:] - seen, axis=1) < REPROJECTION)
        rays = [(x - c.center) / np.linalg.norm(x - c.center, axis=1, keepdims=True) for c in (a, b)]
        good &= (rays[0] * rays[1]).sum(1) < np.cos(np.radians(ANGLE))
        at = m.p[good].astype(int)
        means.append(x[good])
        colors.append(capture.view(trained[m.first], frame).rgb[at[:, 1], at[:, 0]])
    return Points(np.concatenate(means).astype(np.float32), np.concatenate(colors))


def measure(capture: Capture, preset: str, frame: int) -> dict:
    """PSNR on the held-out cameras, seconds, and seconds of all threads of one keyframe."""
    from gscodec.metrics.evaluate import evaluate_capture
    from gscodec.train.settings import train_settings

    start = time.process_time()
    models, seconds = every_frame_alone(capture, range(frame, frame + 1), train_settings(preset))
    cpu = round(time.process_time() - start, 1)
    found = evaluate_capture(lambda _: models[0], part(capture, range(frame, frame + 1)), "test")
    quality = {k: round(found[k], 3) for k in ("psnr", "psnr_fg", "psnr_corrected", "ssim")}
    return {**quality, "seconds": round(seconds, 1), "cpu_seconds": cpu, "gaussians": len(models[0])}


def main() -> None:
    p = argparse.ArgumentParser(description="The capture's points against none: one frame, trained alone.")
    p.add_argument("case", choices=VALIDATION)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--preset", default="fast")
    p.add_argument("--frame", type=int, default=0)
    p.add_argument("--out", type=Path, default=Path("bench/results/points.json"))
    a = p.parse_args()
    capture = held_out(CASES[a.case].open(a.data), VALIDATION[a.case])
    points = triangulated(capture, 0)
    for name, own in (("none", None), ("points", points)):
        found = measure(replace(capture, points=own), a.preset, a.frame)
        key = f"{a.case}, frame {a.frame}, {a.preset}, {name}"
        entries = json.loads(a.out.read_text()) if a.out.is_file() else {}
        entries[key] = {"points": 0 if own is None else len(own), **found}
        a.out.write_text(json.dumps(entries, indent=1) + "\n")
        print(key, entries[key], flush=True)


if __name__ == "__main__":
    main()
