"""A group as survivors, deaths and births of an independent one: the integers of what has changed.

In: a group, its Gaussians' parents in the reference, the reference as it was coded. Out: the input of
`_native.encode_group`. Survivors keep the canonical integers of the reference; nodes carry them from there, however far
they have moved since, and coefficient 0 of their trajectories says what else has changed. Births are carried back to
where the reference would have had them, so that the same nodes move them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import _native
from ..bitstream.quantization import error_for
from ..model.camera import Camera
from ..model.gaussians import Group
from . import companding as curved
from . import rdo
from .axis_order import canonical_axes, quat_conjugate, quat_multiply, rotate
from .channels import curves_of, dequantize_channels, shifts_of
from .intra_group import Coded, Grid, motion_integers
from .node_fit import NodeMotion, Nodes, carry, choose_nodes, given_nodes
from .quantization_plan import PRUNE, layer_of, measure_stack
from .refine_group import refine_group
from .refinement_views import PictureTargets, targets_of
from .rotation_residuals import code_turns, in_form
from .stack import Stack, align_axes, canonical_appearance, stack_group

REBIRTH = 8.0  # times PRUNE: what the reference left out must matter so much more to come back
ROUNDS = 3  # of carrying births back


def predict_group(
    group: Group,
    parents: np.ndarray,
    back: int,
    reference: Coded,
    *,
    quality: float,
    decoded=None,
    keep_all: bool = False,
    views: int = 0,
    cameras: list[Camera] = (),
    pictures: PictureTargets | None = None,
) -> dict:
    """Integers of a group that is predicted.

    Args:
        group: T >= 1 frames of N Gaussians.
        parents: [N] int, index of each in the group that was coded as `reference`, -1: not there.
        back: how many groups before this one that is.
        decoded: the reference, as decoded.
        quality, keep_all, views, cameras, pictures: as in `code_group`.
    """
    s = stack_group(group)
    parent = _coded_parents(parents, reference.source)
    alive, born = parent >= 0, parent < 0
    measured = measure_stack(s, cameras)
    if not keep_all and len(parent):
        least = PRUNE * error_for(quality) / len(parent)
        alive &= measured.removal > 0
        born &= measured.removal >= np.where(parents < 0, least, REBIRTH * least)
    survivors = np.flatnonzero(alive)
    survivors = survivors[parent[survivors].argsort()]
    births = np.flatnonzero(born)
    known = parent[survivors]
    old, new = s.take(survivors), s.take(births)

    middle, steps, grid = len(s.means) // 2, reference.steps, reference.grid
    positions = reference.integers["positions"][known]
    old = align_axes(old, middle, reference.turn[known], reference.order[known])
    x = grid.to_world(positions)
    price = rdo.bit_price(error_for(quality), len(known) + len(births), group.nodes is not None)
    heard = measured.weights["means"][survivors]
    nodes = _nodes(group, positions, x, old.means, reference, heard, price) if len(known) else None
    motion = nodes and carry(nodes, positions, x, len(s.means))
    rest = None if group.nodes is None else group.nodes.rest[births]
    places = _carry_back(new, middle, rest, x, nodes, motion, grid)
    order = _native.morton_order(places)
    places, births, new = places[order], births[order], new.take(order)
    before = reference.integers
    born_in = layer_of(measured.take(births), len(before["layers"]))
    shifts = {n: v[born_in] for n, v in shifts_of(before).items()}
    unit = 1 << shifts["means"][:, None].astype(np.uint32)
    places = places // unit * unit
    new_motion = nodes and carry(nodes, places, grid.to_world(places), len(s.means))
    new, quats = _canonical_births(new, middle, new_motion)

    values = canonical_appearance(new)
    channels = {n: _with_births(before["channels"][n], known, v, shifts[n]) for n, v in values.items()}
    turning, born_layers = before["channels"]["quats"], [(np.flatnonzero(born_in == k), None) for k in set(born_in)]
    sizes = dequantize_channels(channels["log_scales"])[len(known) :]
    turns, forms = code_turns(quats, sizes, places, turning, born_layers, shifts["quats"])
    channels["quats"] = turning | {"values": np.concatenate([turning["values"][:, known], turns], 1)}
    rotations = np.concatenate([reference.rotations[known], in_form(quats, forms)])
    s = _join(old, replace(new, quats=in_form(new.quats, forms)))
    layer = np.repeat(np.arange(len(before["layers"])), before["layers"])[known]
    layer = np.concatenate([layer, born_in])
    place = np.lexsort((np.arange(len(layer)) >= len(known), layer))  # in each layer survivors, then births
    s, positions, rotations = s.take(place), np.concatenate([positions, places])[place], rotations[place]
    measured = measured.take(np.concatenate([survivors, births])[place])
    channels = {n: c | {"values": np.ascontiguousarray(c["values"][:, place])} for n, c in channels.items()}
    if motion:
        both = ((motion.carried, new_motion.carried), (motion.turned, new_motion.turned))
        motion = NodeMotion(*(np.concatenate(pair, 1)[:, place] for pair in both))
    out = before | {
        "frames": len(s.means),
        "reference": back,
        "parents": np.concatenate([known, np.full(len(places), -1)])[place].astype(np.int32),
        "layers": np.bincount(layer, minlength=len(before["layers"])).tolist(),
        "positions": positions,
        "channels": channels,
        "nodes": None,
        "lifetimes": None if s.lifetimes is None else s.lifetimes.astype(np.uint16),
    }
    x = grid.to_world(positions)
    out |= motion_integers(s, channels, rotations, steps, measured, price, x, nodes, motion)
    if targets := targets_of(s.means[middle], views, cameras, pictures):
        out = refine_group(out, s, measured.weights, price, targets, decoded)
    return out


def _nodes(
    group: Group, positions, x: np.ndarray, means: np.ndarray, reference: Coded, weights: np.ndarray, price: float
) -> Nodes | None:
    """The trainer's nodes, which rest where the reference does, or what fits the means [T, N, 3]."""
    if group.nodes is not None:
        return given_nodes(group.nodes, positions, reference.node_step, reference.grid, weights, price)
    grid = reference.grid
    return choose_nodes(positions, x, means, grid.step, reference.node_step, grid.to_world)


