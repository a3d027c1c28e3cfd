"""Joint fine-tuning of a group: one canonical set and sparse residual trajectories that fit all frames and views.

The model is the codec's own: frame t = canonical carried by the nodes + sum_k basis[k, t] * c_k for every attribute.
It starts from the tracked frames, projected on the lowest temporal frequencies. All frames share the canonical
attributes, so each Gaussian is seen by frames x views images instead of views. Coefficients are used as the decoder
will have them (rounded, straight-through gradient); what does not pay is pulled to zero by the rate term: their
entropy under noise-relaxed quantization at the stream's own step sizes, with a learned Laplace scale for each
attribute and temporal frequency (V3's residual-entropy loss, made differentiable). Canonical attributes have noise in
place of their quantization, and a rate term of their own (rate.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import torch

from ..bitstream.color import STEP_WEIGHTS
from ..bitstream.quantization import Steps, trajectory_step
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rotations import quat_conjugate, quat_multiply, quat_to_rotvec
from ..model.temporal_transform import dct_basis
from ..render.optimizer import Adam
from .deformation_graph import NodeGraph, Pose
from .entropy_model import CanonicalRate, laplace_bits
from .model import HIDDEN, NAMES, Model
from .settings import TrainSettings
from .views import Views, photometric_loss


def rounded(c: torch.Tensor, dead_zone: float) -> torch.Tensor:
    """The decoder's integers, as the encoder rounds them."""
    return torch.nn.functional.softshrink(c, dead_zone).round_()


