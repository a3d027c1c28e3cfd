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
from .keyframe import Statistics, random_offset
from .model import NAMES, Model, from_points
from .plane_sweep import sweep
from .settings import DensificationSettings, PlaneSweepSettings, TrainSettings
from .views import GREY, photometric_loss


def born(
    model: Model,
    pull: torch.Tensor,
    wrong: list[np.ndarray],
    frame: int,
    views,
    settings: TrainSettings,
    room: int,
    on_step,
):
    """New Gaussians for `frame` (a Model), or None.

    Args:
        model: the Gaussians of the frame; pull: [N], in units of what is calm.
        wrong: as of `wrong_pixels`.
        room: at most so many.
        on_step: called with (step, loss), or None.
    """
    d, k = settings.densification, settings.keyframe
    room = min(room, int(d.max_share * len(model)))
    if room < d.spawn_min or np.median([m.mean() for m in wrong]) < d.error_share_min:
        return None
    rng = np.random.default_rng([settings.seed, frame, 3])
    points = sweep_wrong(wrong, frame, views, room // 2, settings.plane_sweep, settings.seed)
    young = from_points(*points, opacity=settings.initialization.surface_opacity)
    young.set_degree(model.degree)
    chosen = torch.topk(pull, max(0, min(room - len(young), len(pull)))).indices
    young.append(_children(model, chosen[pull[chosen] > d.gradient_min], rng, settings))
    if len(young) < d.spawn_min:
        return None
    radius, stats = float(model.params["means"].std(0).norm()), Statistics(len(young), k.mse_min)
    young.start_optimizer(views.backend, settings.adam)
    for step in range(d.steps):
        together = {n: torch.cat([model.params[n], young.params[n]]) for n in NAMES}
        result = photometric_loss(together, views.draw(frame), settings, rng, views.backend)
        fade = k.rate_decay ** (step / d.steps)
        grads = {n: g[len(model) :] for n, g in result.grads.items()}
        young.step(grads, k.rates.scaled(radius, fade))
        if 2 * step >= d.steps:
            weight = torch.as_tensor(result.max_weight)[len(model) :]
            torch.maximum(stats.weight, weight, out=stats.weight)
        if on_step:
            on_step(step, result.loss)
    keep = (torch.sigmoid(young.params["logit_opacities"]) > k.prune_opacity) & (stats.weight > k.prune_weight)
    if keep.sum() < d.spawn_min:
        return None
    young.select(keep)
    young.params["quats"] = torch.nn.functional.normalize(young.params["quats"], dim=1)
    return young


def wrong_pixels(
    model: Model, masks: list[np.ndarray], frame: int, views, settings: DensificationSettings
) -> list[np.ndarray]:
    """[h, w] bool of each training camera, of the size of its mask: changed pixels (`masks`) that the Gaussians do not
    show at all."""
    import cv2

    g, out = model.gaussians(), []
    blob = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (settings.opening, settings.opening))
    for camera, mask in zip(views.train_cameras, masks, strict=True):
        truth = blend(views.view(camera, frame), GREY)
        shown = views.render(g, camera, frame)
        error = np.abs(shown - truth).max(2)
        small = cv2.resize(error, mask.shape[::-1], interpolation=cv2.INTER_AREA)
        wrong = (mask & (small > settings.error_min)).astype(np.uint8)
        out.append(cv2.morphologyEx(wrong, cv2.MORPH_OPEN, blob) > 0)
    return out


def sweep_wrong(wrong: list[np.ndarray], frame: int, views, most: int, settings: PlaneSweepSettings, seed: int = 0):
    """At most `most` points on surfaces in the pixels that are wrong, and their colours, as of `sweep`."""
    taken = [views.view(i, frame) for i in views.train_cameras]
    pictures = [(views.camera(i, frame), v.rgb, v.alpha) for i, v in zip(views.train_cameras, taken, strict=True)]
    return sweep(pictures, most, seed, settings, wrong)


def _children(
    model: Model, chosen: torch.Tensor, rng: np.random.Generator, settings: TrainSettings
) -> dict[str, torch.Tensor]:
    """One smaller Gaussian beside each of the `chosen` ones."""
    params = {n: p[chosen].clone() for n, p in model.params.items()}
    params["means"] += random_offset(params, rng)
    params["log_scales"] -= np.log(settings.keyframe.split_shrink)
    opacity = settings.densification.child_opacity
    params["logit_opacities"][:] = float(np.log(opacity / (1 - opacity)))
    return params
