"""Densification while tracking: a frame gets new Gaussians for parts that its keyframe did not show.

In: the Gaussians of a tracked frame and their screen gradients. Out: new Gaussians in the pose of the frame, optimised
for some steps among the others, which stay as they are. Their lifetime begins at this frame. Gaussians are added only
at changed pixels with a large error, where no Gaussian nearby could move to (a ball drops in). Half of them come from a
plane sweep; the others are children of Gaussians whose screen gradient is far above that of the keyframe. Children
alone, at any large gradient, raised lumberjack from 9,500 to 16,900 Gaussians for no better image.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..capture import blend
from ..model.gaussians import logit
from .keyframe import Statistics, price, random_offset
from .model import NAMES, Model, from_points
from .plane_sweep import sweep
from .settings import DensificationSettings, PlaneSweepSettings, TrainSettings
from .views import GREY, Views, photometric_loss


def spawn(
    model: Model,
    gradient: torch.Tensor,
    wrong: list[np.ndarray],
    frame: int,
    views: Views,
    settings: TrainSettings,
    room: int,
    on_step: Callable[[int, float], None] | None,
) -> Model | None:
    """New Gaussians for `frame`, or None.

    Args:
        model: the Gaussians of the frame.
        gradient: [N], screen gradient of each Gaussian, in units of the keyframe's.
        wrong: from `error_masks`.
        room: bound on the number of new Gaussians.
        on_step: called with (step, loss).
    """
    s = settings.densification
    room = min(room, int(s.max_share * len(model)))
    if room < s.spawn_min or np.median([m.mean() for m in wrong]) < s.error_share_min:
        return None
    rng = np.random.default_rng([settings.seed, frame, 3])
    points = sweep_masked(wrong, frame, views, room // 2, settings.plane_sweep, settings.seed)
    spawned = from_points(*points, opacity=settings.initialization.surface_opacity)
    spawned.set_degree(model.degree)
    parents = torch.topk(gradient, max(0, min(room - len(spawned), len(gradient)))).indices
    spawned.append(_children(model, parents[gradient[parents] > s.gradient_min], rng, settings))
    if len(spawned) < s.spawn_min:
        return None
    stats, k = _optimize(spawned, model, frame, views, settings, rng, on_step), settings.keyframe
    opacities = torch.sigmoid(torch.cat([m.params["logit_opacities"] for m in (model, spawned)]))
    keep = (opacities > k.prune_opacity) & (stats.max_weight > k.prune_weight)
    keep = (keep & (stats.contribution(opacities) >= price(len(opacities), k)))[len(model) :]
    if keep.sum() < s.spawn_min:
        return None
    spawned.select(keep)
    spawned.params["quats"] = torch.nn.functional.normalize(spawned.params["quats"], dim=1)
    return spawned


def _optimize(
    spawned: Model, others: Model, frame: int, views: Views, settings: TrainSettings, rng: np.random.Generator, on_step
) -> Statistics:
    """Optimises `spawned` among fixed `others`; returns the statistics of all over the second half of the steps."""
    steps, k, known = settings.densification.steps, settings.keyframe, len(others)
    radius, stats = float(others.params["means"].std(0).norm()), Statistics(known + len(spawned), k.mse_min)
    spawned.start_optimizer(views.backend, settings.adam, views.size_bound)
    for step in range(steps):
        together = {n: torch.cat([others.params[n], spawned.params[n]]) for n in NAMES}
        result = photometric_loss(together, views.draw(frame), settings, rng, views.backend)
        grads = {n: g[known:] for n, g in result.grads.items()}
        spawned.step(grads, k.rates.scaled(radius, k.rate_decay ** (step / steps)))
        if 2 * step >= steps:
            stats.add(result)
        if on_step:
            on_step(step, result.loss)
    return stats


def error_masks(
    model: Model, masks: list[np.ndarray], frame: int, views: Views, settings: DensificationSettings
) -> list[np.ndarray]:
    """Changed pixels that the Gaussians do not show at all: [h, w] bool of each training camera.

    Args:
        masks: [h, w] bool of each training camera, changed pixels.
    """
    import cv2

    g, out = model.gaussians(), []
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (settings.opening, settings.opening))
    for camera, mask in zip(views.train_cameras, masks, strict=True):
        error = np.abs(views.render(g, camera, frame) - blend(views.view(camera, frame), GREY))
        small = cv2.resize(np.maximum.reduce(cv2.split(error)), mask.shape[::-1], interpolation=cv2.INTER_AREA)
        wrong = (mask & (small > settings.error_min)).astype(np.uint8)
        out.append(cv2.morphologyEx(wrong, cv2.MORPH_OPEN, kernel) > 0)
    return out


def sweep_masked(
    wrong: list[np.ndarray], frame: int, views: Views, count: int, settings: PlaneSweepSettings, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` points on surfaces in the pixels `wrong` (from `error_masks`), and their colours; see `sweep`."""
    taken = [views.view(i, frame) for i in views.train_cameras]
    images = [(views.camera(i, frame), v.rgb, v.alpha) for i, v in zip(views.train_cameras, taken, strict=True)]
    return sweep(images, count, seed, settings, wrong)


def _children(
    model: Model, parents: torch.Tensor, rng: np.random.Generator, settings: TrainSettings
) -> dict[str, torch.Tensor]:
    """Attributes of one smaller Gaussian beside each of the `parents` ([K] index)."""
    params = {n: p[parents].clone() for n, p in model.params.items()}
    params["means"] += random_offset(params, rng)
    params["log_scales"] -= np.log(settings.keyframe.split_shrink)
    opacity = settings.densification.child_opacity
    params["logit_opacities"][:] = float(logit(opacity))
    return params