def _coded_parents(parents: np.ndarray, source: np.ndarray) -> np.ndarray:
    """[N] int, place among the integers of the reference of each Gaussian's parent, -1: it is not there."""
    place = np.full(max(parents.max(initial=-1), source.max(initial=-1)) + 2, -1)  # the last one is that of -1
    place[source] = np.arange(len(source))
    return place[parents]


def _carry_back(
    s: Stack, middle: int, rest: np.ndarray | None, x: np.ndarray, nodes: Nodes | None, motion, grid: Grid
) -> np.ndarray:
    """[B, 3] u32, grid points from which the nodes carry the births `s` to where they are in frame `middle`, or the
    nearest to it in which they are shown.

    From `rest` ([B, 3]), or where the trainer does not know it, from where the motion of the nearest survivor comes
    from (x [N, 3] are the survivors' canonical positions): then the error is undone.
    """
    at, each = s.near(middle), np.arange(s.means.shape[1])
    means = s.means[at, each]
    if nodes is None or not len(means):
        return grid.to_integers(means)
    if rest is None:
        from scipy.spatial import cKDTree

        near = cKDTree(motion.carried[middle]).query(means)[1]
        rest = x[near] + rotate(quat_conjugate(motion.turned[middle, near]), means - motion.carried[middle, near])
    for _ in range(ROUNDS):
        on_grid = grid.to_integers(rest)
        moved = carry(nodes, on_grid, grid.to_world(on_grid), len(s.means))
        rest = rest + rotate(quat_conjugate(moved.turned[at, each]), means - moved.carried[at, each])
    return grid.to_integers(rest)


def _canonical_births(s: Stack, middle: int, motion: NodeMotion | None) -> tuple[Stack, np.ndarray]:
    """Births with their axes by falling scale, and their canonical quaternions, [B, 4]."""
    at, each = s.near(middle), np.arange(s.means.shape[1])
    quats = s.quats[at, each]
    if motion is not None:
        quats = quat_multiply(quat_conjugate(motion.turned[at, each]), quats)
    turn, order = canonical_axes(s.log_scales[at, each])
    return align_axes(s, middle, turn, order), quat_multiply(quats.astype(np.float64), turn)


def _with_births(c: dict, known: np.ndarray, values: np.ndarray, shifts: np.ndarray) -> dict:
    """Channels of the survivors, those at `known` of the reference's, and of births with `values` [B, C], whose steps
    are 2^shifts ([B]) times those of the attribute."""
    steps, offsets = np.array(c["steps"], np.float32), np.array(c["offsets"], np.float32)
    unit = 2.0 ** shifts[:, None]
    values = curved.along(values, curves_of(c))
    own = (np.rint((values - offsets) / (steps * unit)) * unit).astype(np.int32).T
    return c | {"values": np.concatenate([c["values"][:, known], own], 1)}


def _join(a: Stack, b: Stack) -> Stack:
    """The Gaussians of `a`, then those of `b`."""
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    lifetimes = None if a.lifetimes is None else np.concatenate([a.lifetimes, b.lifetimes])
    return Stack(*(np.concatenate([getattr(a, n), getattr(b, n)], 1) for n in names), lifetimes)
