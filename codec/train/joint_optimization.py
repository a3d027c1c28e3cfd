"""Fine-tuning, the optimisation: canonical attributes, motion and residual coefficients of a group against all its
frames. A field over place and time (motion_field.py) corrects the tracked motion of the nodes, beside variables of each
node and frame.

The loss is the image loss and a rate term (V3's residual-entropy loss, made differentiable): the entropy of the
coefficients under noise-relaxed quantization at the step sizes of the stream, with a learned Laplace scale for each
attribute and temporal frequency. It pulls coefficients to 0 that lower the image loss by less than their bits cost.
Canonical attributes have noise in place of their quantization and a rate term of their own (entropy_model.py). The
exposure of each camera is learned in each frame, since that of a keyframe may drift. A step uses the gradients of some
views of one frame. While these are rendered, the step before is applied: gradients are one step old.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ..render.backend import PendingLoss
from ..render.optimizer import Adam, TrajectoryAdam
from .finetune import Frame, GroupModel
from .keyframe import Statistics, contributes, gradient_min, split_or_clone
from .motion_field import MotionField
from .settings import FinetuneSettings, TrainSettings
from .views import Target, Views, add_harmonics_prior, start_photometric_loss

SIZE_PASSES = 8  # passes over the frames of a group that bring sizes to their bound
SIZE_EXCESS = 0.01  # natural log of a size over its bound that is negligible


class _Finetuner:
    """State of one run; a `step` uses some views of one frame."""

    def __init__(self, group: GroupModel, views: Views, frames: range, settings: TrainSettings, radius: float):
        self.group, self.views, self.frames, self.settings = group, views, frames, settings
        self.rng = np.random.default_rng([settings.seed, frames[0], 2])
        self.generator = torch.Generator().manual_seed(settings.seed)
        f, backend = settings.finetune, views.backend
        self.coefficients = TrajectoryAdam(backend, f.coefficient_adam)
        self.scales, self.nodes = Adam(backend, f.coefficient_adam), Adam(backend, f.coefficient_adam)
        group.key.start_optimizer(backend, settings.adam, views.size_bound)
        if settings.motion_field.finetune:
            m, adam = settings.motion_field, f.coefficient_adam
            group.field = MotionField(group.graph.nodes, radius, group.frames, m, settings.seed, backend, adam)
        canonical = settings.keyframe.rates.scaled(radius, f.canonical_rate_share)
        canonical["means"] = f.canonical_means_rate * radius
        self.canonical_rates = canonical if group.known < len(group.key) else {}
        self.node_rates = {"turn": f.node_rotation_rate, "shift": f.node_translation_rate * radius}
        self.loss = 0.0  # loss of a step, running mean
        self.steps = 0
        self._look_at_gaussians()
        self.started: tuple[int, Frame, list[Target], PendingLoss, float] | None = None  # the pending step
        self.bits = sum(self._step_coefficients(0, None, 0.0, 0.0))

    def step(self, t: int, decay: float) -> float:
        """Starts to render some views of frame `t` of the group, whose step has all learning rates times `decay`, and
        meanwhile applies the step before; returns the running mean of the loss of a view."""
        frame, backend = self.group.frame(t, self.views.backend, self.noise), self.views.backend
        targets = [self.views.draw(self.frames[t]) for _ in range(self.settings.finetune.views)]
        pending = start_photometric_loss(frame.params, targets, self.settings, self.rng, backend)
        self.finish()
        self.started = t, frame, targets, pending, decay
        return self.loss / self.settings.finetune.views

    def finish(self) -> None:
        """Applies the step of the views that were started last."""
        if self.started is None:
            return
        t, frame, targets, pending, decay = self.started
        self.started = None
        f, group, result = self.settings.finetune, self.group, pending()
        self.loss += (result.loss - self.loss) * (f.loss_smoothing if self.loss else 1.0)
        self.statistics.add(result, f.views)
        for target, by_exposure in zip(targets, result.grad_exposure, strict=True):
            self.views.exposure.learn_in(self.frames[t], target.index, by_exposure, decay)
        residuals, canonical, by_rotations = group.gradients(frame, result.grads)
        add_harmonics_prior(canonical, group.key.params, self.settings, f.views)
        self._step_nodes(t, frame, result.grads["means"], by_rotations, decay)
        if self.settings.rate_lambda and self.rng.integers(f.rate_every) == 0:
            weight = f.rate_every * self._bit_weight()
            self.bits = sum(self._step_coefficients(t, residuals, weight, decay))
        else:
            self._step_coefficients(t, residuals, 0.0, decay)
        group.limit_sizes(t, frame, self.views.size_bound)
        if self.canonical_rates:
            self._step_canonical(canonical, decay)

    def limit_sizes(self) -> None:
        """Brings all Gaussians to their size bound in all frames, as far as their temporal frequencies allow. A
        correction in one frame may break the bound in another, so there are several passes."""
        group, backend, bound = self.group, self.views.backend, self.views.size_bound
        if bound is None:
            return
        for _ in range(SIZE_PASSES):
            if max(group.limit_sizes(t, group.frame(t, backend), bound) for t in range(group.frames)) < SIZE_EXCESS:
                return

    def _step_canonical(self, grads: dict[str, torch.Tensor], decay: float) -> None:
        """One step of the new canonical Gaussians along the gradients of the image loss and of the rate term; that of
        the rate term is at most `canonical_rate_every` steps old."""
        s, group = self.settings, self.group
        if self.steps and self.steps % s.finetune.canonical_rate_every == 0:
            self._draw_canonical()
        self.steps += 1
        weight = s.finetune.canonical_bit_weight * self._bit_weight()
        short, slower = self.short_lived
        before = {n: p[short] for n, p in group.key.params.items()}
        for n, g in grads.items():
            if weight and n in self.by_rate:
                g = g.add(self.by_rate[n], alpha=weight)
            g[: group.known] = 0
            grads[n] = g
        group.key.step(grads, {n: r * decay for n, r in self.canonical_rates.items()})
        for n, p in group.key.params.items():
            p[short] = before[n].lerp(p[short], slower.view(-1, *[1] * (p.dim() - 1)))

    def change_topology(self) -> None:
        """Removes new Gaussians with a small contribution to all frames together, and splits or clones those whose
        screen gradient is still large (parts that the keyframe did not show, or that a motion has stretched). Does
        nothing if too few views have been drawn."""
        self.finish()
        group, k, stats = self.group, self.settings.keyframe, self.statistics
        if stats.views < self.settings.finetune.topology_views * len(self.views.train_cameras):
            return
        opacities = torch.sigmoid(group.key.params["logit_opacities"])
        contribution = stats.contribution(opacities) / self._drawn_share()  # to the views of its lifetime
        keep = contributes(contribution, k) & (stats.max_weight > k.prune_weight)
        keep[: group.known] = True
        gradient = stats.mean_screen_gradient() * keep
        room = min(int(self.settings.finetune.growth * len(keep)), self.settings.gaussians_max - int(keep.sum()))
        chosen = torch.topk(gradient, max(0, min(room, len(gradient)))).indices
        chosen = chosen[(gradient[chosen] > gradient_min(len(keep), k)) & (chosen >= group.known)]
        children = split_or_clone(group.key, chosen, self.rng, k)
        group.append(children, chosen)
        self.coefficients.append(len(chosen))
        keep = torch.cat([keep, torch.ones(len(chosen), dtype=torch.bool)])
        if keep.any():
            group.select(keep)
            self.coefficients.select(keep.numpy())
        self._look_at_gaussians()

    def _look_at_gaussians(self) -> None:
        """Resets the state that depends on the set of Gaussians."""
        self.statistics = Statistics(len(self.group.key), self.settings.keyframe.mse_min)
        self.short_lived = self._short_lived()
        self._draw_canonical()

    def _drawn_share(self) -> torch.Tensor:
        """[N], share of the drawn views in which each Gaussian lives."""
        often = torch.bincount(torch.tensor(_round_of_frames(self.group.frames))).float()
        until = torch.cat([torch.zeros(1), often.cumsum(0)])
        return (until[self.group.end] - until[self.group.start]) / until[-1]

    def _short_lived(self) -> tuple[torch.Tensor, torch.Tensor]:
        """[K] index of the Gaussians that live in few frames, and [K] factors of their steps. After each gradient of a
        Gaussian that a share of the frames shows, Adam goes on for 1 / sqrt(share) steps: without the factors, sizes
        doubled for one picture."""
        factor = self._drawn_share() / self.settings.finetune.short_life
        short = torch.nonzero(factor < 1)[:, 0]
        return short, factor[short]

    def _draw_canonical(self) -> None:
        """Sets the noise and the bits of the canonical Gaussians, which are held for some steps."""
        self.noise = self._noise()
        rate = self.group.canonical_rate
        self.canonical_bits, self.by_rate = rate.gradients(self.group.key.params, self.generator)

    def _noise(self) -> dict[str, torch.Tensor] | None:
        """Uniform noise in place of the quantization of the new canonical Gaussians; None: there is none."""
        group = self.group
        if not self.canonical_rates or not self.settings.finetune.canonical_noise:
            return None
        noise = {}
        for n, step in group.canonical_steps.items():
            uniform = self.rng.random(group.key.params[n].shape, np.float32)
            uniform[: group.known] = 0.5
            noise[n] = torch.from_numpy(step * (uniform - np.float32(0.5)))
        return noise

    def _step_coefficients(self, t: int, residuals: dict | None, weight: float, decay: float) -> list[float]:
        """One step of all coefficients along the gradients by the residuals of frame `t` (None: 0) and by the bits,
        each with `weight` in the loss; returns the bits of each attribute."""
        f, group, bits = self.settings.finetune, self.group, []
        rate = f.coefficient_rate * decay
        for n, c in group.coefficients.items():
            grad = np.zeros(c.shape[1:], np.float32) if residuals is None else residuals[n]
            price = None
            if weight or residuals is None:
                noise = self.rng.random(grad.size + len(c), np.float32) - np.float32(0.5)
                price = (weight, np.exp(group.log_scales[n]), noise)
            of_each = self.coefficients.step(n, c, grad, group.at(n, t), price, rate)
            if weight:
                by_scale = {n: (weight * of_each[:, 1]).astype(np.float32)}
                self.scales.step(group.log_scales, by_scale, {n: f.log_scale_rate * decay})
            bits.append(float(of_each[:, 0].sum()))
        return bits

    def _step_nodes(
        self, t: int, frame: Frame, by_means: torch.Tensor, by_rotations: torch.Tensor, decay: float
    ) -> None:
        """One step of the nodes at frame `t`, along the gradients by the carried Gaussians and that of the rigidity
        term."""
        if not self.node_rates["turn"] and self.group.field is None:
            return
        group, rigidity = self.group, self.settings.finetune.views * self.settings.rigidity
        by_turns, by_shifts = group.by_nodes(t, frame, (by_means, by_rotations), rigidity)
        values = {f"turn {t}": group.turns[t], f"shift {t}": group.shifts[t]}
        grads = {f"turn {t}": by_turns, f"shift {t}": by_shifts}
        self.nodes.step(values, grads, {n: decay * self.node_rates[n.split()[0]] for n in values})
        if frame.by_field is not None:
            group.field.step(frame.by_field, by_turns, by_shifts, decay)

    def _bit_weight(self) -> float:
        """Weight of a bit in the image loss.

        Relative changes of bits and of the loss are compared, so that a bit is cheap where there are many bits. Every
        group of a subject counts the canonical bits, as if it stood alone, so that a bit has the same weight in all
        groups. Residual bits count up to the usual number of a group: otherwise, with fast motion or few views, each
        residual bit would make the next one cheaper, and frames would share less, although they see more together.
        """
        s = self.settings
        usual = s.finetune.residual_share * self.group.frames * self.canonical_bits
        return s.rate_lambda * self.loss / (min(self.bits, usual) + self.canonical_bits)


def finetune(
    group: GroupModel,
    views: Views,
    frames: range,
    settings: TrainSettings,
    *,
    radius: float,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Optimises the coefficients of `group`, its nodes and its new canonical Gaussians over all `frames`, in place.

    Args:
        radius: of the moving Gaussians, world units.
        on_step: called with (step, loss) for each view of a step.
    """
    steps = -(-views_to_draw(group, settings) // settings.finetune.views)
    run = _Finetuner(group, views, frames, settings, radius)
    order: list[int] = []
    larger = settings.finetune.views**0.5  # rates, since the gradient of several views has less noise
    for step in range(steps):
        order = order or run.rng.permutation(_round_of_frames(len(frames))).tolist()
        if step == round(settings.finetune.topology_at * steps):
            run.change_topology()
        loss = run.step(order.pop(), larger * _rate(step / steps, settings.finetune))
        for _ in range(settings.finetune.views if on_step else 0):
            on_step(step, loss)
    run.finish()
    run.limit_sizes()
    views.exposure.go_on(frames[-1])


def views_to_draw(group: GroupModel, settings: TrainSettings) -> int:
    """Number of views for the fine-tuning of a group; a short one after a keyframe has those of `frames_min` frames."""
    least = 0 if group.known else settings.finetune.frames_min
    return round(settings.finetune_steps * max(group.frames, least))


def _rate(done: float, settings: FinetuneSettings) -> float:
    """Factor of the learning rates after a share `done` of the steps."""
    rising = min(1.0, done / settings.warmup) if settings.warmup else 1.0
    return rising * settings.rate_decay**done


def _round_of_frames(frames: int) -> list[int]:
    """The frames of a group, in each round of steps. The first and the last one come twice: they have neighbours on one
    side only."""
    return [0, *range(frames), frames - 1]
