"""Fine-tuning, the optimisation: canonical attributes and residual coefficients of a group against all its frames.

The loss is that of the image and a rate term (V3's residual-entropy loss, made differentiable): the entropy of the
coefficients under noise-relaxed quantization at the step sizes of the stream, with a learned Laplace scale for each
attribute and temporal frequency. It pulls coefficients to zero that lower the image loss by less than they cost.
Canonical attributes have noise in place of their quantization and a rate term of their own (entropy_model.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..model.rotations import quat_conjugate, quat_multiply
from ..render.optimizer import Adam
from .finetune import GroupModel
from .settings import TrainSettings
from .views import Views, photometric_loss


class _Finetuner:
    """State of one run; `step` is one view of one frame."""

    def __init__(self, group: GroupModel, views: Views, frames: range, settings: TrainSettings, radius: float):
        self.group, self.views, self.frames, self.settings = group, views, frames, settings
        self.rng = np.random.default_rng([settings.seed, frames[0], 2])
        self.noise = torch.Generator().manual_seed(settings.seed)
        f = settings.finetune
        scales = {f"{n}.log_scale": s for n, s in group.log_scales.items()}
        self.leaves = {**group.coefficients, **scales}  # optimised besides the canonical attributes
        self.rates = dict.fromkeys(group.coefficients, f.coefficient_rate) | dict.fromkeys(scales, f.log_scale_rate)
        self.adam = Adam(views.backend, f.coefficient_adam)
        group.key.start_optimizer(views.backend, settings.adam)
        canonical = settings.keyframe.rates.scaled(radius, f.canonical_rate_share)
        canonical["means"] = f.canonical_means_rate * radius
        self.canonical_rates = canonical if group.known < len(group.key) else {}
        self.loss = 0.0  # running mean
        self.canonical_bits, _ = group.canonical_rate.gradients(group.key.params, self.noise)

    def step(self, t: int, decay: float) -> float:
        """One step on frame `t`, all learning rates times `decay`; returns the image loss."""
        f, group = self.settings.finetune, self.group
        residuals = {n: r.requires_grad_() for n, r in group.residuals(t).items()}
        params = group.frame(t, residuals, self.noise if f.canonical_noise else None)
        target = self.views.draw(self.frames[t])
        result = photometric_loss(params, target, self.settings, self.rng, self.views.backend)
        self.loss += (result.loss - self.loss) * (f.loss_smoothing if self.loss else 1.0)
        heads, seeds = [params[n] for n in group.coefficients], [result.grads[n] for n in group.coefficients]
        by_rate: dict[str, torch.Tensor] = {}
        if self.settings.rate_lambda and self.rng.integers(f.rate_every) == 0:
            bits, by_rate = self._rate_term()
            heads.append(bits)
            seeds.append(torch.ones(()))
        for leaf in self.leaves.values():
            leaf.grad = None
        torch.autograd.backward(heads, seeds)
        group.backward(t, residuals)
        by_leaf = {n: leaf.grad for n, leaf in self.leaves.items() if leaf.grad is not None}  # scales: with bits only
        self.adam.step(self.leaves, by_leaf, {n: self.rates[n] * decay for n in by_leaf})
        if self.canonical_rates:
            self._step_canonical(t, result.grads, by_rate, decay)
        return result.loss

    def _rate_term(self) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Weighted bits of the coefficients, and the weighted gradients of the canonical bits by attribute."""
        bits = self.group.bits(self.noise)
        weight = self._bit_weight(float(bits.detach()))
        if not self.canonical_rates:
            return weight * bits, {}
        self.canonical_bits, grads = self.group.canonical_rate.gradients(self.group.key.params, self.noise)
        return weight * bits, {n: self.settings.finetune.canonical_bit_weight * weight * g for n, g in grads.items()}

    def _bit_weight(self, bits: float) -> float:
        """Weight of a bit in the image loss, where the residuals take `bits`.

        Relative changes of bits and of loss count. All groups of a subject count the canonical bits, as if each stood
        alone, so that a bit has the same weight in all of them.
        """
        s = self.settings
        return s.finetune.rate_every * s.rate_lambda * self.loss / (bits + self.canonical_bits)

    def _step_canonical(self, t: int, grads: dict, by_rate: dict[str, torch.Tensor], decay: float) -> None:
        """One step of the new canonical Gaussians along the gradients at frame `t` and those of the rate term."""
        group = self.group
        back = quat_multiply(quat_conjugate(group.rotations[t]), grads["quats"])  # to the pose of the keyframe
        grads = {**grads, "quats": back}
        for n, g in grads.items():
            g += by_rate.get(n, 0)
            g[: group.known] = 0
        group.key.step(grads, {n: r * decay for n, r in self.canonical_rates.items()})


def finetune(
    group: GroupModel,
    views: Views,
    frames: range,
    settings: TrainSettings,
    *,
    radius: float,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Optimises the coefficients of `group` and its new canonical Gaussians over all `frames`, in place.

    Args:
        radius: of the moving Gaussians, world units.
        on_step: called with (step, loss).
    """
    steps = settings.finetune_steps * len(frames)
    run = _Finetuner(group, views, frames, settings, radius)
    order: list[int] = []
    for step in range(steps):
        # The first and the last frame come twice: they have neighbours on one side only.
        order = order or run.rng.permutation([0, *range(len(frames)), len(frames) - 1]).tolist()
        loss = run.step(order.pop(), settings.finetune.rate_decay ** (step / steps))
        if on_step:
            on_step(step, loss)
