"""Keyframe: the Gaussians of one frame from its views. In: views, a starting model. Out: the model, optimised in place.

The recipe of 3D Gaussian Splatting (Kerbl et al. 2023), shortened: of the Gaussians with the largest screen gradients
small ones are cloned and large ones split, and Gaussians with a small contribution to all views are pruned. Spherical
harmonics are added on the way, and removed again where they lower the error by less than their bits cost.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..model.rotations import quat_normalize, rotate
from ..render.backend import RenderLoss
from .model import REMOVED_LOGIT, Model
from .settings import KeyframeSettings, TrainSettings
from .views import Views, photometric_loss, view_losses


class Statistics:
    """Statistics of N Gaussians over the steps since the last round of densification.

    Args:
        mse_min: error of an image below which shares of it mean nothing.

    Attributes:
        screen_gradient: [N], sum of the screen-space gradients.
        seen: [N], steps that showed the Gaussian.
        max_weight: [N], largest blending weight.
        squared_opacity_gradient: [N], sum; in units of the squared error of the image.
        views: steps.
    """

    def __init__(self, count: int, mse_min: float):
        self.mse_min = mse_min
        self.screen_gradient, self.seen, self.max_weight = (torch.zeros(count) for _ in range(3))
        self.squared_opacity_gradient = torch.zeros(count)
        self.views = 0

    def add(self, result: RenderLoss) -> None:
        """One step's statistics."""
        weight = torch.as_tensor(result.max_weight)
        self.screen_gradient += torch.as_tensor(result.grad2d)
        self.seen += weight > 0
        torch.maximum(self.max_weight, weight, out=self.max_weight)
        self.squared_opacity_gradient += torch.as_tensor(result.grads["logit_opacities"]).square() * (
            3 * result.pixels / max(result.mse, self.mse_min)
        )
        self.views += 1

    def contribution(self, opacities: torch.Tensor) -> torch.Tensor:
        """Increase of the error without each Gaussian, [N], in shares of the error per Gaussian; `opacities`: [N].

        The pixel gradients of the absolute error are signs. Where training has converged they are as good as random,
        and the squared gradient by a parameter is the squared change of the image by it (Hutchinson's estimator of a
        diagonal). The logit of an opacity changes the image by (1 - opacity) times what the whole Gaussian does.
        """
        views = max(self.views, 1)
        return self.squared_opacity_gradient * len(opacities) / views / (1 - opacities).clamp(min=1e-3).square()

    def mean_screen_gradient(self) -> torch.Tensor:
        """[N], over the steps that showed the Gaussian."""
        return self.screen_gradient / self.seen.clamp(min=1)


def train_keyframe(
    model: Model,
    views: Views,
    frame: int,
    settings: TrainSettings,
    *,
    steps: int,
    radius: float,
    on_step: Callable[[int, float], None] | None = None,
) -> float:
    """Optimises `model` in place against the views of `frame`; returns the last image loss, without the mask term.

    Args:
        steps: optimisation steps, one view each.
        radius: size of the subject in world units, scales the learning rate of the means.
        on_step: called with (step, loss).
    """
    k = settings.keyframe
    rng = np.random.default_rng([settings.seed, frame])
    stats, losses = Statistics(len(model), k.mse_min), []
    few = k.dropout * min(1.0, k.dropout_views / len(views.train_cameras)) ** 2 if views.capture.has_alpha else 0.0
    densify_every = max(k.densify_every, round(k.densify_share * steps))
    model.start_optimizer(views.backend, settings.adam)
    views.reset_calibration(frame, model.params["means"].numpy().mean(0, dtype=np.float64), radius)
    for step in range(steps):
        target = views.draw(frame, picture_scale(step / steps, views.largest_side, k))
        dropped = few * step / steps
        params = _without_some(model.params, dropped, rng) if dropped else model.params
        result = photometric_loss(params, target, settings, rng, views.backend)
        stats.add(result)
        losses.append(result.loss - settings.mask_lambda * result.mask)
        progress = step / max(steps - 1, 1)
        decay = k.rate_decay**progress
        views.exposure.learn(target.index, result.grad_exposure[0], decay)
        if step >= k.appearance_from * steps:
            views.extrinsics.learn(target.index, model.params, result.grads, decay)
        result.grads["shN"].add_(model.params["shN"], alpha=k.harmonics_weight / len(model))
        means_rate = radius * k.rates["means"] * (k.means_rate_end / k.rates["means"]) ** progress
        model.step(result.grads, {**k.rates.scaled(radius, decay), "means": means_rate})
        if step == int(k.appearance_from * steps):
            model.set_degree(settings.sh_degree)
        if step == int(k.thin_until * steps):
            model.set_degree(harmonics_degree(model, views, frame, settings))
        if (step + 1) % densify_every == 0:
            if k.densify_from * steps < step < k.densify_until * steps:
                densify(model, stats, int(k.gaussians_share * settings.gaussians_max), rng, k)
            elif step >= k.densify_until * steps:
                prune(model, stats, k, thin=step < k.thin_until * steps)
            stats = Statistics(len(model), k.mse_min)
        if on_step:
            on_step(step, result.loss)
    return float(np.mean(losses[-len(views.train_cameras) :]))


