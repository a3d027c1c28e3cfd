"""A group in the form that is coded: axes sorted, rest pose at the mean of the motion, colours decorrelated.

In: ParametricGroup. Out: CodedForm, which renders the same in every frame. Gaussians that a reference has coded keep
the form of the reference, and the rounding of their canonical values if refinement by pictures has chosen it: a
predicted group then codes the changes since, and does not undo the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..bitstream.color import TO_YCOCG, decorrelate
from ..model.attributes import BY_NAME, CANONICAL
from ..model.gaussians import Gaussians
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rotations import quat_conjugate, quat_multiply, quat_normalize, rotate
from .axis_order import sorted_axes

APPEARANCE = tuple(n for n in CANONICAL if n != "quats")  # attributes whose trajectories are plain sums


@dataclass(frozen=True)
class CodedForm:
    """N Gaussians over T frames.

    Attributes:
        group: source of the form.
        index: [N] int, index of each Gaussian in `group`.
        lineage: [N] int, index of each Gaussian in the integers of the reference; -1: a birth.
        rest: [N, 3] f64 rest positions, from which the nodes carry each Gaussian nearest to its means in all frames.
        rotations: [N, 4] f32 canonical quaternions, axes as in `group`.
        axis_order: [N, 3] int, order of the axes for coding (`sorted_axes`).
        axis_rotation: [N, 4] f32, the same as a right factor of the quaternions; it cancels where two rotations of one
            Gaussian are compared.
        values: attribute -> [N, C] f64 canonical values of APPEARANCE, the mean over time.
        trajectories: attribute -> [K, C, N] f32 DCT coefficients of APPEARANCE.
        means: [T, N, 3] f32 of all frames.
        quats: [T, N, 4] f32 of all frames, axes as in `group`.
    """

    group: ParametricGroup
    index: np.ndarray
    lineage: np.ndarray
    rest: np.ndarray
    rotations: np.ndarray
    axis_order: np.ndarray
    axis_rotation: np.ndarray
    values: dict[str, np.ndarray]
    trajectories: dict[str, np.ndarray]
    means: np.ndarray
    quats: np.ndarray

    @property
    def frames(self) -> int:
        """Number of frames, T."""
        return self.group.frame_count

    @property
    def nodes(self) -> NodeMotion | None:
        """Coarse motion, with neighbours and weights of these Gaussians."""
        return self.group.nodes and self.group.nodes.take(self.index)

    @cached_property
    def lifetimes(self) -> np.ndarray | None:
        """[N, 2] as in ParametricGroup."""
        return None if self.group.lifetimes is None else self.group.lifetimes[self.index]

    @property
    def coded_rotations(self) -> np.ndarray:
        """[N, 4] f32 canonical quaternions as they are coded."""
        return quat_multiply(self.rotations, self.axis_rotation)

    def take(self, index: np.ndarray) -> CodedForm:
        """The Gaussians at `index`, in that order."""
        return CodedForm(
            self.group,
            self.index[index],
            self.lineage[index],
            self.rest[index],
            self.rotations[index],
            self.axis_order[index],
            self.axis_rotation[index],
            {n: v[index] for n, v in self.values.items()},
            {n: c[:, :, index] for n, c in self.trajectories.items()},
            self.means[:, index],
            self.quats[:, index],
        )

    def turned(self, forms: np.ndarray) -> CodedForm:
        """Axes also rotated by the inverse of 1, i, j or k (`forms`: [N] 0 to 3); renders the same."""
        inverse = quat_conjugate(np.eye(4, dtype=np.float32))[forms]
        return replace(self, axis_rotation=quat_multiply(self.axis_rotation, inverse))

    def held(self, a: np.ndarray) -> np.ndarray:
        """Values [T, N, ...] of these Gaussians; outside a lifetime they repeat the nearest frame inside."""
        if self.lifetimes is None:
            return a
        t = np.clip(np.arange(len(a))[:, None], self.lifetimes[:, 0], self.lifetimes[:, 1] - 1)
        return a[t, np.arange(a.shape[1])]

    def frame(self, t: int) -> Gaussians:
        """All Gaussians at frame `t`, also those outside their lifetimes."""
        return self.group.frame(t).take(self.index)


@dataclass(frozen=True)
class ReferenceForm:
    """The form in which n Gaussians of a reference were coded, in the order of its integers.

    Attributes:
        rest, rotations, axis_order, axis_rotation: as in `CodedForm`.
        rounding: attribute -> [n, C] f64, rounding of the canonical values by coding, which stays; {}: none.
    """

    rest: np.ndarray
    rotations: np.ndarray
    axis_order: np.ndarray
    axis_rotation: np.ndarray
    rounding: dict[str, np.ndarray]


def coded_form(group: ParametricGroup, lineage: np.ndarray, known: ReferenceForm | None = None) -> CodedForm:
    """The form of all Gaussians of a group; `lineage` as in `CodedForm`."""
    order, rotation = sorted_axes(group.canonical.log_scales)
    means, quats = group.moved()
    rest, rotations = _recentered(group, means, quats)
    if known is not None:
        old = lineage >= 0
        order[old], rotation[old] = known.axis_order[lineage[old]], known.axis_rotation[lineage[old]]
        rest[old], rotations[old] = known.rest[lineage[old]], known.rotations[lineage[old]]
    values, trajectories = appearance(group, order)
    if known is not None:
        for name, rounding in known.rounding.items():
            values[name][old] += rounding[lineage[old]]
    index = np.arange(len(group.canonical))
    return CodedForm(group, index, lineage, rest, rotations, order, rotation, values, trajectories, means, quats)


def _recentered(group: ParametricGroup, means: np.ndarray, quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rest positions [N, 3] f64 and canonical quaternions [N, 4] f32 from which the nodes carry each Gaussian nearest
    to its means [T, N, 3] and quats [T, N, 4] in all frames: jitter of one frame does not become canonical."""
    if group.frame_count == 1 or not len(group.canonical):
        return means[0].astype(np.float64), quats[0].copy()
    carried, rotations = group.carried()
    back = quat_conjugate(rotations)
    off, turned = rotate(back, means - carried), quat_multiply(back, quats)
    share = np.full((group.frame_count, 1), 1 / group.frame_count, np.float32)
    if group.lifetimes is not None:
        t = np.arange(group.frame_count)[:, None]
        shown = (group.lifetimes[:, 0] <= t) & (t < group.lifetimes[:, 1])
        share = (shown / np.maximum(shown.sum(0), 1)).astype(np.float32)
    rest = group.canonical.means + np.einsum("tn,tnc->nc", np.broadcast_to(share, off.shape[:2]), off)
    canonical = np.einsum("tn,tnc->nc", np.broadcast_to(share, off.shape[:2]), turned)
    return rest.astype(np.float64), quat_normalize(canonical).astype(np.float32)


