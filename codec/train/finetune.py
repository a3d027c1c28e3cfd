"""Joint fine-tuning of a group: one canonical set and sparse residual trajectories that fit all frames and views.

The model is the codec's own: frame t = canonical carried by the motion + sum_k basis[k, t] * c_k for every attribute
that may change. All frames share the canonical attributes, so each Gaussian is seen by frames x views images instead of
views; what does not pay is pulled to zero by the rate term: the entropy of the coefficients under noise-relaxed
quantization at the stream's own step sizes, with a learned Laplace scale for each attribute and temporal frequency
(V3's residual-entropy loss, made differentiable). The temporal term keeps consecutive frames alike.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gscodec.bitstream.quantization import Steps, trajectory_step
from gscodec.bitstream.transform import dct_basis
from gscodec.gaussians import Gaussians
from gscodec.render.workspace import Workspace
from gscodec.train.keyframe import RATES
from gscodec.train.model import Model
from gscodec.train.motion import quat_multiply, quat_to_matrix
from gscodec.train.settings import TrainSettings
from gscodec.train.views import Views, compare

# attribute -> (channels, temporal frequencies that may be used)
RESIDUALS = {"means": (3, 8), "quats": (3, 4), "sh0": (3, 4)}
RESIDUAL_RATE = {"means": 0.05, "quats": 0.05, "sh0": 0.05}  # in steps of the stream a step of the optimiser
LAPLACE_RATE = 0.02
CARRIERS = 12  # neighbours whose motions are averaged
MEANS_RATE = 4e-5  # of the canonical means, times the radius
RATE_EVERY = 4  # the rate term has every coefficient, an image few of them: once in so many steps, so much stronger


def laplace_bits(x: torch.Tensor, log_scale: torch.Tensor) -> torch.Tensor:
    """Bits of integers under a Laplace law of scale exp(log_scale), at real x (the relaxed quantizer's output).

    Probability of the unit interval around x (Balle et al. 2017), computed without cancellation.
    """
    b = torch.exp(log_scale)
    a = x.abs()
    near = a.clamp(max=0.5)  # keeps the branch that is not taken, and its gradient, finite
    inner = 1 - 0.5 * (torch.exp((near - 0.5) / b) + torch.exp(-(near + 0.5) / b))
    tail = torch.exp(-(a - 0.5).clamp(min=0) / b) * 0.5 * (-torch.expm1(-1 / b))
    p = torch.where(a < 0.5, inner, tail)
    far = (a - 0.5).clamp(min=0) / b / np.log(2) + 1 - torch.log2(-torch.expm1(-1 / b))  # where p underflows
    return torch.where(p > 1e-9, -torch.log2(p.clamp(min=1e-9)), far)


def carry(x: torch.Tensor, means: torch.Tensor, turned: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """What of a tracked motion neighbours agree on: each Gaussian as its neighbours' rigid motions would carry it.

    That much the stream's nodes will carry too; the rest is residual, and has to pay for its bits.

    Args:
        x: [N, 3] keyframe positions; means: [T, N, 3]; turned: [T, N, 4] unit.
    """
    from scipy.spatial import cKDTree

    k = min(CARRIERS, len(x))
    j = torch.from_numpy(cKDTree(x.numpy()).query(x.numpy(), k)[1].astype(np.int64).reshape(len(x), k))
    out_means, out_turned = torch.empty_like(means), torch.empty_like(turned)
    offset = x[:, None] - x[j]  # [N, k, 3]
    for t in range(len(means)):
        R = quat_to_matrix(turned[t])
        out_means[t] = (torch.einsum("nkij,nkj->nki", R[j], offset) + means[t][j]).mean(1)
        q = turned[t][j]
        q = q * torch.where((q * q[:, :1]).sum(2, keepdim=True) < 0, -1.0, 1.0)
        out_turned[t] = torch.nn.functional.normalize(q.sum(1), dim=1)
    return out_means, out_turned


class GroupModel:
    """Canonical model, fixed carrying motion, and the coefficients of what is left.

    Args:
        key: canonical Gaussians.
        means, turned: [T, N, 3] and [T, N, 4] of `motion.track`.
        steps: the stream's quantization.
    """

    def __init__(self, key: Model, means: torch.Tensor, turned: torch.Tensor, steps: Steps):
        self.key = key
        carried, self.turned = carry(key.params["means"], means, turned)
        self.moved = carried - key.params["means"]  # [T, N, 3]
        self.basis = torch.from_numpy(dct_basis(len(means))).float()  # [T, T]
        self.unit = {name: trajectory_step(getattr(steps, name), len(means)) for name in RESIDUALS}
        n = len(key)
        self.coefficients = {}  # in units of the quantization step
        for name, (channels, most) in RESIDUALS.items():
            self.coefficients[name] = torch.zeros(min(most, len(means)), n, channels)
        left = torch.einsum("kt,tnc->knc", self.basis, means - carried) / self.unit["means"]
        self.coefficients["means"] += left[: len(self.coefficients["means"])]
        for c in self.coefficients.values():
            c.requires_grad_()
        self.log_scales = {
            n: torch.full((len(c), 1, 1), -1.0, requires_grad=True) for n, c in self.coefficients.items()
        }

    def residual(self, name: str, t: int) -> torch.Tensor:
        """[N, C] residual of an attribute at frame `t`, in its own units."""
        c = self.coefficients[name]
        return self.unit[name] * torch.einsum("k,knc->nc", self.basis[: len(c), t], c)

    def frame(self, t: int) -> dict[str, torch.Tensor]:
        """Attributes of frame `t`; differentiable in the coefficients."""
        p = self.key.params
        dq = self.residual("quats", t)
        w = (1 - dq.square().sum(1, keepdim=True)).clamp(min=1e-6).sqrt()
        quats = quat_multiply(torch.cat([w, dq], 1), quat_multiply(self.turned[t], p["quats"]))
        # The canonical means move with fine-tuning; what they moved turns with the Gaussian only to first order.
        return {
            **p,
            "means": p["means"] + self.moved[t] + self.residual("means", t),
            "quats": quats,
            "sh0": p["sh0"] + self.residual("sh0", t),
        }

    def bits(self, generator: torch.Generator) -> torch.Tensor:
        """Estimated bits of all coefficients, with uniform noise in place of rounding."""
        total = torch.zeros(())
        for name, c in self.coefficients.items():
            noise = torch.rand(c.shape, generator=generator) - 0.5
            total = total + laplace_bits(c + noise, self.log_scales[name]).sum()
        return total

    def gaussians(self, t: int) -> Gaussians:
        """Frame `t` in numpy."""
        with torch.no_grad():
            arrays = {n: p.detach().numpy().astype(np.float32) for n, p in self.frame(t).items()}
        arrays["quats"] = arrays["quats"] / np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
        return Gaussians(**arrays)


class _Finetuner:
    """State of one fine-tuning run; `step` is one view of one frame."""

    def __init__(self, group: GroupModel, views: Views, frames: range, settings: TrainSettings, radius: float):
        self.group, self.views, self.frames, self.settings = group, views, frames, settings
        self.rng = np.random.default_rng([settings.seed, frames[0], 2])
        self.noise = torch.Generator().manual_seed(settings.seed)
        self.workspace = Workspace()
        residuals = [(c, RESIDUAL_RATE[n]) for n, c in group.coefficients.items()]
        scales = [(s, LAPLACE_RATE) for s in group.log_scales.values()]
        self.optimizer = torch.optim.Adam(
            [{"params": [p], "lr": r, "base": r} for p, r in residuals + scales], betas=(0.9, 0.99), fused=True
        )
        self.canonical_rates = {"means": MEANS_RATE * radius, **{n: 0.3 * r for n, r in RATES.items()}}
        group.key.restart()

    def step(self, t: int, fade: float) -> float:
        """One step on frame `t`, all rates times `fade`; returns the image loss."""
        for g in self.optimizer.param_groups:
            g["lr"] = g["base"] * fade
        params = self.group.frame(t)
        target = self.views.draw(self.frames[t])
        result = compare(params, target, self.settings, self.rng, self.workspace)
        penalty = self._penalty(t, target.rgb.shape[0] * target.rgb.shape[1])
        heads, seeds = [params[n] for n in RESIDUALS], [result.grads[n] for n in RESIDUALS]
        if penalty.requires_grad:
            heads, seeds = [*heads, penalty], [*seeds, torch.ones(())]
        self.optimizer.zero_grad()
        torch.autograd.backward(heads, seeds)
        self.optimizer.step()
        back = self.group.turned[t] * torch.tensor([1.0, -1, -1, -1])
        grads = {**result.grads, "quats": quat_multiply(back, result.grads["quats"])}  # to the canonical pose
        self.group.key.adam(grads, {n: r * fade for n, r in self.canonical_rates.items()})
        return result.loss

    def _penalty(self, t: int, pixels: int) -> torch.Tensor:
        """Temporal and rate terms, in the image loss's unit (a mean over pixels)."""
        s, group, penalty = self.settings, self.group, torch.zeros(())
        if t + 1 < len(self.frames):
            for name in group.coefficients:
                change = (group.residual(name, t + 1) - group.residual(name, t)) / group.unit[name]
                penalty = penalty + s.temporal_lambda * change.abs().mean(1).sum() / pixels
        if self.rng.integers(RATE_EVERY) == 0:
            penalty = penalty + RATE_EVERY * s.rate_lambda / (pixels * len(self.frames)) * group.bits(self.noise)
        return penalty


def finetune(
    group: GroupModel,
    views: Views,
    frames: range,
    settings: TrainSettings,
    *,
    radius: float,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Optimises canonical attributes and coefficients over all frames; `on_step` gets (step, loss)."""
    steps = settings.finetune_steps * len(frames)
    run = _Finetuner(group, views, frames, settings, radius)
    order: list[int] = []
    for step in range(steps):
        order = order or run.rng.permutation(len(frames)).tolist()
        loss = run.step(order.pop(), 0.05 ** (step / steps))
        if on_step:
            on_step(step, loss)
