"""Keyframe: one frame's Gaussians from its views. In: views, a starting model. Out: the model, densified and pruned.

3D Gaussian Splatting's recipe (Kerbl et al. 2023) shortened: Gaussians that the image pulls at are cloned when small
and split when large, those that hardly contribute to any view go. Spherical harmonics come in on the way, and go again
where they are not worth their bits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from .model import Model
from .settings import KeyframeSettings, TrainSettings
from .views import Views, photometric_loss, view_losses


class Statistics:
    """What densification asks for, gathered over the steps since the last round."""

    def __init__(self, count: int, mse_min: float):
        self.mse_min = mse_min
        self.pull = torch.zeros(count)  # sum of the screen-space gradient
        self.seen = torch.zeros(count)
        self.weight = torch.zeros(count)  # largest blending weight
        self.pulse = torch.zeros(count)  # see `worth`
        self.views = 0

    def add(self, result) -> None:
        """One step's statistics."""
        weight = torch.as_tensor(result.max_weight)
        self.pull += torch.as_tensor(result.grad2d)
        self.seen += weight > 0
        torch.maximum(self.weight, weight, out=self.weight)
        self.pulse += torch.as_tensor(result.grads["logit_opacities"]).square() * (
            3 * result.pixels / max(result.mse, self.mse_min)
        )
        self.views += 1

    def worth(self, opacities: torch.Tensor) -> torch.Tensor:
        """[N] by how much the picture would err more without each Gaussian of `opacities` [N], in shares of its error
        per Gaussian.

        The pixel gradients of the absolute error are signs, as good as random where training has converged: the
        squared gradient by a parameter is then the squared change of the picture by it (Hutchinson's estimator of a
        diagonal). The logit of an opacity changes the picture by (1 - opacity) of what the whole Gaussian does.
        """
        views = max(self.views, 1)
        return self.pulse * len(opacities) / views / (1 - opacities).clamp(min=1e-3).square()

    def mean_pull(self) -> torch.Tensor:
        """[N], over the steps that saw the Gaussian."""
        return self.pull / self.seen.clamp(min=1)


def train_keyframe(
    model: Model,
    views: Views,
    frame: int,
    settings: TrainSettings,
    *,
    steps: int,
    radius: float,
    densify: bool = True,
    on_step: Callable[[int, float], None] | None = None,
) -> float:
    """Optimises `model` in place against the views of `frame`; returns the image loss at the end, without
    the mask's.

    Args:
        steps: optimisation steps, one view each.
        radius: size of the subject in world units, scales the rate of the means.
        densify: also clone, split and prune.
        on_step: called with (step, loss).
    """
    k = settings.keyframe
    rng = np.random.default_rng([settings.seed, frame])
    stats, losses = Statistics(len(model), k.mse_min), []
    model.start_optimizer(views.backend, settings.adam)
    views.exposure.restart()
    views.extrinsics.restart()
    views.extrinsics.about(model.params["means"].numpy().mean(0, dtype=np.float64), radius)
    for step in range(steps):
        target = views.draw(frame)
        result = photometric_loss(model.params, target, settings, rng, views.backend)
        stats.add(result)
        losses.append(result.loss - settings.mask_lambda * result.mask)
        fade = step / max(steps - 1, 1)
        decay = k.rate_decay**fade
        if step >= k.appearance_from * steps:
            views.exposure.learn(target.index, result.grad_gain[0], decay)
            views.extrinsics.learn(target.index, model.params, result.grads, decay)
        means_rate = radius * k.rates.means * (k.means_rate_end / k.rates.means) ** fade
        model.step(result.grads, {**k.rates.scaled(radius, decay), "means": means_rate})
        if step == int(k.appearance_from * steps):
            model.set_degree(settings.sh_degree)
        if step == int(k.densify_until * steps):
            views.exposure.settle()
            views.extrinsics.settle()
        if step == int(k.thin_until * steps) and not harmonics_pay(model, views, frame, settings):
            model.set_degree(0)
        if densify and (step + 1) % k.densify_every == 0:
            if k.densify_from * steps < step < k.densify_until * steps:
                grow(model, stats, int(k.gaussians_share * settings.gaussians_max), rng, k)
            elif step >= k.densify_until * steps:
                prune(model, stats, k, thin=step < k.thin_until * steps)
            stats = Statistics(len(model), k.mse_min)
        if on_step:
            on_step(step, result.loss)
    return float(np.mean(losses[-len(views.train_cameras) :]))


