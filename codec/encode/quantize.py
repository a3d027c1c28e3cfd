"""Stage quantize: coded form + plan -> QuantizedGroup. Independent and predicted groups take the same way.

Order first: layer after layer; in each layer the survivors of the reference, then births in Morton order. Then
canonical integers, rotations, nodes, trajectories. Each step works on the values that the decoder will have, so errors
do not add up; decoded frames come from `_native.DecodedGroup.reconstruct`, without bytes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .. import _native
from ..bitstream.quantization import trajectory_step
from ..bitstream.quantized_group import QuantizedChannels, QuantizedGroup, QuantizedNodes, QuantizedTrajectories
from ..decode.parametric import rig_motion
from ..model.attributes import CANONICAL, NEIGHBORS_MAX
from ..model.node_solve import solve_translations
from ..model.rotations import quat_conjugate, quat_multiply
from ..model.temporal_transform import dct_basis
from . import companding, rdo
from .coded_form import CodedForm
from .quantization_plan import Grid, Plan
from .quantize_rig import quantize_rig
from .rotation_residuals import quantize_rotations, step_factors
from .settings import RdoSettings

NEIGHBORS = 4  # nodes that are blended for one Gaussian
ROTATION_STEP_MOST = 0.1  # radians


@dataclass(frozen=True)
class ReferenceGroup:
    """Group from which another group is predicted.

    Attributes:
        integers: of the group.
        decoded: the same as `_native.DecodedGroup`.
        back: distance in groups to the predicted group.
    """

    integers: QuantizedGroup
    decoded: object
    back: int


@dataclass(frozen=True)
class Quantized:
    """A group in integers, and its source, all in the order of the integers.

    Attributes:
        integers: the group.
        form: its coded form, in the orientation that is coded.
        plan: of the same Gaussians.
        layers: for each layer, span and context neighbours of the Gaussians that it codes itself.
        coefficients: attribute -> [K, C, N] f32 DCT coefficients in steps, before rounding.
    """

    integers: QuantizedGroup
    form: CodedForm
    plan: Plan
    layers: list[rdo.Layer]
    coefficients: dict[str, np.ndarray]

    def factors(self, attribute: str) -> np.ndarray:
        """[N, 1] factor of each Gaussian on the steps of the first layer."""
        return 2.0 ** self.plan.parameters.shifts[attribute][self.plan.layer][:, None]


def quantize(form: CodedForm, plan: Plan, settings: RdoSettings, reference: ReferenceGroup | None = None) -> Quantized:
    """The integers of a group."""
    form, plan, positions = _ordered(form, plan, reference)
    counts = np.bincount(plan.layer, minlength=plan.parameters.layers).tolist()
    births = np.bincount(plan.layer[form.lineage < 0], minlength=plan.parameters.layers).tolist()
    layers = rdo.coded_layers(positions, counts, births)
    grid, shifts = plan.parameters.grid, plan.parameters.shifts
    integers = QuantizedGroup(
        frames=form.frames,
        origin=grid.origin,
        grid_step=grid.step,
        grid_bits=grid.bits,
        positions=positions,
        channels=_channels(form, plan, layers, reference, settings),
        layers=tuple(counts),
        shifts=np.stack([shifts[n] for n in ("means", *CANONICAL) if n in shifts], 1) if len(counts) > 1 else None,
        scale_exponents=plan.parameters.scale_exponents,
        lifetimes=None if form.lifetimes is None else form.lifetimes.astype(np.uint16),
        reference=reference.back if reference else 0,
        parents=form.lineage.astype(np.int32) if reference else None,
        turned_harmonics=form.group.turned_harmonics,
    )
    still = with_rotations(Quantized(integers, form, plan, layers, {}), settings, reference)
    return _with_motion(still, settings, reference) if form.frames > 1 or reference else still


def _ordered(form: CodedForm, plan: Plan, reference) -> tuple[CodedForm, Plan, np.ndarray]:
    """Form and plan in the order of the integers, and the positions [N, 3] u32 on the grid."""
    grid, lineage = plan.parameters.grid, form.lineage[plan.index]
    born = lineage < 0
    positions = grid.to_integers(form.rest[plan.index], plan.parameters.shifts["means"][plan.layer])
    if reference:
        positions[~born] = reference.integers.positions[lineage[~born]]
    newcomers = np.flatnonzero(born)
    lineage[newcomers[_native.morton_order(positions[newcomers])]] = np.arange(len(newcomers))
    order = np.lexsort((lineage, born, plan.layer))
    plan = plan.ordered(order)
    return form.take(plan.index), plan, positions[order]


def _channels(form, plan, layers, reference, settings) -> dict[str, QuantizedChannels]:
    """Canonical integers of all attributes but quats, which are 0 for now."""
    known, out = form.lineage >= 0, {}
    for name, steps in plan.parameters.steps.items():
        if name == "means":
            continue
        old, curves = reference and reference.integers.channels[name], plan.parameters.curves.get(name)
        offsets, q = np.zeros(len(steps), np.float32), np.zeros((len(steps), len(form.rest)), np.int32)
        if name != "quats":
            values = companding.compand(form.values[name], curves)
            offsets = old.offsets if old else medians(values)
            q = canonical_integers(name, values, offsets, plan, layers, settings)
        if old:
            q[:, known] = old.values[:, form.lineage[known]]
        rows = None if curves is None else np.array([c.row() for c in curves], np.float32)
        out[name] = QuantizedChannels(q, steps, offsets, rows)
    return {n: out[n] for n in CANONICAL if n in out}


def canonical_integers(name: str, values: np.ndarray, offsets: np.ndarray, plan: Plan, layers, settings) -> np.ndarray:
    """[C, N] i32 for companded values [N, C] of the Gaussians that the layers code themselves; 0 for the others."""
    parameters = plan.parameters
    shift, steps = parameters.shifts[name][plan.layer], parameters.steps[name]
    weights = plan.importance.weights[name] * companding.slopes(values, parameters.curves.get(name)) ** 2
    q = np.zeros(values.shape[::-1], np.int32)
    for own, near in layers:
        for c in range(len(steps)):
            step = steps[c] * 2.0 ** shift[own]
            x, w = (values[own, c] - offsets[c]) / step, weights[own, c] * step**2
            q[c, own] = rdo.quantize_canonical(x, w, near, plan.price, settings).astype(np.int32) << shift[own]
    return q


def medians(values: np.ndarray) -> np.ndarray:
    """[C] f32 offsets, so that small integers are common."""
    return (np.median(values, axis=0) if len(values) else np.zeros(values.shape[1])).astype(np.float32)


def dequantize(channels: QuantizedChannels, curves: list | None) -> np.ndarray:
    """[N, C] f64 values that the decoder makes of an attribute's integers; not for quats."""
    coded = channels.offsets + channels.steps * channels.values.T.astype(np.float32)
    return companding.expand(coded.astype(np.float64), curves)