def appearance(group: ParametricGroup, order: np.ndarray) -> tuple[dict, dict]:
    """Canonical values and trajectories of APPEARANCE; the constant part of a trajectory is canonical."""
    values, trajectories, g = {}, {}, group.canonical
    for name in APPEARANCE:
        v = np.asarray(getattr(g, name), np.float64)
        c = group.trajectories.get(name)
        if name == "shN" and not g.sh_degree:
            continue
        if name == "log_scales":
            v = np.take_along_axis(v, order, 1)
            c = None if c is None else np.take_along_axis(c, order.T[None], 1)
        elif BY_NAME[name].decorrelated:
            v = decorrelate(v)
            c = None if c is None else _decorrelated(c)
        v = v.reshape(len(g), int(np.prod(v.shape[1:])))
        if c is not None:
            v = v + c[0].T / np.sqrt(group.frame_count)
            c = np.concatenate([np.zeros_like(c[:1]), c[1:]])
            if c.any():
                trajectories[name] = c
        values[name] = v
    return values, trajectories


def _decorrelated(c: np.ndarray) -> np.ndarray:
    """[K, C, N] of RGB triples -> of Y, Co, Cg."""
    triples = c.reshape(len(c), c.shape[1] // 3, 3, c.shape[2])
    return (TO_YCOCG.astype(c.dtype) @ triples).reshape(c.shape)
