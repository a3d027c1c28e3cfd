"""Pseudo views of a keyframe: pictures between the training cameras, as other models of the same frame show them.

Few cameras leave much to chance: models that differ only in their random numbers err differently where no camera looks,
and the mean of their pictures there is nearer to the truth than any of them. A keyframe that is also trained on such
pictures keeps most of that gain (distillation of an ensemble, Hinton et al. 2015; pseudo views as in FSGS, Zhu et al.
2024, and CoR-GS, Zhang et al. 2024).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..capture import View, cropped
from ..model.camera import Camera, meeting_point
from ..render.backend import Backend, Params
from .views import GREY, Target

NEIGHBOURS = 2  # of each camera, with which it has a pseudo view
ALIKE_MIN = 0.5  # cosine of the angle between neighbours, as seen from where the cameras look: at most 60 degrees


def between(cameras: Sequence[Camera]) -> list[Camera]:
    """A camera halfway between each camera and each of its `NEIGHBOURS` nearest ones, by their directions from where
    all look; as far from there as the mean of the two, with the picture of the first."""
    from scipy.spatial.transform import Rotation

    centre = meeting_point(cameras)
    away = np.array([c.center - centre for c in cameras])
    far = np.linalg.norm(away, axis=1)
    directions = away / np.maximum(far, 1e-12)[:, None]
    alike = directions @ directions.T
    np.fill_diagonal(alike, -1)
    pairs = {
        (min(i, j), max(i, j))
        for i, row in enumerate(alike)
        for j in np.argsort(-row, kind="stable")[:NEIGHBOURS].tolist()
        if row[j] > ALIKE_MIN
    }
    found = []
    for i, j in sorted(pairs):
        a, b = cameras[i], cameras[j]
        direction = directions[i] + directions[j]
        place = centre + direction / np.linalg.norm(direction) * (far[i] + far[j]) / 2
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_matrix([a.viewmat[:3, :3], b.viewmat[:3, :3]]).mean().as_matrix()
        viewmat[:3, 3] = -viewmat[:3, :3] @ place
        found.append(replace(a, name=f"between {a.name} and {b.name}", viewmat=viewmat, near=min(a.near, b.near)))
    return found


def pseudo_view(camera: Camera, models: Sequence[Params], opaque: bool, backend: Backend) -> Target:
    """A training target for one of the cameras of `between`: the mean of the pictures of `models`; of a capture without
    masks (`opaque`) over the grey that its targets have behind them."""
    drawn = [backend.render(m, camera, GREY if opaque else (0.0, 0.0, 0.0)) for m in models]
    image, alpha = (np.mean([d[k] for d in drawn], axis=0).clip(0, 1) for k in range(2))
    if opaque:
        alpha = np.ones_like(alpha)
    view = View(_u8(image / np.maximum(alpha, 1 / 255)[..., None]), _u8(alpha))
    crop = camera
    if not opaque:
        view, crop = cropped(view, camera)
    return Target(crop, view.rgb, view.alpha, None, opaque=opaque)


def _u8(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)