def _without_some(params: dict[str, torch.Tensor], share: float, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """The Gaussians of one step, a random share of them left out, so that what holds only from where a training camera
    stands falls apart (DropGaussian, Park et al. 2025)."""
    gone = torch.from_numpy(rng.random(len(params["means"]), np.float32) < share)
    return {**params, "logit_opacities": torch.where(gone, REMOVED_LOGIT, params["logit_opacities"])}


def picture_scale(progress: float, side: int, settings: KeyframeSettings) -> float:
    """Scale of the pictures at a share of the steps: coarse ones first, whose shapes are large and steps cheap
    (DashGaussian, Chen et al. 2025). Halves, so that a picture is made small once.

    Args:
        side: of the largest picture, pixels.
    """
    if progress >= settings.full_size_from:
        return 1.0
    coarsest = min(1.0, settings.coarse_side / side)
    wanted = coarsest ** (1 - progress / settings.full_size_from)
    return 0.5 ** int(np.log2(1 / wanted) + 0.5)


def harmonics_degree(model: Model, views: Views, frame: int, settings: TrainSettings) -> int:
    """The lowest degree of spherical harmonics with which the error of the training views of `frame` grows by less than
    the bits of the others are worth."""
    k, shN = settings.keyframe, model.params["shN"]

    def error(count: int) -> float:
        params = {**model.params, "shN": shN[:, :count].contiguous()}
        return float(np.mean([r.mse for r in view_losses(params, views, frame, settings)]))

    whole = max(error(shN.shape[1]), k.mse_min)
    for degree in range(model.degree):
        count = (degree + 1) ** 2 - 1
        if error(count) <= (1 + k.harmonics_gain_min * (shN.shape[1] - count)) * whole:
            return degree
    return model.degree


def _visible(model: Model, stats: Statistics, settings: KeyframeSettings) -> torch.Tensor:
    """[N] bool: not nearly transparent, and not hidden in every view that was rendered."""
    opaque = torch.sigmoid(model.params["logit_opacities"]) > settings.prune_opacity
    return opaque & ((stats.max_weight > settings.prune_weight) | (stats.seen == 0))


@torch.no_grad()
def prune(model: Model, stats: Statistics, settings: KeyframeSettings, *, thin: bool = False) -> None:
    """Removes Gaussians that are not visible; with `thin`, also those with a small contribution."""
    keep = _visible(model, stats, settings)
    if thin:
        contribution = stats.contribution(torch.sigmoid(model.params["logit_opacities"]))
        bound = torch.quantile(contribution, settings.thinning).item()
        keep &= contribution >= min(settings.contribution_min, bound)
    if keep.any():
        model.select(keep)


@torch.no_grad()
def densify(model: Model, stats: Statistics, most: int, rng: np.random.Generator, settings: KeyframeSettings) -> None:
    """One round of densification, up to `most` Gaussians: those with large screen gradients are split (large ones) or
    cloned (small ones). Gaussians that are not visible are removed."""
    keep = _visible(model, stats, settings)
    gradient = stats.mean_screen_gradient()
    gradient[~keep] = 0
    room = max(0, min(int(settings.growth * len(model)), most - int(keep.sum())))
    chosen = torch.topk(gradient, min(room, len(gradient))).indices
    chosen = chosen[gradient[chosen] > settings.gradient_min]
    children = split_or_clone(model, chosen, rng, settings)
    if keep.any():
        model.select(keep)
    model.append(children)


@torch.no_grad()
def split_or_clone(
    model: Model, chosen: torch.Tensor, rng: np.random.Generator, settings: KeyframeSettings
) -> dict[str, torch.Tensor]:
    """A second Gaussian for each of `chosen` ([K] index): large ones are split, in place, small ones cloned."""
    children = {n: p[chosen].clone() for n, p in model.params.items()}
    spread = torch.exp(children["log_scales"])
    large = spread.max(1).values > torch.exp(model.params["log_scales"]).max(1).values.median()
    offset = random_offset(children, rng)
    share = torch.where(large, settings.split_offset, settings.clone_offset)
    children["means"] = children["means"] + offset * share[:, None]
    parents = chosen[large]
    model.params["means"][parents] -= settings.split_offset * offset[large]
    model.params["log_scales"][parents] -= np.log(settings.split_shrink)
    children["log_scales"][large] -= np.log(settings.split_shrink)
    return children


def random_offset(params: dict[str, torch.Tensor], rng: np.random.Generator) -> torch.Tensor:
    """[N, 3] offset from each mean to a point drawn from its Gaussian."""
    noise = torch.from_numpy(rng.standard_normal((len(params["means"]), 3)).astype(np.float32))
    return rotate(quat_normalize(params["quats"]), noise * torch.exp(params["log_scales"]))
