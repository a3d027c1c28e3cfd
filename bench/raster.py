"""Speed of the rasterizer: a JSON list of scenes, sizes, instruction sets, threads and the milliseconds they take.

Keys: scene, gaussians, width, height, simd, threads, project_ms, forward_ms, backward_ms, step_ms.

The scene is a person-sized capsule: points on its surface, splats of 0.6 x the mean spacing x U(0.5, 1.5) per axis,
opacity U(0.15, 0.95), camera at 2.8 m, f = 1.4 x width. project_ms is projection, depth sort and binning; forward_ms
blending of a X
of `repeats` runs.

    python bench/raster.py [--repeats N] [--simd avx512,avx2,scalar] [--threads 1,0] > bench/results/raster.json
"""

from __future__ import annotations

import argparse
import json
import os
import time

import numpy as np

from gscodec.camera import Camera, look_at
from gscodec.gaussians import Gaussians
from gscodec.render.image import render_image, render_rgba
from gscodec.render.step import render_loss
from gscodec.render.workspace import PARAMETERS, Workspace, simd_levels

SIZES = ((20_000, 512), (50_000, 512), (100_000, 1024))  # Gaussians, width = height
RADIUS, HEIGHT = 0.25, 1.8  # metres


def capsule(n: int, seed: int = 0) -> Gaussians:
    """N Gaussians evenly on the capsule, in random order."""
    rng = np.random.default_rng(seed)
    cylinder = HEIGHT - 2 * RADIUS
    side, caps = 2 * np.pi * RADIUS * cylinder, 4 * np.pi * RADIUS**2
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * RADIUS
    points[:, 1] += np.sign(points[:, 1]) * cylinder / 2
    on_side = rng.random(n) < side / (side + caps)
    angle, y = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.5, 0.5, n) * cylinder
    ring = np.stack([RADIUS * np.cos(angle), y, RADIUS * np.sin(angle)], 1)
    points[on_side] = ring[on_side]
    scales = 0.6 * np.sqrt((side + caps) / n) * rng.uniform(0.5, 1.5, (n, 3))
    opacity = rng.uniform(0.15, 0.95, n)
    arrays = (points, rng.normal(size=(n, 4)), np.log(scales), np.log(opacity / (1 - opacity)), rng.normal(size=(n, 3)))
    return Gaussians(*(a.astype(np.float32) for a in arrays), np.zeros((n, 0, 3), np.float32)).validate("capsule")


def camera(width: int) -> Camera:
    K = np.array([[1.4 * width, 0, width / 2], [0, 1.4 * width, width / 2], [0, 0, 1.0]])
    return Camera("bench", K, look_at([0, 0, 2.8], [0, 0, 0], [0, 1, 0]), width, width)


def measure(scene: str, gaussians: Gaussians, cam: Camera, simd: str, threads: int, repeats: int) -> dict:
    """One entry of the list; `threads` 0 means all cores."""
    workspace = Workspace(threads, simd)
    params = {name: getattr(gaussians, name) for name in PARAMETERS}
    covered = render_rgba(gaussians, cam)[..., 3] > 0.02
    noise = np.random.default_rng(0).integers(-9, 9, (cam.height, cam.width, 3)) * covered[..., None]
    rgb = np.clip(render_image(gaussians, cam) + noise, 0, 255).astype(np.uint8)
    mask = covered.astype(np.uint8) * 255
    parts, steps = [], []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        render_loss(params, cam, rgb, mask, (0.5, 0.5, 0.5), 0.2, 0.1, workspace)
        steps.append(1e3 * (time.perf_counter() - start))
        t = workspace.timings
        parts.append((t["project"] + t["bin"], t["blend"], t["backward_tiles"] + t["backward_project"]))
    project, forward, backward = np.median(parts[2:], axis=0)  # the first two warm up
    return {
        "scene": scene,
        "gaussians": len(gaussians),
        "width": cam.width,
        "height": cam.height,
        "simd": simd,
        "threads": threads or os.cpu_count(),
        "project_ms": round(float(project), 3),
        "forward_ms": round(float(forward), 3),
        "backward_ms": round(float(backward), 3),
        "step_ms": round(float(np.median(steps[2:])), 3),
    }


def run(simd: list[str] | None = None, threads: tuple[int, ...] = (1, 0), repeats: int = 15, sizes=SIZES) -> list[dict]:
    """The whole list; `simd` None: every level of this machine."""
    entries = []
    for n, width in sizes:
        gaussians, cam = capsule(n), camera(width)
        for level in simd or simd_levels():
            entries += [measure("capsule", gaussians, cam, level, t, repeats) for t in threads]
    return entries


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--simd", help="comma-separated, default: all levels of this machine")
    parser.add_argument("--threads", default="1,0", help="comma-separated, 0: all cores")
    args = parser.parse_args()
    simd = args.simd.split(",") if args.simd else None
    print(json.dumps(run(simd, tuple(int(t) for t in args.threads.split(",")), args.repeats), indent=1))


if __name__ == "__main__":
    main()
