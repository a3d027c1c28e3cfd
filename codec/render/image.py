"""Gaussians + Camera -> image, for the player's side: `gscodec render`, `eval` and the metrics. Needs no torch."""

from __future__ import annotations

import numpy as np

from ..model.camera import Camera
from ..model.gaussians import PARAMETERS, Gaussians
from .workspace import Workspace

_shared: list[Workspace] = []  # the workspace of callers that pass none


def render_rgba(gaussians: Gaussians, camera: Camera, *, workspace: Workspace | None = None) -> np.ndarray:
    """Renders Gaussians without a background.

    Returns:
        [H, W, 4] f32: colour premultiplied by alpha (not clamped at 1), and alpha.
    """
    image, alpha = _workspace(workspace).forward(_params(gaussians), camera, (0.0, 0.0, 0.0))
    return np.concatenate([image, alpha[..., None]], axis=2)


def render_image(
    gaussians: Gaussians,
    camera: Camera,
    background: tuple[float, float, float] = (0.5, 0.5, 0.5),
    *,
    workspace: Workspace | None = None,
) -> np.ndarray:
    """Renders Gaussians over a background colour in [0, 1].

    Returns:
        [H, W, 3] uint8, rounded.
    """
    return _workspace(workspace).draw(_params(gaussians), camera, background)


def _workspace(workspace: Workspace | None) -> Workspace:
    if workspace is not None:
        return workspace
    if not _shared:
        _shared.append(Workspace())
    return _shared[0]


def _params(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(getattr(gaussians, name), np.float32) for name in PARAMETERS)
