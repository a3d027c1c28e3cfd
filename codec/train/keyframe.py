"""Keyframe: the Gaussians of one frame from its views. In: views, a starting model. Out: the model, optimised in place.

The recipe of 3D Gaussian Splatting (Kerbl et al. 2023), shortened: of the Gaussians with the largest screen gradients
small ones are cloned and large ones split, and Gaussians with a small contribution to all views are pruned. Spherical
harmonics are added on the way, and removed again where they lower the error by less than their bits cost. Without
masks opacities decay and transparent Gaussians move at random (3DGS-MCMC, Kheradmand et al. 2024): few views of a room
do not contradict floaters before the cameras. The decay is faster near the cameras: a black floater before a black
background causes no error in any training view, but hides the subject in views between the cameras. While one view is
rendered, the step of the view before is applied: gradients are one step old. Teachers, which are other models from the
same start, give the model views between the cameras as long as it grows (pseudo_views.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..model.rotations import quat_normalize, rotate
from ..render.backend import PendingLoss, RenderLoss
from .model import REMOVED_LOGIT, Model
from .pseudo_views import between, pseudo_view
from .settings import KeyframeSettings, TrainSettings
from .views import Target, Views, add_harmonics_prior, shrink, start_photometric_loss, view_losses

NOISE_POWER = 4  # power of the transparency in the noise of positions


class Statistics:
    """Statistics of N Gaussians over the steps since the last round of densification.

    Args:
        mse_min: mean squared error of an image below which shares of it have no meaning.

    Attributes:
        screen_gradient: [N], sum of the screen-space gradients.
        seen: [N], views that showed the Gaussian.
        max_weight: [N], largest blending weight.
        squared_opacity_gradient: [N], sum of the squares; in units of the squared error of the image.
        views: number of views.
    """

    def __init__(self, count: int, mse_min: float):
        self.mse_min = mse_min
        self.screen_gradient, self.seen, self.max_weight = (torch.zeros(count) for _ in range(3))
        self.squared_opacity_gradient = torch.zeros(count)
        self.views = 0

    def add(self, result: RenderLoss, views: int = 1) -> None:
        """Adds the statistics of one step, whose loss is the sum over `views` views."""
        weight = torch.as_tensor(result.max_weight)
        self.screen_gradient += torch.as_tensor(result.grad2d)
        self.seen.add_(weight > 0, alpha=views)
        torch.maximum(self.max_weight, weight, out=self.max_weight)
        self.squared_opacity_gradient += torch.as_tensor(result.grads["logit_opacities"]).square() * (
            3 * result.pixels / views / max(result.mse, self.mse_min)
        )
        self.views += views

    def contribution(self, opacities: torch.Tensor) -> torch.Tensor:
        """Increase of the error without each Gaussian, [N], in shares of the error; `opacities`: [N].

        The pixel gradients of the absolute error are signs. Where training has converged they are almost random,
        and the squared gradient by a parameter is the squared change of the image by it (Hutchinson's estimator of a
        diagonal). The logit of an opacity changes the image by (1 - opacity) times the change by the whole Gaussian.
        """
        views = max(self.views, 1)
        return self.squared_opacity_gradient / views / (1 - opacities).clamp(min=1e-3).square()

    def mean_screen_gradient(self) -> torch.Tensor:
        """[N], over the views that showed the Gaussian."""
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
    """Optimises `model` in place against the views of `frame`; returns the last image loss (`image_loss`).

    Args:
        steps: optimisation steps, one view each.
        radius: size of the subject in world units, scales the learning rate of the means.
        on_step: called with (step, loss), for the steps of teachers, too.
    """
    k = settings.keyframe
    cameras = between([views.capture.camera(i, frame) for i in views.train_cameras]) if k.teachers else []
    teachers = [Model(model.params) for _ in range(k.teachers if cameras else 0)]
    for number, teacher in enumerate(teachers, 1):
        _optimize(_Run(teacher, views, frame, settings, k.of_teacher(steps), radius, teacher=number), on_step)
    models, opaque = [t.params for t in teachers], not views.capture.has_alpha
    shown = [pseudo_view(camera, models, opaque, views.backend) for camera in cameras]
    run = _Run(model, views, frame, settings, steps, radius, shown)
    _optimize(run, on_step)
    return float(np.mean(run.losses[-len(views.train_cameras) :]))


def _optimize(run: _Run, on_step: Callable[[int, float], None] | None) -> None:
    k, steps, settings = run.settings.keyframe, run.steps, run.settings
    densify_every = max(k.densify_every, round(k.densify_share * steps))
    for step in range(steps):
        run.step(step)
        if step == int(k.appearance_from * steps):
            run.set_degree(settings.sh_degree)
        if step == int(k.thin_until * steps):
            run.set_degree(None)
        if (step + 1) % densify_every == 0:
            run.change_topology(step)
        if on_step:
            on_step(step, run.losses[-1] if run.losses else math.inf)
    run.finish()


@dataclass(frozen=True)
class _View:
    """A view that is being rendered: its step, its target, and its pending loss."""

    step: int
    target: Target
    pending: PendingLoss


class _Run:
    """State of one keyframe's optimisation.

    Args:
        pseudo: views between the cameras.
        teacher: number of the teacher that is trained; 0: it is the keyframe itself.

    Attributes:
        losses: image loss of each step along a view of the capture, without the terms of mask and depth.
    """

    def __init__(
        self,
        model: Model,
        views: Views,
        frame: int,
        settings: TrainSettings,
        steps: int,
        radius: float,
        pseudo: Sequence[Target] = (),
        teacher: int = 0,
    ):
        k = settings.keyframe
        self.model, self.views, self.frame, self.settings = model, views, frame, settings
        self.steps, self.radius, self.pseudo, self.losses = steps, radius, pseudo, []
        self.rng = np.random.default_rng([settings.seed, frame, teacher])
        self._order: list[int] = []  # of the round, numbers of pseudo views, then those of views of the capture
        self.statistics = Statistics(len(model), k.mse_min)
        self._started: _View | None = None
        self._opacity_decay = self._decay_of_opacities()
        model.start_optimizer(views.backend, settings.adam, views.size_bound)
        views.reset_calibration(frame, model.params["means"].numpy().mean(0, dtype=np.float64), radius)

    def step(self, step: int) -> None:
        """Starts to render one view, and meanwhile applies the step of the view before."""
        s = self.settings
        target = self._draw(step / self.steps)
        params = _without_some(self.model.params, s.keyframe.dropout * step / self.steps, self.rng)
        pending = start_photometric_loss(params, [target], s, self.rng, self.views.backend)
        self.finish()
        self._started = _View(step, target, pending)

    def finish(self) -> None:
        """Applies the last step that was started."""
        if self._started is None:
            return
        view, self._started = self._started, None
        k, model, views, result = self.settings.keyframe, self.model, self.views, view.pending()
        self.statistics.add(result)
        progress = view.step / max(self.steps - 1, 1)
        decay = k.rate_decay**progress
        if view.target.index is not None:
            self.losses.append(result.image_loss)
            views.exposure.learn(view.target.index, result.grad_exposure[0], decay)
            if view.step >= k.appearance_from * self.steps:
                views.extrinsics.learn(view.target.index, model.params, result.grads, decay)
        add_harmonics_prior(result.grads, model.params, self.settings)
        if k.opacity_decay:
            add_opacity_decay(result.grads, model.params, self._opacity_decay)
        means_decay = (k.means_rate_end / k.rates["means"]) ** progress
        means_rate = self.radius * k.rates["means"] * means_decay
        model.step(result.grads, {**k.rates.scaled(self.radius, decay), "means": means_rate})
        if k.position_noise:
            move_at_random(model.params, k.position_noise * means_decay, self.rng)

    def _draw(self, progress: float) -> Target:
        """The next view after a share `progress` of the steps. As long as Gaussians are added, each round has every
        pseudo view once, between as many views of the capture as there are cameras; later ones have the capture's
        alone, which are sharper."""
        k = self.settings.keyframe
        scale = picture_scale(progress, self.views.largest_side, k)
        if not self.pseudo or progress >= k.densify_until:
            return self.views.draw(self.frame, scale)
        if not self._order:
            self._order = self.rng.permutation(len(self.pseudo) + len(self.views.train_cameras)).tolist()
        number = self._order.pop()
        if number >= len(self.pseudo):
            return self.views.draw(self.frame, scale)
        return self.pseudo[number] if scale == 1 else shrink(self.pseudo[number], scale)

    def set_degree(self, degree: int | None) -> None:
        """Gives the Gaussians harmonics of this degree; None: of the degree that pays for its bits."""
        self.finish()
        if degree is None:
            degree = harmonics_degree(self.model, self.views, self.frame, self.settings)
        self.model.set_degree(degree)

    def change_topology(self, step: int) -> None:
        """Densification in the first part of the steps, pruning after it."""
        self.finish()
        s, k = self.settings, self.settings.keyframe
        if k.densify_from * self.steps < step < k.densify_until * self.steps:
            densify(self.model, self.statistics, int(k.gaussians_share * s.gaussians_max), self.rng, k)
        elif step >= k.densify_until * self.steps:
            prune(self.model, self.statistics, k, thin=step < k.thin_until * self.steps)
        self.statistics = Statistics(len(self.model), k.mse_min)
        self._opacity_decay = self._decay_of_opacities()

    def _decay_of_opacities(self) -> torch.Tensor:
        """Weight of each opacity in the loss, [N], times N."""
        k, means = self.settings.keyframe, self.model.params["means"]
        if not k.opacity_decay:
            return torch.zeros(len(means))
        near = self.views.nearness(means.numpy(), self.frame, k.near_margin)
        return torch.from_numpy(k.opacity_decay * near**k.near_power).float()


def add_opacity_decay(grads: dict[str, torch.Tensor], params: dict[str, torch.Tensor], weights: torch.Tensor) -> None:
    """Adds to the gradients those of the mean of all opacities times their `weights` [N]."""
    opacities = torch.sigmoid(params["logit_opacities"])
    grads["logit_opacities"].add_(weights * opacities * (1 - opacities), alpha=1 / len(opacities))


def move_at_random(params: dict[str, torch.Tensor], share: float, rng: np.random.Generator) -> None:
    """Moves each Gaussian by `share` of a random offset drawn from it, times its transparency to the power of
    `NOISE_POWER`: transparent Gaussians try other places."""
    transparency = 1 - torch.sigmoid(params["logit_opacities"])
    params["means"].addcmul_(random_offset(params, rng), share * transparency.pow(NOISE_POWER)[:, None])


def _without_some(params: dict[str, torch.Tensor], share: float, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """The Gaussians of one step without a random share of them, so that structures that are right only from the
    training cameras fall apart (DropGaussian, Park et al. 2025)."""
    if not share:
        return params
    gone = torch.from_numpy(rng.random(len(params["means"]), np.float32) < share)
    return {**params, "logit_opacities": torch.where(gone, REMOVED_LOGIT, params["logit_opacities"])}


def picture_scale(progress: float, side: int, settings: KeyframeSettings) -> float:
    """Scale of the pictures after a share `progress` of the steps: coarse pictures first, which show large shapes in
    cheap steps (DashGaussian, Chen et al. 2025). Powers of 1/2, so that a picture is shrunk to few sizes, each once.

    Args:
        side: of the largest picture, pixels.
    """
    if progress >= settings.full_size_from:
        return 1.0
    coarsest = min(1.0, settings.coarse_side / side)
    wanted = coarsest ** (1 - progress / settings.full_size_from)
    return 0.5 ** int(np.log2(1 / wanted) + 0.5)


def harmonics_degree(model: Model, views: Views, frame: int, settings: TrainSettings) -> int:
    """The lowest degree of spherical harmonics at which the error of the training views of `frame` grows by less than
    the bits of the removed coefficients are worth."""
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


def price(count: int, settings: KeyframeSettings) -> float:
    """Share of the error that each of `count` Gaussians must take away."""
    return max(settings.price, 1 / max(count, 1))


def contributes(contribution: torch.Tensor, settings: KeyframeSettings) -> torch.Tensor:
    """[N] bool: Gaussians whose contribution is large enough; one round removes a share `thinning` at most."""
    most = torch.quantile(contribution, settings.thinning).item()
    return contribution >= min(price(len(contribution), settings), most)


def gradient_min(count: int, settings: KeyframeSettings) -> float:
    """Screen gradient from which one of `count` Gaussians is split or cloned, halves of the image."""
    return settings.gradient_unit * math.sqrt(price(count, settings) * count)


@torch.no_grad()
def prune(model: Model, stats: Statistics, settings: KeyframeSettings, *, thin: bool = False) -> None:
    """Removes Gaussians that are not visible; with `thin`, also those with a small contribution."""
    keep = _visible(model, stats, settings)
    if thin:
        keep &= contributes(stats.contribution(torch.sigmoid(model.params["logit_opacities"])), settings)
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
    chosen = chosen[gradient[chosen] > gradient_min(len(model), settings)]
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
