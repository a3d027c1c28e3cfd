"""Joint fine-tuning of a group: one canonical set and sparse residual trajectories that fit all frames and views.

The model is the codec's own: frame t = canonical carried by the nodes + sum_k basis[k, t] * c_k for every attribute.
It starts from the tracked frames, projected on the lowest temporal frequencies. All frames share the canonical
attributes, so each Gaussian is seen by frames x views images instead of views. Coefficients are used as the decoder
will have them (rounded, straight-through gradient); what does not pay is pulled to zero by the rate term: their
entropy under noise-relaxed quantization at the stream's own step sizes, with a learned Laplace scale for each
attribute and temporal frequency (V3's residual-entropy loss, made differentiable).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from gscodec.bitstream.color import STEP_WEIGHTS
from gscodec.bitstream.quantization import Steps, trajectory_step
from gscodec.bitstream.transform import dct_basis
from gscodec.gaussians import Gaussians, Nodes
from gscodec.render.workspace import Workspace
from gscodec.train import keyframe
from gscodec.train.graph import NodeGraph, Pose, quat_conjugate, quat_multiply, quat_to_rotvec
from gscodec.train.model import Model
from gscodec.train.settings import TrainSettings
from gscodec.train.views import Views, compare

# attribute -> temporal frequencies that may be used; what is not listed is constant in a group
FREQUENCIES = {"means": 10, "quats": 4, "log_scales": 3, "logit_opacities": 3, "sh0": 6}
STARTS = 0.5  # steps: a residual that is there from the start, of a Gaussian that has moved in an earlier group
ROUND_DOWN = 0.1  # a coefficient below 0.6 steps is not coded, as the encoder does it
RESIDUAL_RATE = 0.05  # in steps of the stream a step of the optimiser
LAPLACE_RATE = 0.02
MEANS_RATE = 4e-5  # of the canonical means, times the radius
CANONICAL_SHARE = 0.3  # of the keyframe's rates
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


def rounded(c: torch.Tensor) -> torch.Tensor:
    """The decoder's integers; the gradient passes straight through."""
    return c + (torch.sign(c) * torch.floor(c.abs() + 0.5 - ROUND_DOWN) - c).detach()


