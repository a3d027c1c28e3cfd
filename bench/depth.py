"""Gain of depth images with few cameras (`python -m bench.depth --help`): one frame of a procedural scene, trained
alone without them, with initial points from them, with their term of the loss, and with both.

The weight of the term was chosen on the scenes of `VALIDATION` (`--weights`); other scenes are reported. PSNR and depth
are those of test cameras: `depth_error` is the mean of |expected depth - depth| / depth over the pixels of the scene,
with the exact depth of the tracer.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.model.gaussians import Gaussians
from gscodec.train.settings import TrainSettings, train_settings

from .machine import update_entries
from .procedural import Scene, placed, trace
from .stress_scenes import SCENES, SHIRT, cut, on_a_floor
from .train import every_frame_alone, part

TEST = 6  # cameras, between the training ones
SIZE = 160  # pixels
NOISE = 0.005  # of the depth, as in good sensors
BUDGET = {"gaussians_max": 6000, "initial_points": 3000}  # for pictures of this size
FRAME = 3
VALIDATION = {
    "stack": Scene(lambda t: cut(8)),
    "stack in a room": Scene(lambda t: [*cut(8), *room()], masks=False),
}
REPORTED = {
    "figure": Scene(SCENES["4 cameras"].shapes),
    "figure in a room": Scene(lambda t: [*on_a_floor(t), *room()], masks=False),
}
VARIANTS = {"without": (False, False), "start": (True, False), "loss": (False, True), "both": (True, True)}


def room() -> list:
    """Crates around the subject, on a floor."""
    crates = [placed(False, (0.25, 0.2, 0.35), (np.cos(a), 1.1 * np.sin(a), -0.3), SHIRT) for a in (0.4, 2.2, 4.0, 5.4)]
    return [*crates, placed(False, (2.2, 2.2, 0.05), (0, 0, -0.75), (0.7, 0.65, 0.55))]


def measure(scene: Scene, cameras: int, variant: str, weight: float | None = None) -> dict:
    """Quality on the test cameras of one keyframe.

    Args:
        weight: weight of the depth term; None: that of the settings.
    """
    start, loss = VARIANTS[variant]
    base = replace(train_settings("fast"), **BUDGET)
    weight = base.depth_lambda if weight is None else weight
    own = replace(base.initialization, use_depth=start)
    settings = replace(base, initialization=own, depth_lambda=weight if loss else 0.0)
    scene = replace(scene, train=cameras, test=TEST, size=SIZE, depth_noise=NOISE, frames=FRAME + 1)
    models, seconds = every_frame_alone(scene.capture("depth"), range(FRAME, FRAME + 1), settings)
    return {**quality(scene, models[0]), "gaussians": len(models[0]), "seconds_to_train": round(seconds, 1)}


def quality(scene: Scene, model: Gaussians) -> dict:
    """PSNR, SSIM and error of the depth on the test cameras."""
    from gscodec.metrics.evaluate import evaluate_capture
    from gscodec.render.cpu import CpuBackend
    from gscodec.render.sensitivity import params_of

    capture, backend, errors = scene.capture("depth"), CpuBackend(), []
    found = evaluate_capture(lambda _: model, part(capture, range(FRAME, FRAME + 1)), "test")
    for i in capture.indices("test"):
        _, depth = trace(scene.shapes(FRAME), scene.light(FRAME), capture.camera(i, FRAME))
        there = depth > 0
        drawn = backend.render_depth(params_of(model), capture.camera(i, FRAME))
        errors.append(np.abs(drawn[there] - depth[there]) / depth[there])
    error = float(np.mean(np.concatenate(errors)))
    return {k: round(found[k], 3) for k in ("psnr_fg", "ssim")} | {"depth_error": round(error, 4)}


def entries(scenes: dict[str, Scene], counts: list[int], weights: list[float | None]) -> Iterator[dict]:
    """One entry per scene, number of cameras, variant and weight."""
    for name, scene in scenes.items():
        for cameras in counts:
            for variant in VARIANTS:
                for weight in weights if VARIANTS[variant][1] else [0.0]:
                    head = {"scene": name, "cameras": cameras, "variant": variant}
                    told = TrainSettings().depth_lambda if weight is None else weight
                    yield {**head, "weight": told, **measure(scene, cameras, variant, weight)}


def main() -> None:
    p = argparse.ArgumentParser(description="Depth images against none: one frame, trained alone.")
    p.add_argument("--cameras", type=int, nargs="+", default=[4, 8])
    p.add_argument("--weights", type=float, nargs="+", help="Try these weights, on the scenes of VALIDATION.")
    p.add_argument("--out", type=Path, default=Path("bench/results/depth.json"))
    a = p.parse_args()
    start, scenes = time.perf_counter(), VALIDATION if a.weights else REPORTED
    of = lambda e: [e[k] for k in ("scene", "cameras", "variant", "weight")]  # noqa: E731
    for entry in update_entries(a.out, entries(scenes, a.cameras, a.weights or [None]), of):
        print(f"{time.perf_counter() - start:6.0f} s  {entry}", flush=True)


if __name__ == "__main__":
    main()
