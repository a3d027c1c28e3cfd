"""Births: Gaussians that a frame needs and its keyframe did not have, for what turns into sight or comes in.

In: the Gaussians of a tracked frame, and how strongly its pictures pull at each. Out: new ones in the pose of the
frame, trained alone for some steps among the others, which stay; they live from this frame on. There are births only
where pictures are altogether wrong in what has changed: nothing near could move there (a ball drops in), and half of
them come from a plane sweep. The others are children of Gaussians at which the pictures pull far more than in the
keyframe. Children alone, wherever the pull is strong, raised lumberjack from 9,500 to 16,900 Gaussians for nothing.
"""

from __future__ import annotations

import numpy as np
import torch

from ..capture import blend
from ..render.image import render_image
from ..render.workspace import Workspace
from .keyframe import (
    MEANS_RATE,
    PRUNE_OPACITY,
    PRUNE_WEIGHT,
    RATES,
    SPLIT_SHRINK,
    Statistics,
    random_offset,
)
from .model import NAMES, Model, from_points
from .plane_sweep import sweep
from .views import compare

LOUD = 2.0  # times the calm pull
LEAST = 8  # fewer are not worth a unit in the stream
MOST = 0.05  # of the Gaussians, in one frame
STEPS = 100
CHILD_OPACITY = 0.3
GREY = (0.5, 0.5, 0.5)
WRONG = 40.0  # grey levels: altogether wrong
BLOB = 7  # pixels of 256 a picture: wrong edges and highlights are thinner than what is missing
WRONG_SHARE = 0.002  # of the picture in half of the views; what only some have wrong is a highlight


def born(model: Model, pull: torch.Tensor, wrong: list[np.ndarray], frame: int, views, settings, room: int, on_step):
    """New Gaussians for `frame` (a Model), or None.

    Args:
        model: the Gaussians of the frame; pull: [N], in units of what is calm.
        wrong: as of `wrong_pixels`.
        room: at most so many.
        on_step: called with (step, loss), or None.
    """
    if np.median([m.mean() for m in wrong]) < WRONG_SHARE:
        return None
    room = min(room, int(MOST * len(model)))
    rng, workspace = np.random.default_rng([settings.seed, frame, 3]), Workspace()
    young = from_points(*sweep_wrong(wrong, frame, views, room // 2, settings.seed), opacity=0.5)
    young.set_degree(model.degree)
    chosen = torch.topk(pull, max(0, min(room - len(young), len(pull)))).indices
    young.append(_children(model, chosen[pull[chosen] > LOUD], rng))
    if len(young) < LEAST:
        return None
    radius, stats = float(model.params["means"].std(0).norm()), Statistics(len(young))
    for step in range(STEPS):
        together = {n: torch.cat([model.params[n], young.params[n]]) for n in NAMES}
        result = compare(together, views.draw(frame), settings, rng, workspace)
        fade = 0.1 ** (step / STEPS)
        rates = {"means": radius * MEANS_RATE[0] * fade, **{n: r * fade for n, r in RATES.items()}}
        young.adam({n: g[len(model) :] for n, g in result.grads.items()}, rates)
        if 2 * step >= STEPS:
            weight = torch.as_tensor(result.max_weight)[len(model) :]
            torch.maximum(stats.weight, weight, out=stats.weight)
        if on_step:
            on_step(step, result.loss)
    keep = (torch.sigmoid(young.params["logit_opacities"]) > PRUNE_OPACITY) & (stats.weight > PRUNE_WEIGHT)
    if keep.sum() < LEAST:
        return None
    young.select(keep)
    young.params["quats"] = torch.nn.functional.normalize(young.params["quats"], dim=1)
    return young


def wrong_pixels(model: Model, masks: list[np.ndarray], frame: int, views) -> list[np.ndarray]:
    """[h, w] bool of each training camera, of the size of its mask: changed pixels (`masks`) that the Gaussians do not
    show at all."""
    import cv2

    g, out = model.gaussians(), []
    blob = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (BLOB, BLOB))
    for camera, mask in zip(views.train_cameras, masks, strict=True):
        truth = blend(views.view(camera, frame), GREY)
        shown = render_image(views.exposure.seen(g, camera), views.camera(camera, frame), GREY)
        error = np.abs(shown - truth).max(2)
        small = cv2.resize(error, mask.shape[::-1], interpolation=cv2.INTER_AREA)
        wrong = (mask & (small > WRONG)).astype(np.uint8)
        out.append(cv2.morphologyEx(wrong, cv2.MORPH_OPEN, blob) > 0)
    return out


def sweep_wrong(wrong: list[np.ndarray], frame: int, views, most: int, seed: int = 0):
    """At most `most` points on surfaces in the pixels that are wrong, and their colours, as of `sweep`."""
    taken = [views.view(i, frame) for i in views.train_cameras]
    pictures = [(views.camera(i, frame), v.rgb, v.alpha) for i, v in zip(views.train_cameras, taken, strict=True)]
    return sweep(pictures, most, seed, wrong)


def _children(model: Model, chosen: torch.Tensor, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """One smaller Gaussian beside each of the `chosen` ones."""
    params = {n: p[chosen].clone() for n, p in model.params.items()}
    params["means"] += random_offset(params, rng)
    params["log_scales"] -= SPLIT_SHRINK
    params["logit_opacities"][:] = float(np.log(CHILD_OPACITY / (1 - CHILD_OPACITY)))
    return params