class GroupModel:
    """Canonical model, fixed carrying motion, and the coefficients of what is left.

    Args:
        graph: carries the N Gaussians of the last frame.
        key: canonical Gaussians that the group before has left, in the keyframe's pose; they stay as they are. None:
            all are new, and so are those that are born in this group.
        tracked: T tracked models, later ones with those that were born at the end and HIDDEN ones, which are dead;
            poses: T poses of the nodes, later ones with those of what came in at the end.
        steps: the stream's quantization.
        moved: [N] bool, Gaussians that tracking has touched; the others have no residuals, unless they start with some.

    Attributes:
        key: canonical Gaussians; the first `known` of them are given.
        born, end: [N] int, frames of the group from which, and before which, each is shown.
    """

    def __init__(
        self,
        graph: NodeGraph,
        key: Model | None,
        tracked: list[Model],
        poses: list[Pose],
        steps: Steps,
        moved: torch.Tensor,
        settings: TrainSettings,
    ):
        self.settings = settings.finetune
        self.graph, self.poses = graph, _at_rest_until_born(poses)
        counts = torch.tensor([len(m) for m in tracked])
        self.born = (counts[:, None] <= torch.arange(counts[-1])).sum(0)
        tracked = [_padded(m, tracked[-1]) for m in tracked]
        dead = torch.stack([m.params["logit_opacities"] <= HIDDEN for m in tracked])
        dead &= torch.arange(len(tracked))[:, None] > self.born  # the padding is of the last frame
        self.end = len(tracked) - dead.sum(0)
        self.known = 0 if key is None else len(key)
        self.key = self._canonical(key, tracked)
        self.basis = torch.from_numpy(dct_basis(len(tracked))).float()  # [T, T]
        self.canonical_steps = {n: getattr(steps, n) for n in NAMES}
        self.canonical_rate = CanonicalRate(self.key.params["means"], steps, settings.entropy_model)
        self.unit = {
            name: trajectory_step(getattr(steps, name), len(tracked)) for name in vars(self.settings.frequencies)
        }
        self.unit["sh0"] *= float(STEP_WEIGHTS[0])  # Y, Co, Cg share one step; RGB errors add up over them
        self.means, self.turned = zip(*(self._carry(p) for p in self.poses), strict=True)
        self.coefficients = self._project(tracked)  # in units of the quantization step
        self.free = torch.stack(
            [(c.detach().abs() > self.settings.free_min).any(2).any(0) for c in self.coefficients.values()]
        ).any(0)
        self.free |= moved
        self.log_scales = {
            n: torch.full((len(c), 1, 1), self.settings.log_scale_start, requires_grad=True)
            for n, c in self.coefficients.items()
        }

    def _held(self, x: list[torch.Tensor]) -> torch.Tensor:
        """[T, N, ...]: before its birth a Gaussian is what it is at birth, and dead what it was last."""
        x = torch.stack(x)
        frame = torch.arange(len(x))[:, None].clamp(min=self.born, max=self.end - 1)
        return x[frame, torch.arange(x.shape[1])]

    def _canonical(self, key: Model | None, tracked: list[Model]) -> Model:
        """What is given, and for what is new the tracked Gaussians, turned back to the keyframe's pose, on average."""
        params = {n: self._held([m.params[n] for m in tracked]).mean(0) for n in NAMES}
        params["means"] = self.graph.means
        turned = [self.graph.carry(self.graph.means, pose)[1] for pose in self.poses]
        back = [quat_multiply(quat_conjugate(q), m.params["quats"]) for q, m in zip(turned, tracked, strict=True)]
        back = self._held(back)
        back = back * torch.where((back * back[-1]).sum(2, keepdim=True) < 0, -1.0, 1.0)
        params["quats"] = torch.nn.functional.normalize(back.sum(0), dim=1)
        if key is not None:
            params = {n: torch.cat([key.params[n], p[self.known :]]) for n, p in params.items()}
        return Model(params)

    def _carry(self, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        return self.graph.carry(self.key.params["means"], pose)

    def _project(self, tracked: list[Model]) -> dict[str, torch.Tensor]:
        """The tracked frames' lowest frequencies, minus what the nodes carry."""
        p = self.key.params
        residual: dict[str, list] = {name: [] for name in vars(self.settings.frequencies)}
        for model, means, turned in zip(tracked, self.means, self.turned, strict=True):
            q = model.params
            dq = quat_multiply(q["quats"], quat_conjugate(quat_multiply(turned, p["quats"])))
            residual["means"].append(q["means"] - means)
            residual["quats"].append(dq[:, 1:] * torch.where(dq[:, :1] < 0, -1.0, 1.0))
            for name in ("log_scales", "sh0"):
                residual[name].append(q[name] - p[name])
            faded = (q["logit_opacities"] - p["logit_opacities"])[:, None]
            residual["logit_opacities"].append(torch.where(q["logit_opacities"][:, None] > HIDDEN, faded, 0.0))
        out, per = {}, self.settings.frequencies_frames
        for name, most in vars(self.settings.frequencies).items():
            low = self.basis[: -(-most * max(len(tracked), per) // per)]
            c = torch.einsum("kt,tnc->knc", low, self._held(residual[name])) / self.unit[name]
            out[name] = c.contiguous().requires_grad_()
        return out

    @torch.no_grad()
    def residuals(self, t: int) -> dict[str, torch.Tensor]:
        """attribute -> [N, C], residual at frame `t`, in its own units."""
        return {
            n: torch.tensordot(self._at(n, t), rounded(c, self.settings.dead_zone), 1)
            for n, c in self.coefficients.items()
        }

    @torch.no_grad()
    def backward(self, t: int, residuals: dict[str, torch.Tensor]) -> None:
        """Adds to the gradient of the coefficients (of their bits, if it has been taken) that of `residuals`, of frame
        `t`, straight through the rounding. Gaussians that are not free have none."""
        free = self.free[:, None]
        for n, c in self.coefficients.items():
            grad = self._at(n, t)[:, None, None] * (residuals[n].grad * free)
            c.grad = grad if c.grad is None else c.grad.mul_(free).add_(grad)

    def _at(self, name: str, t: int) -> torch.Tensor:
        """[K] what each coefficient of an attribute is worth at frame `t`."""
        return self.unit[name] * self.basis[: len(self.coefficients[name]), t]

    def _relaxed(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Canonical attributes with uniform noise in place of their quantization, where they are new."""
        p, out = self.key.params, dict(self.key.params)
        for name, step in self.canonical_steps.items():
            noise = step * (torch.rand(p[name].shape, generator=generator) - 0.5)
            noise[: self.known] = 0
            out[name] = p[name] + noise
        return out

    def frame(
        self, t: int, residuals: dict[str, torch.Tensor], generator: torch.Generator | None = None
    ) -> dict[str, torch.Tensor]:
        """Attributes of frame `t`, with noise on the canonical ones if there is a generator; differentiable in its
        residuals."""
        new = self.known < len(self.key)
        p = self._relaxed(generator) if new and generator is not None else self.key.params
        means = self.graph.carry(p["means"], self.poses[t])[0] if new else self.means[t]
        dq = residuals["quats"]
        opacities = p["logit_opacities"] + residuals["logit_opacities"][:, 0]
        w = (1 - dq.square().sum(1, keepdim=True)).clamp(min=1e-6).sqrt()
        return {
            **p,
            "means": means + residuals["means"],
            "quats": quat_multiply(torch.cat([w, dq], 1), quat_multiply(self.turned[t], p["quats"])),
            "log_scales": p["log_scales"] + residuals["log_scales"],
            "logit_opacities": torch.where((self.born <= t) & (t < self.end), opacities, HIDDEN),
            "sh0": p["sh0"] + residuals["sh0"],
        }

    def bits(self, generator: torch.Generator) -> torch.Tensor:
        """Estimated bits of all coefficients, with uniform noise in place of rounding."""
        total = torch.zeros(())
        for name, c in self.coefficients.items():
            noise = torch.rand(c.shape, generator=generator) - 0.5
            total = total + laplace_bits(c + noise, self.log_scales[name]).sum()
        return total

    def group(self, parents: np.ndarray | None) -> ParametricGroup:
        """The group as it is encoded; `parents` as in ParametricGroup."""
        frames = len(self.poses)
        lifetimes = torch.stack([self.born, self.end], 1).numpy().astype(np.int32)
        cut = (lifetimes != [0, frames]).any()
        with torch.no_grad():
            used = {n: rounded(c, self.settings.dead_zone) * self.unit[n] for n, c in self.coefficients.items()}
        return ParametricGroup(
            frames,
            self.key.gaussians(),
            self.nodes(),
            {n: np.ascontiguousarray(c.transpose(1, 2).numpy()) for n, c in used.items() if c.any()},
            lifetimes if cut else None,
            parents,
            rate_optimized=True,
        )

    def nodes(self) -> NodeMotion:
        """The carrying motion."""
        rotations, near = [], None
        for pose in self.poses:
            near = quat_to_rotvec(pose.turned, near)
            rotations.append(near)
        translations = [pose.nodes - self.graph.nodes for pose in self.poses]
        arrays = (self.graph.nodes, torch.stack(rotations), torch.stack(translations))
        return NodeMotion(*(a.numpy().astype(np.float32) for a in arrays), self.graph.neighbors, self.graph.weights)


def _padded(model: Model, last: Model) -> Model:
    """The model with the Gaussians that it does not have yet, as they are in `last`."""
    return Model({n: torch.cat([p, last.params[n][len(p) :]]) for n, p in model.params.items()})


def _at_rest_until_born(poses: list[Pose]) -> list[Pose]:
    """Poses of all nodes: before its birth a node is where it is at birth."""
    whole = poses[-1:]
    for pose in poses[-2::-1]:
        known, later = len(pose.nodes), whole[0]
        arrays = {f.name: torch.cat([getattr(pose, f.name), getattr(later, f.name)[known:]]) for f in fields(Pose)}
        whole.insert(0, Pose(**arrays))
    return whole


class _Finetuner:
    """State of one fine-tuning run; `step` is one view of one frame."""

    def __init__(self, group: GroupModel, views: Views, frames: range, settings: TrainSettings, radius: float):
        self.group, self.views, self.frames, self.settings = group, views, frames, settings
        self.rng = np.random.default_rng([settings.seed, frames[0], 2])
        self.noise = torch.Generator().manual_seed(settings.seed)
        f = settings.finetune
        scales = {f"{n}.log_scale": s for n, s in group.log_scales.items()}
        self.leaves = {**group.coefficients, **scales}  # what is optimised besides the canonical attributes
        self.rates = dict.fromkeys(group.coefficients, f.coefficient_rate) | dict.fromkeys(scales, f.log_scale_rate)
        self.adam = Adam(views.backend, f.coefficient_adam)
        group.key.start_optimizer(views.backend, settings.adam)
        canonical = settings.keyframe.rates.scaled(radius, f.canonical_rate_share)
        canonical["means"] = f.canonical_means_rate * radius
        self.canonical_rates = canonical if group.known < len(group.key) else {}
        self.loss = 0.0  # mean of the last steps'
        self.canonical_bits, _ = group.canonical_rate.gradients(group.key.params, self.noise)

    def step(self, t: int, fade: float) -> float:
        """One step on frame `t`, all rates times `fade`; returns the image loss."""
        f = self.settings.finetune
        group, names = self.group, list(self.group.coefficients)
        residuals = {n: r.requires_grad_() for n, r in group.residuals(t).items()}
        params = group.frame(t, residuals, self.noise if f.canonical_noise else None)
        target = self.views.draw(self.frames[t])
        result = photometric_loss(params, target, self.settings, self.rng, self.views.backend)
        self.loss += (result.loss - self.loss) * (f.loss_smoothing if self.loss else 1.0)
        heads, seeds = [params[n] for n in names], [result.grads[n] for n in names]
        extra: dict[str, torch.Tensor] = {}
        if self.settings.rate_lambda and self.rng.integers(f.rate_every) == 0:
            bits = group.bits(self.noise)
            price = self._price(float(bits.detach()))
            heads.append(price * bits)
            seeds.append(torch.ones(()))
            if self.canonical_rates:
                self.canonical_bits, rate = group.canonical_rate.gradients(group.key.params, self.noise)
                extra = {n: f.canonical_bit_weight * price * g for n, g in rate.items()}
        for leaf in self.leaves.values():
            leaf.grad = None
        torch.autograd.backward(heads, seeds)
        group.backward(t, residuals)
        by_leaf = {n: leaf.grad for n, leaf in self.leaves.items() if leaf.grad is not None}  # scales: with bits only
        self.adam.step(self.leaves, by_leaf, {n: self.rates[n] * fade for n in by_leaf})
        if self.canonical_rates:
            back = quat_conjugate(group.turned[t])
            grads = {**result.grads, "quats": quat_multiply(back, result.grads["quats"])}  # to the canonical pose
            for n, g in grads.items():
                g += extra.get(n, 0)
                g[: group.known] = 0
            group.key.step(grads, {n: r * fade for n, r in self.canonical_rates.items()})
        return result.loss

    def _price(self, bits: float) -> float:
        """Of a bit, in image loss, where the residuals take `bits`.

        What counts is by which share bits and loss change. A group is priced as if it stood alone, so that a bit costs
        the same in all groups of a subject.
        """
        return self.settings.finetune.rate_every * self.settings.rate_lambda * self.loss / (bits + self.canonical_bits)


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
        # The first and the last frame come twice: they have neighbours on one side only.
        order = order or run.rng.permutation([0, *range(len(frames)), len(frames) - 1]).tolist()
        loss = run.step(order.pop(), settings.finetune.rate_decay ** (step / steps))
        if on_step:
            on_step(step, loss)
