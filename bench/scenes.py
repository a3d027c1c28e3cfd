"""Scenes of the rasterizer's benchmark: a capsule with any number of Gaussians, and splats from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gscodec.model.camera import LOW_PASS, NEAR, Camera, look_at
from gscodec.model.gaussians import Gaussians, logit
from gscodec.render.movie import orbit_camera

from .data import existing

RADIUS, HEIGHT = 0.25, 1.8  # metres
DISTANCE, FOCAL = 2.8, 1.4  # metres; image widths

UP = {"statue": "-y", "playbot": "-y", "lumberjack": "z"}  # scene from files -> world axis that points up


def capsule(n: int, seed: int = 0) -> Gaussians:
    """N Gaussians, uniform on the surface of a person-sized capsule, in random order.

    Splats of 0.6 x the mean spacing x U(0.5, 1.5) per axis, opacity U(0.15, 0.95).
    """
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
    arrays = (points, rng.normal(size=(n, 4)), np.log(scales), logit(opacity), rng.normal(size=(n, 3)))
    return Gaussians(*(a.astype(np.float32) for a in arrays), np.zeros((n, 0, 3), np.float32)).validate("capsule")


def capsule_camera(width: int, height: int, distance: float = DISTANCE) -> Camera:
    """A camera at `distance` metres whose focal length is 1.4 x the shorter side."""
    f = FOCAL * min(width, height)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Camera("bench", K, look_at([0, 0, distance], [0, 0, 0], [0, 1, 0]), width, height)


def file_scene(name: str, data: Path, work: Path, width: int, height: int) -> tuple[Gaussians, Camera]:
    """The Gaussians of a file in `data`, or of the lumberjack trained in `work`, and a camera with all in view.

    Raises:
        UsageError: the files are missing.
    """
    from gscodec.splats import open_sequence

    from .sequences import open_case

    if name == "lumberjack":
        gaussians = open_case(name, data, work).frame(0)
    else:
        gaussians = open_sequence(existing(Path(data) / "splats" / f"{name}.ply")).frame(0)
    return gaussians, orbit_camera(gaussians, UP[name], 0.25, width, height, NEAR, LOW_PASS)
