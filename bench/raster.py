"""Speed of the rasterizer by scene, image size, instruction set and number of threads.

Keys of an entry:
  scene, gaussians, width, height, simd, threads
  covered        share of the pixels with alpha > 0.02
  project_ms     projection, depth sort and binning
  forward_ms     blending
  backward_ms    tiles, then Gaussians
  step_ms        a whole training step: all passes, the image loss and Adam
  memory_bytes   all buffers of a forward pass
Times are medians of the runs after two warm-up runs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gscodec.errors import UsageError
from gscodec.model.camera import Camera
from gscodec.model.gaussians import PARAMETERS, Gaussians
from gscodec.render.backend import LossWeights, TargetView
from gscodec.render.cpu import CpuBackend
from gscodec.render.image import render_image, render_rgba
from gscodec.render.optimizer import AdamSettings
from gscodec.render.sensitivity import params_of
from gscodec.render.workspace import simd_levels
from gscodec.train.model import from_gaussians

from .machine import write_result
from .scenes import DISTANCE, UP, capsule, capsule_camera, file_scene

RATE = 1e-6  # learning rate of Adam: the scene must not change during the measurement
BUDGET_S = 2.0  # after these seconds an entry stops, with at least 5 repeats


@dataclass(frozen=True)
class Case:
    """One scene at one image size. `every`: all instruction sets and 1 thread too, else the fastest with all cores."""

    scene: str
    gaussians: int  # of a capsule
    width: int
    height: int
    distance: float = DISTANCE
    every: bool = False

    def load(self, data: Path | None, work: Path) -> tuple[Gaussians, Camera]:
        """Gaussians and camera.

        Raises:
            UsageError: the scene's files are missing.
        """
        if self.scene == "capsule":
            return capsule(self.gaussians), capsule_camera(self.width, self.height, self.distance)
        if data is None:
            raise UsageError("there is no data folder, set --data or GSCODEC_DATA")
        return file_scene(self.scene, data, work, self.width, self.height)


ANCHORS = [Case("capsule", n, w, w, every=True) for n, w in ((20_000, 512), (50_000, 512), (100_000, 1024))]
ANCHORS.append(Case("capsule", 30_000, 512, 512))  # the training step
GROWTH = [Case("capsule", n, 1024, 1024) for n in (10_000, 30_000, 300_000, 1_000_000)]
PIXELS = [Case("capsule", 100_000, w, h) for w, h in ((512, 512), (1920, 1080), (2048, 2048), (3840, 2160))]
COVERED = [Case("capsule", 50_000, 1024, 1024, d) for d in (1.2, 2.8, 6.0)]
SPLATS = [Case("statue", 0, 1280, 720), Case("playbot", 0, 1280, 720), Case("lumberjack", 0, 512, 512)]
CASES = [*ANCHORS, *GROWTH, *PIXELS, *COVERED, *SPLATS]
SCENES = ("capsule", *UP)


def measure(scene: str, gaussians: Gaussians, cam: Camera, simd: str, threads: int, repeats: int) -> dict:
    """One entry of the list."""
    backend, grey = CpuBackend(threads, simd), (0.5, 0.5, 0.5)
    backend.render(params_of(gaussians), cam, grey)
    memory = backend.workspace.memory
    model = from_gaussians(gaussians)
    model.start_optimizer(backend, AdamSettings())
    covered = render_rgba(gaussians, cam)[..., 3] > 0.02
    noise = np.random.default_rng(0).integers(-9, 9, (cam.height, cam.width, 3)) * covered[..., None]
    rgb = np.clip(render_image(gaussians, cam) + noise, 0, 255).astype(np.uint8)
    mask = covered.astype(np.uint8) * 255
    rates = dict.fromkeys(PARAMETERS, RATE)
    parts, steps = [], []
    for adam in (False, True):  # the passes alone, then whole training steps
        begin, count = time.perf_counter(), 0
        while count < repeats + 2 and (count < 7 or time.perf_counter() - begin < BUDGET_S):
            start, count = time.perf_counter(), count + 1
            result = backend.photometric_loss(model.params, [TargetView(cam, rgb, mask, grey)], LossWeights(mask=0.1))
            if adam:
                model.step(result.grads, rates)
                steps.append(1e3 * (time.perf_counter() - start))
            else:
                t = backend.workspace.timings
                parts.append((t["project"] + t["bin"], t["blend"], t["backward_tiles"] + t["backward_project"]))
    project, forward, backward = np.median(parts[2:], axis=0)
    return {
        "scene": scene,
        "gaussians": len(gaussians),
        "width": cam.width,
        "height": cam.height,
        "covered": round(float(covered.mean()), 4),
        "simd": simd,
        "threads": threads,
        "project_ms": round(float(project), 3),
        "forward_ms": round(float(forward), 3),
        "backward_ms": round(float(backward), 3),
        "step_ms": round(float(np.median(steps[2:])), 3),
        "memory_bytes": memory,
    }


def run(
    scenes: Sequence[str] = SCENES,
    simd: list[str] | None = None,
    threads: list[int] | None = None,
    repeats: int = 15,
    data: Path | None = None,
    work: Path = Path("build/bench"),
    out: Path | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Iterator[dict]:
    """Yields the entries of all cases of `scenes`, then writes them and the settings to `out`.

    Args:
        simd: levels of every case; None: all levels for the anchors, the fastest for the others.
        threads: numbers of threads of every case; None: 1 and all cores for the anchors, all cores for the others.
        data: folder with splats and captures; a case whose files are missing is left out, and `say` gets a line.
        work: where the trained lumberjack is kept (sequences.py).
        out: the result file, or None.
    """
    entries = []
    for case in CASES:
        if case.scene not in scenes:
            continue
        try:
            loaded = case.load(data, work)
        except UsageError as e:
            say(f"{case.scene}: left out, {e}")
            continue
        for level, count in _variants(case, simd, threads):
            entries.append(measure(case.scene, *loaded, level, count, repeats))
            yield entries[-1]
    if out:
        settings = {"scenes": list(scenes), "simd": simd or simd_levels(), "threads": threads, "repeats": repeats}
        write_result(out, {"settings": settings, "entries": entries})


def _variants(case: Case, simd: list[str] | None, threads: list[int] | None) -> Iterator[tuple[str, int]]:
    """(instruction set, number of threads) of the entries of a case."""
    cores = os.cpu_count() or 1
    for level in simd or simd_levels()[: None if case.every else 1]:
        for count in threads or ([1, cores] if case.every and cores > 1 else [cores]):
            yield level, count
