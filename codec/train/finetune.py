"""Fine-tuning, the model: one canonical set and sparse residual trajectories that fit all frames of a group.

The model is that of the codec: frame t = canonical Gaussians, carried by the nodes, + sum_k basis[k, t] * c_k for every
attribute. It starts from the tracked frames, projected on the lowest temporal frequencies. All frames share the
canonical attributes, so that frames x views images determine each Gaussian. Coefficients are rounded as the decoder has
them; their gradient passes straight through the rounding. joint_optimization.py optimises the model.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch

from ..bitstream.color import STEP_WEIGHTS
from ..bitstream.quantization import Steps, trajectory_step
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rotations import quat_conjugate, quat_multiply, quat_to_rotvec
from ..model.temporal_transform import dct_basis
from .deformation_graph import NodeGraph, Pose
from .entropy_model import CanonicalRate, laplace_bits
from .model import NAMES, REMOVED_LOGIT, Model
from .settings import TrainSettings


def rounded(c: torch.Tensor, dead_zone: float) -> torch.Tensor:
    """Integers of the coefficients, as the encoder rounds them."""
    return torch.nn.functional.softshrink(c, dead_zone).round_()


class GroupModel:
    """Canonical Gaussians, fixed motion of the nodes, and coefficients of the residual trajectories.

    Args:
        graph: carries the N Gaussians of the last frame.
        key: canonical Gaussians of the group before, in the pose of the keyframe, which stay as they are; None: all are
            new. Gaussians that were added in this group are new in either case.
        tracked: T tracked models. Later ones have more Gaussians at the end; removed ones have REMOVED_LOGIT.
        poses: T poses of the nodes; later ones have more nodes at the end.
        steps: quantization steps of the stream.
        moved: [N] bool, Gaussians that tracking has optimised. Others have no residuals unless they start with some.

    Attributes:
        key: canonical Gaussians; the first `known` are those of the group before.
        start, end: [N] int, lifetime of each Gaussian in frames of the group, `end` excluded.
        coefficients: attribute -> [K, N, C], of the residual trajectories, in quantization steps.
        free: [N] bool, Gaussians whose coefficients are optimised.
        log_scales: attribute -> [K, 1, 1], log of the Laplace scale of its coefficients.
        means, rotations: T times [N, 3] and [N, 4], canonical means carried to each frame, and the nodes' rotations.
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
        self.graph, self.poses = graph, _at_rest_until_added(poses)
        counts = torch.tensor([len(m) for m in tracked])
        self.start = (counts[:, None] <= torch.arange(counts[-1])).sum(0)
        tracked = [_padded(m, tracked[-1]) for m in tracked]
        removed = torch.stack([m.params["logit_opacities"] <= REMOVED_LOGIT for m in tracked])
        removed &= torch.arange(len(tracked))[:, None] > self.start  # the padding is of the last frame
        self.end = len(tracked) - removed.sum(0)
        self.known = 0 if key is None else len(key)
        self.key = self._canonical(key, tracked)
        self.basis = torch.from_numpy(dct_basis(len(tracked))).float()  # [T, T]
        self.canonical_steps = {n: steps[n] for n in NAMES}
        self.canonical_rate = CanonicalRate(self.key.params["means"], steps, settings.entropy_model)
        names = self.settings.frequencies
        self.unit = {name: trajectory_step(steps[name], len(tracked)) for name in names}
        self.unit["sh0"] *= float(STEP_WEIGHTS[0])  # Y, Co, Cg share one step; RGB errors add up over them
        self.means, self.rotations = zip(*(self._carry(p) for p in self.poses), strict=True)
        self.coefficients = self._project(tracked)
        large = [(c.detach().abs() > self.settings.free_min).any(2).any(0) for c in self.coefficients.values()]
        self.free = torch.stack(large).any(0) | moved
        self.log_scales = {
            n: torch.full((len(c), 1, 1), self.settings.log_scale_start, requires_grad=True)
            for n, c in self.coefficients.items()
        }

    @property
    def born(self) -> torch.Tensor:
        """Older name of `start`."""
        return self.start

    def _hold_outside_lifetime(self, x: list[torch.Tensor]) -> torch.Tensor:
        """T values of each Gaussian, [T, N, ...]; outside of its lifetime those of its first or last frame."""
        x = torch.stack(x)
        frame = torch.arange(len(x))[:, None].clamp(min=self.start, max=self.end - 1)
        return x[frame, torch.arange(x.shape[1])]

    def _canonical(self, key: Model | None, tracked: list[Model]) -> Model:
        """Canonical Gaussians: `key`, then the new ones as the mean of their tracked frames, in the keyframe's pose."""
        params = {n: self._hold_outside_lifetime([m.params[n] for m in tracked]).mean(0) for n in NAMES}
        params["means"] = self.graph.means
        rotations = [self.graph.carry(self.graph.means, pose)[1] for pose in self.poses]
        back = [quat_multiply(quat_conjugate(q), m.params["quats"]) for q, m in zip(rotations, tracked, strict=True)]
        back = self._hold_outside_lifetime(back)
        back = back * torch.where((back * back[-1]).sum(2, keepdim=True) < 0, -1.0, 1.0)
        params["quats"] = torch.nn.functional.normalize(back.sum(0), dim=1)
        if key is not None:
            params = {n: torch.cat([key.params[n], p[self.known :]]) for n, p in params.items()}
        return Model(params)

    def _carry(self, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        """Canonical means carried to a pose, and the rotations by the nodes."""
        return self.graph.carry(self.key.params["means"], pose)

    def _project(self, tracked: list[Model]) -> dict[str, torch.Tensor]:
        """Lowest frequencies of the difference between the tracked frames and what the nodes carry."""
        p = self.key.params
        residual: dict[str, list] = {name: [] for name in self.settings.frequencies}
        for model, means, rotations in zip(tracked, self.means, self.rotations, strict=True):
            q = model.params
            dq = quat_multiply(q["quats"], quat_conjugate(quat_multiply(rotations, p["quats"])))
            residual["means"].append(q["means"] - means)
            residual["quats"].append(dq[:, 1:] * torch.where(dq[:, :1] < 0, -1.0, 1.0))
            for name in ("log_scales", "sh0"):
                residual[name].append(q[name] - p[name])
            faded = (q["logit_opacities"] - p["logit_opacities"])[:, None]
            residual["logit_opacities"].append(torch.where(q["logit_opacities"][:, None] > REMOVED_LOGIT, faded, 0.0))
        out, per = {}, self.settings.frequencies_frames
        for name, most in self.settings.frequencies.items():
            low = self.basis[: -(-most * max(len(tracked), per) // per)]
            c = torch.einsum("kt,tnc->knc", low, self._hold_outside_lifetime(residual[name])) / self.unit[name]
            out[name] = c.contiguous().requires_grad_()
        return out

    @torch.no_grad()
    def residuals(self, t: int) -> dict[str, torch.Tensor]:
        """Residuals at frame `t`, attribute -> [N, C], in the units of the attribute."""
        dead_zone = self.settings.dead_zone
        return {n: torch.tensordot(self._at(n, t), rounded(c, dead_zone), 1) for n, c in self.coefficients.items()}

    @torch.no_grad()
    def backward(self, t: int, residuals: dict[str, torch.Tensor]) -> None:
        """Adds the gradient by the `residuals` of frame `t` to that of the coefficients, straight through the rounding.
        The gradient of Gaussians that are not free is 0."""
        free = self.free[:, None]
        for n, c in self.coefficients.items():
            grad = self._at(n, t)[:, None, None] * (residuals[n].grad * free)
            c.grad = grad if c.grad is None else c.grad.mul_(free).add_(grad)

    def _at(self, name: str, t: int) -> torch.Tensor:
        """Residual at frame `t` for each coefficient of an attribute that is 1, [K]."""
        return self.unit[name] * self.basis[: len(self.coefficients[name]), t]

    def _with_noise(self, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Canonical attributes, the new ones with uniform noise in place of quantization."""
        p, out = self.key.params, dict(self.key.params)
        for name, step in self.canonical_steps.items():
            noise = step * (torch.rand(p[name].shape, generator=generator) - 0.5)
            noise[: self.known] = 0
            out[name] = p[name] + noise
        return out

    def frame(
        self, t: int, residuals: dict[str, torch.Tensor], generator: torch.Generator | None = None
    ) -> dict[str, torch.Tensor]:
        """Attributes of frame `t`; differentiable in its `residuals`.

        Args:
            generator: of the noise on canonical attributes; None: no noise.
        """
        new = self.known < len(self.key)
        p = self._with_noise(generator) if new and generator is not None else self.key.params
        means = self.graph.carry(p["means"], self.poses[t])[0] if new else self.means[t]
        dq = residuals["quats"]
        opacities = p["logit_opacities"] + residuals["logit_opacities"][:, 0]
        w = (1 - dq.square().sum(1, keepdim=True)).clamp(min=1e-6).sqrt()
        return {
            **p,
            "means": means + residuals["means"],
            "quats": quat_multiply(torch.cat([w, dq], 1), quat_multiply(self.rotations[t], p["quats"])),
            "log_scales": p["log_scales"] + residuals["log_scales"],
            "logit_opacities": torch.where((self.start <= t) & (t < self.end), opacities, REMOVED_LOGIT),
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
            near = quat_to_rotvec(pose.rotations, near)
            rotations.append(near)
        translations = [pose.nodes - self.graph.nodes for pose in self.poses]
        arrays = (self.graph.nodes, torch.stack(rotations), torch.stack(translations))
        return NodeMotion(*(a.numpy().astype(np.float32) for a in arrays), self.graph.neighbors, self.graph.weights)


def _padded(model: Model, last: Model) -> Model:
    """The model, and the Gaussians that it does not have yet as they are in `last`."""
    return Model({n: torch.cat([p, last.params[n][len(p) :]]) for n, p in model.params.items()})


def _at_rest_until_added(poses: list[Pose]) -> list[Pose]:
    """Poses of all nodes; before a node is added it is where it is added."""
    whole = poses[-1:]
    for pose in poses[-2::-1]:
        known, later = len(pose.nodes), whole[0]
        arrays = {f.name: torch.cat([getattr(pose, f.name), getattr(later, f.name)[known:]]) for f in fields(Pose)}
        whole.insert(0, Pose(**arrays))
    return whole