def with_rotations(q: Quantized, settings: RdoSettings, reference: ReferenceGroup | None = None) -> Quantized:
    """`q` with integers for the rotations of births, whose steps follow from the decoded sizes."""
    plan, channels = q.plan, q.integers.channels["quats"]
    sizes = dequantize(q.integers.channels["log_scales"], plan.parameters.curves.get("log_scales"))
    steps = np.minimum(channels.steps * step_factors(sizes, plan.parameters.scale_exponents), 1) * q.factors("quats")
    weights, positions = plan.importance.weights["quats"], q.integers.positions
    found, forms = quantize_rotations(q.form.coded_rotations, steps, positions, q.layers, weights, plan.price, settings)
    values = found.T << plan.parameters.shifts["quats"][plan.layer]
    if reference:
        known = q.form.lineage >= 0
        values[:, known] = channels.values[:, known]
    quats = replace(channels, values=np.ascontiguousarray(values, np.int32))
    integers = replace(q.integers, channels={**q.integers.channels, "quats": quats})
    return replace(q, integers=integers, form=q.form.turned(forms))


def _with_motion(q: Quantized, settings: RdoSettings, reference: ReferenceGroup | None) -> Quantized:
    """`q` with nodes, and with trajectories for the residual of canonical values and nodes."""
    form, plan = q.form, q.plan
    if not len(form.rest):
        return q
    nodes = form.nodes and _quantize_nodes(form, q.integers.positions, plan, settings)
    integers = replace(q.integers, nodes=nodes)
    decoded = _native.DecodedGroup.reconstruct(integers, reference.decoded if reference else None)
    trajectories, coefficients = {}, {}
    for name, c in _residual_coefficients(form, integers, plan, decoded).items():
        step = trajectory_step(plan.parameters.trajectory_steps[name], form.frames)
        importance = plan.importance
        weights = importance.scene_rotations if name == "quats" else importance.weights[name]
        c = coefficients[name] = c / np.float32(step)
        found = rdo.quantize_trajectories(c, weights * step**2, form.frames, plan.price, settings)
        if found.any():
            trajectories[name] = QuantizedTrajectories(found, step)
    return replace(q, integers=replace(integers, trajectories=trajectories), coefficients=coefficients)


