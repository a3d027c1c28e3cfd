"""Fine-tuning, the model: one set of canonical Gaussians and sparse residual trajectories for all frames of a group.

The model is that of the codec: frame t = canonical Gaussians, carried by the nodes, + sum_k basis[k, t] * c_k for every
attribute. It starts from the tracked frames, projected on the lowest temporal frequencies. All frames share the
canonical attributes, so that frames x views images determine each Gaussian. Coefficients are rounded as in the
decoder; their gradient passes straight through the rounding. joint_optimization.py optimises the model.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch

from ..bitstream.color import STEP_WEIGHTS
from ..bitstream.quantization import Steps, trajectory_step
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rotations import quat_conjugate, quat_to_rotvec, rotate
from ..model.temporal_transform import dct_basis
from ..render.backend import TURNS, Backend
from .deformation_graph import NodeGraph, Pose
from .entropy_model import CanonicalRate
from .model import NAMES, REMOVED_LOGIT, Model, SizeBound, harmonics_turned, quat_product
from .motion_field import FieldMotion, MotionField
from .settings import TrainSettings


@dataclass
class Frame:
    """One frame of a group, and the values that its backward pass needs.

    Attributes:
        params: attributes as they are rendered; harmonics as at rest, with TURNS.
        pose: of the nodes.
        turn: [M, 3] rotation vectors of the nodes, after their tracked rotations.
        by_field: motion from the field.
        means: [N, 3], canonical means as the nodes carry them.
        rest: [N, 3], canonical means.
        rotations: [N, 4], rotations of the Gaussians by the nodes.
        residual: [N, 4], residual rotation, unit.
        inner: [N, 4], rotation before the residual one.
        quats: [N, 4], canonical rotations.
        shown: [N] bool, Gaussians that live in this frame.
    """

    params: dict[str, torch.Tensor]
    pose: Pose
    turn: torch.Tensor
    by_field: FieldMotion | None
    means: torch.Tensor
    rest: torch.Tensor
    rotations: torch.Tensor
    residual: torch.Tensor
    inner: torch.Tensor
    quats: torch.Tensor
    shown: torch.Tensor


def rounded(c: np.ndarray, dead_zone: float) -> np.ndarray:
    """Integers of the coefficients, as the encoder rounds them."""
    return np.rint(shrunk(c, dead_zone))


def shrunk(c: np.ndarray, by: float) -> np.ndarray:
    """Soft threshold: coefficients nearer to 0 by `by`, smaller ones 0."""
    return np.sign(c) * np.maximum(np.abs(c) - np.float32(by), 0)


class GroupModel:
    """Canonical Gaussians, motion of the nodes, and coefficients of the residual trajectories.

    Args:
        graph: carries the N Gaussians of the last frame.
        key: canonical Gaussians of the group before, in the pose of the keyframe, which stay as they are; None: all are
            new. Gaussians that were added in this group are new in either case.
        tracked: T tracked models. Later ones have more Gaussians at the end; removed ones have REMOVED_LOGIT.
        poses: T poses of the nodes; later ones have more nodes at the end.
        steps: quantization steps of the stream.
        moved: [N] bool, Gaussians that tracking has optimised. Other Gaussians have no residuals unless they start
            with some, and nodes that carry only other Gaussians are not corrected.

    Attributes:
        key: canonical Gaussians; the first `known` are those of the group before.
        start, end: [N] int, lifetime of each Gaussian in frames of the group, `end` excluded.
        coefficients: attribute -> [K, N, C] f32, of the residual trajectories, in quantization steps.
        free: [N] bool, Gaussians whose coefficients are optimised.
        log_scales: attribute -> [K] f32, log of the Laplace scale of its coefficients.
        turns, shifts: T times [M, 3], corrections of the poses of the nodes: rotation vectors, world units.
        field: motion field of the group, added to `turns` and `shifts`; None: no field.
        carriers: [M, 1] bool, nodes that carry a Gaussian that moved; only these are corrected.
        origin: [N] index of each Gaussian in the last frame of tracking; -1: added by `append`.
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
        self.settings, self._entropy, self._steps = settings.finetune, settings.entropy_model, steps
        self._turned = settings.turned_harmonics
        self.graph, self._tracked_poses = graph.copy(), _at_rest_until_added(poses)
        self.origin = torch.arange(len(graph.means))
        self.turns = [torch.zeros_like(p.nodes) for p in self._tracked_poses]
        self.shifts = [torch.zeros_like(p.nodes) for p in self._tracked_poses]
        self.field: MotionField | None = None
        self.carriers = self.graph.carriers(moved)[:, None]
        counts = torch.tensor([len(m) for m in tracked])
        self.start = (counts[:, None] <= torch.arange(counts[-1])).sum(0)
        tracked = [_padded(m, tracked[-1]) for m in tracked]
        removed = torch.stack([~m.alive for m in tracked])
        removed &= torch.arange(len(tracked))[:, None] > self.start  # padding copies the last frame
        self.end = len(tracked) - removed.sum(0)
        self.known = 0 if key is None else len(key)
        self.key = self._canonical(key, tracked)
        self.basis = dct_basis(len(tracked)).astype(np.float32)  # [T, T]
        self.canonical_steps = {n: steps[n] for n in NAMES}
        self.canonical_rate = CanonicalRate(self.key.params["means"], steps, settings.entropy_model)
        names = self.settings.frequencies
        self.unit = {name: trajectory_step(steps[name], len(tracked)) for name in names}
        self.unit["sh0"] *= float(STEP_WEIGHTS[0])  # Y, Co, Cg share one step; RGB errors add up over them
        self.coefficients = self._project(tracked)
        again = (moved & (torch.arange(len(moved)) < self.known)).numpy()
        for c in self.coefficients.values():
            c[:, again] = shrunk(c[:, again], self.settings.shrinkage)
        large = [(np.abs(c) > self.settings.free_min).any((0, 2)) for c in self.coefficients.values()]
        self.free = torch.from_numpy(np.any(large, 0)) | moved
        self.log_scales = {
            n: np.full(len(c), self.settings.log_scale_start, np.float32) for n, c in self.coefficients.items()
        }

    def select(self, keep: torch.Tensor) -> None:
        """Keeps the Gaussians of `keep` ([N] bool), which must include those of the group before."""
        self.key.select(keep)
        self.graph.select(keep)
        self.start, self.end, self.free, self.origin = (x[keep] for x in (self.start, self.end, self.free, self.origin))
        self.coefficients = {n: np.ascontiguousarray(c[:, keep.numpy()]) for n, c in self.coefficients.items()}
        self.canonical_rate = CanonicalRate(self.key.params["means"], self._steps, self._entropy)

    def append(self, children: dict[str, torch.Tensor], parents: torch.Tensor) -> None:
        """Adds canonical Gaussians, which live and move as their `parents` ([K] index) do."""
        self.key.append(children)
        self.graph.extend(children["means"])
        self.start, self.end, self.free = (torch.cat([x, x[parents]]) for x in (self.start, self.end, self.free))
        self.origin = torch.cat([self.origin, torch.full((len(parents),), -1)])
        index = parents.numpy()
        self.coefficients = {n: np.concatenate([c, c[:, index]], 1) for n, c in self.coefficients.items()}
        self.canonical_rate = CanonicalRate(self.key.params["means"], self._steps, self._entropy)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._tracked_poses)

    def _hold_outside_lifetime(self, x: list[torch.Tensor]) -> torch.Tensor:
        """T values of each Gaussian, [T, N, ...]; outside of its lifetime those of its first or last frame."""
        x = torch.stack(x)
        frame = torch.arange(len(x))[:, None].clamp(min=self.start, max=self.end - 1)
        return x[frame, torch.arange(x.shape[1])]

    def _canonical(self, key: Model | None, tracked: list[Model]) -> Model:
        """Canonical Gaussians: `key`, then the new ones as the mean of their tracked frames, in the keyframe's pose."""
        rotations = [self.graph.carry(self.graph.means, pose)[1] for pose in self._tracked_poses]
        if self._turned:
            tracked = [_turned_back(m, q) for m, q in zip(tracked, rotations, strict=True)]
        params = {n: self._hold_outside_lifetime([m.params[n] for m in tracked]).mean(0) for n in NAMES}
        params["means"] = self.graph.means
        back = [quat_product(q, m.params["quats"], inverse_a=True) for q, m in zip(rotations, tracked, strict=True)]
        back = self._hold_outside_lifetime(back)
        back = back * torch.where((back * back[-1]).sum(2, keepdim=True) < 0, -1.0, 1.0)
        params["quats"] = torch.nn.functional.normalize(back.sum(0), dim=1)
        if key is not None:
            params = {n: torch.cat([key.params[n], p[self.known :]]) for n, p in params.items()}
        return Model(params)

    def _project(self, tracked: list[Model]) -> dict[str, np.ndarray]:
        """Lowest temporal frequencies of the tracked frames minus the canonical Gaussians as the nodes carry them."""
        p = self.key.params
        residual: dict[str, list] = {name: [] for name in self.settings.frequencies}
        for model, pose in zip(tracked, self._tracked_poses, strict=True):
            means, rotations = self.graph.carry(p["means"], pose)
            q = model.params
            dq = quat_product(q["quats"], quat_product(rotations, p["quats"]), inverse_b=True)
            residual["means"].append(q["means"] - means)
            residual["quats"].append(dq[:, 1:] * torch.where(dq[:, :1] < 0, -1.0, 1.0))
            for name in ("log_scales", "sh0"):
                residual[name].append(q[name] - p[name])
            faded = (q["logit_opacities"] - p["logit_opacities"])[:, None]
            residual["logit_opacities"].append(torch.where(q["logit_opacities"][:, None] > REMOVED_LOGIT, faded, 0.0))
        out, per = {}, self.settings.frequencies_frames
        for name, most in self.settings.frequencies.items():
            low = torch.from_numpy(self.basis[: -(-most * max(len(tracked), per) // per)])
            c = torch.einsum("kt,tnc->knc", low, self._hold_outside_lifetime(residual[name])) / self.unit[name]
            out[name] = c.contiguous().numpy()
        return out

    def at(self, name: str, t: int) -> np.ndarray:
        """[K] f32, residual of an attribute at frame `t` per unit of each coefficient."""
        return self.unit[name] * self.basis[: len(self.coefficients[name]), t]

    def pose(self, t: int) -> tuple[Pose, torch.Tensor, FieldMotion | None]:
        """Corrected pose of the nodes at frame `t`; their turn after the tracked rotation, [M, 3] rotation vectors;
        motion from the field."""
        turn, shift, by_field = self.turns[t], self.shifts[t], None
        if self.field is not None:
            by_field = self.field(t)
            turn, shift = turn + by_field.turn * self.carriers, shift + by_field.shift * self.carriers
        return self._tracked_poses[t].moved(turn, shift), turn, by_field

    def by_nodes(
        self, t: int, frame: Frame, by_carried: tuple[torch.Tensor, torch.Tensor], rigidity: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradients [M, 3] and [M, 3] by the turns and shifts of the nodes at frame `t` (`NodeGraph.gradients`)."""
        base = self._tracked_poses[t].rotations, frame.turn
        by_turns, by_shifts = self.graph.gradients(frame.rest, base, frame.pose, by_carried, rigidity)
        return by_turns * self.carriers, by_shifts * self.carriers

    def frame(
        self, t: int, backend: Backend, noise: dict[str, torch.Tensor] | None = None, shrinkage: float = 0.0
    ) -> Frame:
        """Frame `t`.

        Args:
            noise: attribute -> noise added to the canonical values; None: no noise.
            shrinkage: quantization steps by which coefficients are moved towards 0.
        """
        p, zone = self.key.params, self.settings.dead_zone + shrinkage
        if noise is not None:
            p = {n: v + noise[n] for n, v in p.items()}
        delta = {
            n: torch.from_numpy(backend.trajectory_sum(c, self.at(n, t), zone)) for n, c in self.coefficients.items()
        }
        pose, turn, by_field = self.pose(t)
        means, rotations = self.graph.carry(p["means"], pose)
        dq = delta["quats"]
        residual = torch.cat([(1 - dq.square().sum(1, keepdim=True)).clamp(min=1e-6).sqrt(), dq], 1)
        inner = quat_product(rotations, p["quats"])
        shown = (self.start <= t) & (t < self.end)
        opacities = p["logit_opacities"] + delta["logit_opacities"][:, 0]
        params = {
            **p,
            "means": means + delta["means"],
            "quats": quat_product(residual, inner),
            "log_scales": p["log_scales"] + delta["log_scales"],
            "logit_opacities": torch.where(shown, opacities, REMOVED_LOGIT),
            "sh0": p["sh0"] + delta["sh0"],
        }
        if self._turned:
            params[TURNS] = rotations
        return Frame(params, pose, turn, by_field, means, p["means"], rotations, residual, inner, p["quats"], shown)

    def limit_sizes(self, t: int, frame: Frame, bound: SizeBound | None) -> float:
        """Corrects the trajectories of Gaussians that are larger than `bound` in `frame` (frame `t`) so that they meet
        it; returns the largest excess of a size, natural log."""
        if bound is None:
            return 0.0
        excess = (frame.params["log_scales"] - bound.log_scales(frame.params["means"])).clamp(min=0)
        large = torch.nonzero(excess.any(1))[:, 0].numpy()
        if len(large):
            at = self.at("log_scales", t)
            self.coefficients["log_scales"][:, large] -= (at / (at @ at))[:, None, None] * excess.numpy()[large]
        return float(excess.max()) if len(excess) else 0.0

    def gradients(self, frame: Frame, grads: dict[str, torch.Tensor]) -> tuple[dict, dict, torch.Tensor]:
        """Converts gradients by rendered attributes into those by the residuals, attribute -> [N, C], 0 for Gaussians
        that are not free; by the canonical attributes; and by the rotations of the nodes, [N, 4]."""
        by_inner = quat_product(frame.residual, grads["quats"], inverse_a=True)
        by_residual = quat_product(grads["quats"], frame.inner, inverse_b=True)
        by_dq = by_residual[:, 1:] - by_residual[:, :1] * (frame.residual[:, 1:] / frame.residual[:, :1])
        opacities = grads["logit_opacities"] * frame.shown
        residuals = {**grads, "quats": by_dq, "logit_opacities": opacities[:, None]}
        free = self.free[:, None]
        residuals = {n: (residuals[n] * free).numpy() for n in self.coefficients}
        canonical = {
            **grads,
            "means": rotate(quat_conjugate(frame.rotations), grads["means"]),
            "quats": quat_product(frame.rotations, by_inner, inverse_a=True),
            "logit_opacities": opacities,
        }
        return residuals, canonical, quat_product(by_inner, frame.quats, inverse_b=True)

    def group(self, parents: np.ndarray | None) -> ParametricGroup:
        """The group as it is encoded; `parents` as in ParametricGroup."""
        frames = self.frames
        lifetimes = torch.stack([self.start, self.end], 1).numpy().astype(np.int32)
        cut = (lifetimes != [0, frames]).any()
        used = {n: rounded(c, self.settings.dead_zone) * self.unit[n] for n, c in self.coefficients.items()}
        return ParametricGroup(
            frames,
            self.key.gaussians(),
            self.nodes(),
            {n: np.ascontiguousarray(c.transpose(0, 2, 1), np.float32) for n, c in used.items() if c.any()},
            lifetimes if cut else None,
            parents,
            rate_optimized=True,
            turned_harmonics=self._turned,
        )

    def nodes(self) -> NodeMotion:
        """Motion of the nodes in all frames."""
        rotations, near = [], None
        poses = [self.pose(t)[0] for t in range(self.frames)]
        for pose in poses:
            near = quat_to_rotvec(pose.rotations, near)
            rotations.append(near)
        translations = [pose.nodes - self.graph.nodes for pose in poses]
        arrays = (self.graph.nodes, torch.stack(rotations), torch.stack(translations))
        return NodeMotion(*(a.numpy().astype(np.float32) for a in arrays), self.graph.neighbors, self.graph.weights)


def _turned_back(model: Model, rotations: torch.Tensor) -> Model:
    """The model with harmonics as they were before `rotations` [N, 4]."""
    return Model({**model.params, "shN": harmonics_turned(model.params["shN"], rotations, back=True)})


def _padded(model: Model, last: Model) -> Model:
    """The model, and the Gaussians that it does not have yet, copied from `last`."""
    return Model({n: torch.cat([p, last.params[n][len(p) :]]) for n, p in model.params.items()})


def _at_rest_until_added(poses: list[Pose]) -> list[Pose]:
    """Poses of all nodes; before it is added, a node has the pose with which it is added."""
    whole = poses[-1:]
    for pose in poses[-2::-1]:
        known, later = len(pose.nodes), whole[0]
        arrays = {f.name: torch.cat([getattr(pose, f.name), getattr(later, f.name)[known:]]) for f in fields(Pose)}
        whole.insert(0, Pose(**arrays))
    return whole