def harmonics_pay(model: Model, views: Views, frame: int, settings: TrainSettings) -> bool:
    """Whether the training views of `frame` are so much worse without them that they are worth their bits."""
    plain = {**model.params, "shN": model.params["shN"][:, :0].contiguous()}
    whole, less = (np.mean([r.mse for r in view_losses(p, views, frame, settings)]) for p in (model.params, plain))
    k = settings.keyframe
    return less > (1 + k.harmonics_gain_min) * max(whole, k.mse_min)


def _shows(model: Model, stats: Statistics, settings: KeyframeSettings) -> torch.Tensor:
    """[N] bool: neither nearly transparent nor hidden in every view it was tried in."""
    opaque = torch.sigmoid(model.params["logit_opacities"]) > settings.prune_opacity
    return opaque & ((stats.weight > settings.prune_weight) | (stats.seen == 0))


@torch.no_grad()
def prune(model: Model, stats: Statistics, settings: KeyframeSettings, *, thin: bool = False) -> None:
    """Drops Gaussians that are nearly transparent or hidden in every view they were tried in; with `thin`, also those
    that are not worth their bits."""
    keep = _shows(model, stats, settings)
    if thin:
        worth = stats.worth(torch.sigmoid(model.params["logit_opacities"]))
        keep &= worth >= min(settings.contribution_min, torch.quantile(worth, settings.thinning).item())
    if keep.any():
        model.select(keep)


@torch.no_grad()
def grow(model: Model, stats: Statistics, most: int, rng: np.random.Generator, settings: KeyframeSettings) -> None:
    """One round of densification: the Gaussians with the strongest pull are split (large) or cloned (small)."""
    keep = _shows(model, stats, settings)
    pull = stats.mean_pull()
    pull[~keep] = 0
    room = max(0, min(int(settings.growth * len(model)), most - int(keep.sum())))
    chosen = torch.topk(pull, min(room, len(pull))).indices
    chosen = chosen[pull[chosen] > 0]
    children = {n: p[chosen].clone() for n, p in model.params.items()}
    spread = torch.exp(children["log_scales"])
    large = spread.max(1).values > torch.exp(model.params["log_scales"]).max(1).values.median()
    offset = random_offset(children, rng)
    children["means"] = (
        children["means"] + offset * torch.where(large, settings.split_offset, settings.clone_offset)[:, None]
    )
    parents = chosen[large]
    model.params["means"][parents] -= settings.split_offset * offset[large]
    model.params["log_scales"][parents] -= np.log(settings.split_shrink)
    children["log_scales"][large] -= np.log(settings.split_shrink)
    if keep.any():
        model.select(keep)
    model.append(children)


def random_offset(params: dict[str, torch.Tensor], rng: np.random.Generator) -> torch.Tensor:
    """[N, 3] from each mean to a point drawn from its Gaussian."""
    noise = torch.from_numpy(rng.standard_normal((len(params["means"]), 3)).astype(np.float32))
    return rotate(params["quats"], noise * torch.exp(params["log_scales"]))


def rotate(quats: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """[N, 4] wxyz (any length) applied to [N, 3]."""
    q = torch.nn.functional.normalize(quats, dim=-1)
    w, u = q[:, :1], q[:, 1:]
    cross = torch.linalg.cross(u, v, dim=-1)
    return v + 2 * (w * cross + torch.linalg.cross(u, cross, dim=-1))