def _residual_coefficients(form: CodedForm, integers: QuantizedGroup, plan: Plan, decoded) -> dict[str, np.ndarray]:
    """attribute -> [K, C, N] f32 DCT coefficients of the form, less the decoded values without trajectories.

    Rotations are compared before their rounding: trajectories code motion, not rounding errors.
    """
    frames = form.frames
    carried, rotations = decoded.carried()
    dq = quat_multiply(form.quats, quat_conjugate(quat_multiply(rotations, form.rotations[None])))
    residual = {"means": form.means - carried, "quats": np.copysign(1, dq[..., :1]) * dq[..., 1:]}
    basis, out = dct_basis(frames).astype(np.float32), {}
    for name, values in residual.items():
        values = form.held(values)
        c = (basis @ values.reshape(frames, -1)).reshape(values.shape)
        out[name] = np.ascontiguousarray(c.transpose(0, 2, 1))
    for name, values in form.values.items():
        left = values - dequantize(integers.channels[name], plan.parameters.curves.get(name))
        constant = (np.sqrt(frames) * left.T).astype(np.float32)
        c = form.trajectories.get(name)
        out[name] = constant[None] if c is None else np.concatenate([(c[0] + constant)[None], c[1:]])
    return out


def _quantize_nodes(form: CodedForm, positions: np.ndarray, plan: Plan, settings: RdoSettings) -> QuantizedNodes:
    """The nodes of a group whose Gaussians rest at `positions` [N, 3] u32. Rotations first; translations then
    compensate the rounding of the rotations, in one least-squares solution for all frames and axes."""
    from scipy.spatial import cKDTree

    nodes, grid, price, frames = form.nodes, plan.parameters.grid, plan.price, form.frames
    on_grid, first = np.unique(grid.to_integers(nodes.positions), axis=0, return_index=True)
    order = _native.morton_order(on_grid)
    on_grid, first = on_grid[order], first[order]
    places, x = grid.to_world(on_grid), grid.to_world(positions)
    step = plan.parameters.node_step
    rotation_step = _rotation_step(step, cKDTree(places).query(x)[0])
    index, share = _native.node_weights(positions, on_grid, NEIGHBORS)
    shift_weights, rotation_weights = _node_weights(index, share, x, places, plan.importance.weights["means"])
    basis = dct_basis(frames).astype(np.float32)

    def quantized(values: np.ndarray, weights: np.ndarray, step: float) -> np.ndarray:
        c = np.tensordot(basis / np.float32(step), values.astype(np.float32), 1).transpose(0, 2, 1)
        return rdo.quantize_trajectories(c, weights * step**2, frames, price, settings)

    turned = nodes.rotations[:, first]
    moved = nodes.translations[:, first] + (nodes.positions[first] - places)  # the node rests on the grid
    rig, predicted = nodes.rig and quantize_rig(nodes.rig.take_nodes(first), grid, step), None
    if rig is not None:
        predicted = rig_motion(rig, grid.origin, grid.step)
        turned, _ = predicted.residual(places, turned, moved)
    rotations = quantized(turned, rotation_weights, rotation_step)
    decoded = rotation_step * np.tensordot(basis[: len(rotations)].T, rotations.transpose(0, 2, 1), 1)
    if predicted is not None:
        decoded, _ = predicted.total(places, decoded, np.zeros_like(decoded))
    moved = solve_translations((places, decoded, moved), x, form.held(form.means), (index, share))
    if predicted is not None:
        _, moved = predicted.residual(places, decoded, moved)
    translations = quantized(moved, shift_weights, step)
    used = max(len(rotations), len(translations))
    padded = [np.pad(p, ((0, used - len(p)), (0, 0), (0, 0))) for p in (rotations, translations)]
    neighbors = min(NEIGHBORS, NEIGHBORS_MAX, len(on_grid))
    return QuantizedNodes(on_grid, np.concatenate(padded, 1), rotation_step, step, neighbors, rig)


def _node_weights(index, share, x, places, weights) -> tuple[np.ndarray, np.ndarray]:
    """Sensitivities [M, 3] of translations and of rotations of nodes at `places`, from those of the means [N, 3] of the
    Gaussians at x [N, 3] that blend nodes `index` by `share` ([N, k])."""
    own = share.astype(np.float64) ** 2 * weights.mean(1, keepdims=True)
    away = ((x[:, None] - places[index]) ** 2).sum(2)
    total = lambda w: np.bincount(index.ravel(), w.ravel(), len(places))[:, None].repeat(3, 1)  # noqa: E731
    return total(own), total(own * away * 2 / 3)


def _rotation_step(step: float, distance: np.ndarray) -> float:
    """Radians: at the RMS distance from a node, an error of one rotation step moves a Gaussian by one `step`."""
    arm = np.sqrt((distance**2).mean()) if len(distance) else 0.0
    return float(np.float32(min(step / max(arm, 1e-12), ROTATION_STEP_MOST)))


def grid_of(integers: QuantizedGroup) -> Grid:
    """The lattice of a group in integers."""
    return Grid(np.asarray(integers.origin, np.float32), integers.grid_step, integers.grid_bits)