class GroupModel:
    """Canonical model, fixed carrying motion, and the coefficients of what is left.

    Args:
        key: canonical Gaussians in the keyframe's pose; None makes it the mean of the tracked frames.
        tracked: T tracked models; poses: T poses of the nodes of `graph`.
        steps: the stream's quantization.
        moved: [N] bool, Gaussians that tracking has touched; the others have no residuals, unless they start with some.
    """

    def __init__(
        self,
        graph: NodeGraph,
        key: Model | None,
        tracked: list[Model],
        poses: list[Pose],
        steps: Steps,
        moved: torch.Tensor,
    ):
        self.graph, self.poses = graph, poses
        self.fixed = key is not None
        self.key = key or _mean_of(graph, tracked, poses)
        self.basis = torch.from_numpy(dct_basis(len(tracked))).float()  # [T, T]
        self.canonical_steps = {n: getattr(steps, n) for n in ("log_scales", "quats", "logit_opacities", "sh0")}
        self.unit = {name: trajectory_step(getattr(steps, name), len(tracked)) for name in FREQUENCIES}
        self.unit["sh0"] *= float(STEP_WEIGHTS[0])  # Y, Co, Cg share one step; RGB errors add up over them
        self.means, self.turned = zip(*(self._carry(p) for p in poses), strict=True)
        self.coefficients = self._project(tracked)  # in units of the quantization step
        self.free = torch.stack([(c.detach().abs() > STARTS).any(2).any(0) for c in self.coefficients.values()]).any(0)
        self.free |= moved
        for c in self.coefficients.values():
            c.register_hook(lambda grad: grad * self.free[:, None])
        self.log_scales = {
            n: torch.full((len(c), 1, 1), -1.0, requires_grad=True) for n, c in self.coefficients.items()
        }

    def _carry(self, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        return self.graph.carry(self.key.params["means"], pose)

    def _project(self, tracked: list[Model]) -> dict[str, torch.Tensor]:
        """The tracked frames' lowest frequencies, minus what the nodes carry."""
        p = self.key.params
        residual: dict[str, list] = {name: [] for name in FREQUENCIES}
        for model, means, turned in zip(tracked, self.means, self.turned, strict=True):
            q = model.params
            dq = quat_multiply(q["quats"], quat_conjugate(quat_multiply(turned, p["quats"])))
            residual["means"].append(q["means"] - means)
            residual["quats"].append(dq[:, 1:] * torch.where(dq[:, :1] < 0, -1.0, 1.0))
            for name in ("log_scales", "sh0"):
                residual[name].append(q[name] - p[name])
            residual["logit_opacities"].append((q["logit_opacities"] - p["logit_opacities"])[:, None])
        out = {}
        for name, most in FREQUENCIES.items():
            low = self.basis[: min(most, len(tracked))]
            c = torch.einsum("kt,tnc->knc", low, torch.stack(residual[name])) / self.unit[name]
            out[name] = c.contiguous().requires_grad_()
        return out

    def residual(self, name: str, t: int) -> torch.Tensor:
        """[N, C] residual of an attribute at frame `t`, in its own units."""
        c = rounded(self.coefficients[name])
        return self.unit[name] * torch.einsum("k,knc->nc", self.basis[: len(c), t], c)

    def _relaxed(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Canonical attributes with uniform noise in place of their quantization."""
        noise = lambda p: torch.rand(p.shape, generator=generator) - 0.5  # noqa: E731
        p = self.key.params
        return p | {n: p[n] + step * noise(p[n]) for n, step in self.canonical_steps.items()}

    def frame(self, t: int, generator: torch.Generator | None = None) -> dict[str, torch.Tensor]:
        """Attributes of frame `t`, with noise on the canonical ones if there is a generator; differentiable in the
        coefficients."""
        p = self.key.params if generator is None or self.fixed else self._relaxed(generator)
        means = self.means[t] if self.fixed else self._carry(self.poses[t])[0]
        dq = self.residual("quats", t)
        w = (1 - dq.square().sum(1, keepdim=True)).clamp(min=1e-6).sqrt()
        return {
            **p,
            "means": means + self.residual("means", t),
            "quats": quat_multiply(torch.cat([w, dq], 1), quat_multiply(self.turned[t], p["quats"])),
            "log_scales": p["log_scales"] + self.residual("log_scales", t),
            "logit_opacities": p["logit_opacities"] + self.residual("logit_opacities", t)[:, 0],
            "sh0": p["sh0"] + self.residual("sh0", t),
        }

    def bits(self, generator: torch.Generator) -> torch.Tensor:
        """Estimated bits of all coefficients, with uniform noise in place of rounding."""
        total = torch.zeros(())
        for name, c in self.coefficients.items():
            noise = torch.rand(c.shape, generator=generator) - 0.5
            total = total + laplace_bits(c + noise, self.log_scales[name]).sum()
        return total

    def nodes(self) -> Nodes:
        """The carrying motion, for the encoder."""
        rotations, near = [], None
        for pose in self.poses:
            near = quat_to_rotvec(pose.turned, near)
            rotations.append(near)
        translations = [pose.nodes - self.graph.nodes for pose in self.poses]
        arrays = (self.graph.nodes, torch.stack(rotations), torch.stack(translations))
        return Nodes(*(a.numpy().astype(np.float32) for a in arrays))

    def gaussians(self, t: int) -> Gaussians:
        """Frame `t` in numpy."""
        return Model(self.frame(t)).gaussians()


def _mean_of(graph: NodeGraph, tracked: list[Model], poses: list[Pose]) -> Model:
    """Canonical Gaussians: the tracked ones, turned back to the keyframe's pose, on average."""
    first = tracked[0].params
    mean = {n: torch.stack([m.params[n] for m in tracked]).mean(0) for n in first}
    total = torch.zeros_like(first["quats"])
    for model, pose in zip(tracked, poses, strict=True):
        _, turned = graph.carry(first["means"], pose)
        back = quat_multiply(quat_conjugate(turned), model.params["quats"])
        total += back * torch.where((back * first["quats"]).sum(1, keepdim=True) < 0, -1.0, 1.0)
    quats = torch.nn.functional.normalize(total, dim=1)
    return Model({**mean, "means": first["means"], "quats": quats})


class _Finetuner:
    """State of one fine-tuning run; `step` is one view of one frame."""

    def __init__(self, group: GroupModel, views: Views, frames: range, settings: TrainSettings, radius: float):
        self.group, self.views, self.frames, self.settings = group, views, frames, settings
        self.rng = np.random.default_rng([settings.seed, frames[0], 2])
        self.noise = torch.Generator().manual_seed(settings.seed)
        self.workspace = Workspace()
        rates = [(c, RESIDUAL_RATE) for c in group.coefficients.values()]
        rates += [(s, LAPLACE_RATE) for s in group.log_scales.values()]
        self.optimizer = torch.optim.Adam([{"params": [p], "base": r} for p, r in rates], betas=(0.9, 0.99), fused=True)
        canonical = {n: CANONICAL_SHARE * r for n, r in keyframe.RATES.items()}
        self.canonical_rates = {} if group.fixed else {"means": MEANS_RATE * radius, **canonical}

    def step(self, t: int, fade: float) -> float:
        """One step on frame `t`, all rates times `fade`; returns the image loss."""
        for g in self.optimizer.param_groups:
            g["lr"] = g["base"] * fade
        group, names = self.group, list(self.group.coefficients)
        params = group.frame(t, self.noise)
        target = self.views.draw(self.frames[t])
        result = compare(params, target, self.settings, self.rng, self.workspace)
        heads, seeds = [params[n] for n in names], [result.grads[n] for n in names]
        if self.rng.integers(RATE_EVERY) == 0:
            pixels = target.rgb.shape[0] * target.rgb.shape[1] * len(self.frames)
            heads.append(RATE_EVERY * self.settings.rate_lambda / pixels * group.bits(self.noise))
            seeds.append(torch.ones(()))
        self.optimizer.zero_grad()
        torch.autograd.backward(heads, seeds)
        self.optimizer.step()
        if self.canonical_rates:
            back = quat_conjugate(group.turned[t])
            grads = {**result.grads, "quats": quat_multiply(back, result.grads["quats"])}  # to the canonical pose
            group.key.adam(grads, {n: r * fade for n, r in self.canonical_rates.items()})
        return result.loss


def finetune(
    group: GroupModel,
    views: Views,
    frames: range,
    settings: TrainSettings,
    *,
    radius: float,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Optimises canonical attributes (unless `group` has fixed ones) and coefficients over all frames.

    Args:
        on_step: called with (step, loss).
    """
    steps = settings.finetune_steps * len(frames)
    run = _Finetuner(group, views, frames, settings, radius)
    order: list[int] = []
    for step in range(steps):
        order = order or run.rng.permutation(len(frames)).tolist()
        loss = run.step(order.pop(), 0.05 ** (step / steps))
        if on_step:
            on_step(step, loss)
