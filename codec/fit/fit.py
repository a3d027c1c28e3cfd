"""Dense groups -> ParametricGroups: index i is the same Gaussian in all frames of a group; its motion is estimated.

A group that continues another one (`DenseGroup.parents`) has the rest positions of the first group of its segment, so
that the encoder can predict it from that group. Nothing is lost: trajectories have all T frequencies.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import partial

import numpy as np

from ..bitstream.quantization import steps_for, subject_radius
from ..model.attributes import CANONICAL
from ..model.gaussian_sequence import DenseGroup
from ..model.gaussians import Gaussians
from ..model.parametric_group import NodeMotion, ParametricGroup, checked_parents
from ..model.rig import Rig, RigMotion
from ..model.rotations import quat_conjugate, quat_multiply, quat_normalize, rotate
from ..model.skin_weights import skin_weights
from ..model.temporal_transform import dct_basis
from .dense_stack import DenseStack
from .node_fit import Predict, fit_nodes


def fit_groups(
    groups: Sequence[DenseGroup | ParametricGroup],
    *,
    start: int = 0,
    random_access: int = 0,
    quality: float = 50.0,
    rig: Rig | None = None,
) -> Iterator[ParametricGroup]:
    """Yields the groups from `start` on; parametric groups unchanged.

    Args:
        random_access: frames from one independent group to the next at most; 0 or 1: all groups rest by themselves.
        quality: of the stream (0 to 100); it decides how many nodes pay.
        rig: with poses of all frames of `groups`, predicts the motion of groups that are fitted.
    """
    rest, since = None, 0  # rest positions of the group before, and frames since the first of its segment
    first = _segment_start(groups, start, random_access)
    frame = sum(map(len, groups[:first])) if rig else 0
    at_rest = frame  # the frame in which the segment rests
    for i in range(first, len(groups)):
        group = groups[i]
        if isinstance(group, ParametricGroup):
            rest, fitted = None, group
        else:
            continues = rest is not None and group.parents is not None and since + len(group) <= random_access
            at_rest = at_rest if continues else frame + len(group) // 2
            predict = rig and partial(_predicted, rig, at_rest, range(frame, frame + len(group)))
            fitted = fit_group(group, quality=quality, rest=rest if continues else None, predict=predict)
            since = since + len(group) if continues else len(group)
            rest = fitted.canonical.means
        frame += len(group)
        if i >= start:
            yield fitted


def _predicted(rig: Rig, at_rest: int, frames: range, places: np.ndarray) -> RigMotion:
    """Motion that a rig predicts for nodes at `places` [M, 3], which rest as they are in frame `at_rest`."""
    return rig.motion(skin_weights(rig, at_rest, places), at_rest, frames)


def _segment_start(groups, start: int, random_access: int) -> int:
    """The last group up to `start` that needs no group before it."""
    first, since = 0, 0
    for i in range(start + 1 if start < len(groups) else 0):
        group = groups[i]
        if isinstance(group, ParametricGroup) or group.parents is None or since + len(group) > random_access:
            first, since = i, 0
        since += len(group)
    return first


def fit_group(
    group: DenseGroup, *, quality: float = 50.0, rest: np.ndarray | None = None, predict: Predict | None = None
) -> ParametricGroup:
    """Fits one group.

    Args:
        rest: [P, 3] rest positions of the Gaussians of the group before, to which `group.parents` refers; None: the
            group rests as it is in its middle frame.
        predict: positions of nodes at rest -> motion that a rig predicts for them.
    """
    frames, own = len(group), (group.lifetimes, group.parents)
    if frames == 1:
        return ParametricGroup(1, group.frames[0], None, {}, *own)
    stack = DenseStack.of(group)
    middle = stack.at(frames // 2)
    if not len(middle):
        return ParametricGroup(frames, middle, None, {}, *own)
    nodes, means = _motion(stack, middle, group.parents if rest is not None else None, rest, quality, predict)
    still = ParametricGroup(frames, _with(middle, means=means), nodes)
    carried, rotations = still.carried()
    middle_rotations = rotations[stack.nearest_frame(frames // 2), np.arange(len(middle))]
    quats = quat_normalize(quat_multiply(quat_conjugate(middle_rotations), middle.quats))
    canonical = _with(middle, means=means, quats=quats)
    trajectories = _trajectories(stack, canonical, carried, rotations)
    return ParametricGroup(frames, canonical, nodes, trajectories, *own)


def _motion(stack, middle: Gaussians, parents, rest, quality, predict) -> tuple[NodeMotion | None, np.ndarray]:
    """Nodes of the group, and rest positions [N, 3] of its Gaussians."""
    step = steps_for(quality, subject_radius(middle.means))["means"]
    if parents is None:
        return fit_nodes(middle.means, stack.frames.means, step, predict=predict), middle.means
    known = np.flatnonzero(checked_parents(parents, len(middle), len(rest)) >= 0)
    if not len(known):
        return None, middle.means
    places = rest[parents[known]]
    nodes = fit_nodes(places, stack.frames.means[:, known], step, predict=predict)
    means = middle.means.copy()
    if nodes is not None:
        born = np.flatnonzero(parents < 0)
        nodes, means[born] = _carried_back(nodes, places, len(stack) // 2, middle, known, born)
    means[known] = places
    return nodes, means


def _carried_back(nodes, places, middle: int, g: Gaussians, known, born) -> tuple[NodeMotion, np.ndarray]:
    """Nodes of all Gaussians, and rest positions of the `born` ones: each takes the nodes of the nearest `known`
    Gaussian (which rests at `places`), whose motion carries it back from the middle frame."""
    from scipy.spatial import cKDTree

    survivors = ParametricGroup(len(nodes.rotations), _with(g.take(known), means=places), nodes)
    carried, rotations = survivors.carried()
    near = cKDTree(carried[middle]).query(g.means[born])[1]
    off = rotate(quat_conjugate(rotations[middle, near]), g.means[born] - carried[middle, near])
    index = np.empty(len(g), int)
    index[known], index[born] = np.arange(len(known)), near
    return nodes.take(index), places[near] + off


def _trajectories(stack, canonical: Gaussians, carried: np.ndarray, rotations: np.ndarray) -> dict[str, np.ndarray]:
    """attribute -> [T, C, N] f32 DCT coefficients of the residual of canonical values and nodes; 0 is left out."""
    frames, f = len(stack), stack.frames
    dq = quat_multiply(f.quats, quat_conjugate(quat_multiply(rotations, canonical.quats[None])))
    residual = {"means": f.means - carried, "quats": np.copysign(1, dq[..., :1]) * dq[..., 1:]}
    for name in (n for n in CANONICAL if n != "quats"):
        residual[name] = getattr(f, name) - getattr(canonical, name)
    basis, n, out = dct_basis(frames).astype(np.float32), len(canonical), {}
    for name, values in residual.items():
        values = stack.held(values).reshape(frames, n, -1)
        if values.any():
            c = (basis @ values.reshape(frames, -1)).reshape(values.shape)
            out[name] = np.ascontiguousarray(c.transpose(0, 2, 1))
    return out


def _with(g: Gaussians, **changes: np.ndarray) -> Gaussians:
    """`g` with other arrays."""
    return Gaussians(**{f.name: changes.get(f.name, getattr(g, f.name)) for f in fields(Gaussians)})
