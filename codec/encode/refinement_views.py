"""Drawn views: targets of adaptive rounding for given splats, rendered from cameras that no metric of gscodec uses."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ..model.camera import Camera
from ..model.gaussians import Gaussians
from ..render.sensitivity import GREY, arrays_of
from ..render.workspace import Workspace

Colour = tuple[float, float, float]
Target = tuple[int, Camera, Colour, np.ndarray]  # frame, camera, background, picture [H, W, 3] f32 over it, 0 to 1


def drawn_views(source: Callable[[int], Gaussians], cameras: list[Camera], frames: int) -> Iterator[Target]:
    """One view for each camera; every frame of `frames` comes once before any comes again.

    Args:
        source: frame -> target Gaussians.
    """
    workspace, random = Workspace(), np.random.default_rng(0)
    rounds = [random.permutation(frames) for _ in range(0, len(cameras), frames)]
    for i, t in zip(random.permutation(len(cameras)), np.concatenate(rounds)[: len(cameras)], strict=True):
        picture, _ = workspace.forward(arrays_of(source(int(t))), cameras[i], GREY)
        yield int(t), cameras[i], GREY, picture
