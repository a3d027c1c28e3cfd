"""Floats to integers: one group of Gaussians -> the integer maps that `_native.encode_group` turns into bytes.

Stages: sort each Gaussian's axes, plan what it is coded with (plan.py), fit the motion, find the pose from which it
carries each Gaussian nearest to all frames, quantize that (its positions give the order), quantize what motion leaves
over. Every later stage works on the values that the decoder will have, so errors do not add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .. import _native
from ..bitstream.quantization import trajectory_step
from ..model.camera import Camera
from ..model.gaussians import Group
from ..model.gaussians import Nodes as GivenNodes
from ..render.sensitivity import Importance
from . import companding as curved
from . import rdo
from .axis_order import canonical_axes, quat_conjugate, quat_multiply, rotate
from .channels import SHIFTED, dequantize_channels, quantize_channels
from .node_fit import NEIGHBORS, NodeMotion, Nodes, carry, choose_nodes, given_nodes
from .quantization_plan import Plan, along_curves, plan_group
from .refine_group import refine_group, refine_still
from .refinement_views import DrawnTargets, PictureTargets, targets_of
from .rotation_residuals import code_turns, in_form
from .stack import Stack, align_axes, canonical_appearance, stack_group

GRID_BITS_MAX = 21


@dataclass(frozen=True)
class Grid:
    """The integer lattice of positions: origin [3] f32 and step of the group, in bits a coordinate."""

    origin: np.ndarray
    step: float
    bits: int

    @staticmethod
    def around(means: np.ndarray, step: float, room: int = 0) -> Grid:
        """The lattice that holds `means` [N, 3], and 2^room of it along each axis."""
        low = means.min(0) if len(means) else np.zeros(3)
        extent = float((means.max(0) - low).max()) if len(means) else 0.0
        finest = extent / (2 ** (GRID_BITS_MAX - room) - 2)
        step = float(np.float32(max(step, finest)))  # far floaters: coarser, not an error
        return Grid(low.astype(np.float32), step, room + max(1, int(np.ceil(extent / step + 1)).bit_length()))

    def header(self) -> dict:
        """Its entries in the input of `encode_group`."""
        return {"origin": self.origin.tolist(), "grid_step": self.step, "grid_bits": self.bits}

    def to_integers(self, means: np.ndarray, shift: np.ndarray | int = 0) -> np.ndarray:
        """[N, 3] world -> [N, 3] u32, multiples of 2^shift ([N])."""
        unit = 2 ** np.broadcast_to(shift, len(means))[:, None]
        q = np.rint((means - self.origin) / (self.step * unit))
        return (np.clip(q, 0, 2**self.bits // unit - 1) * unit).astype(np.uint32)

    def to_world(self, integers: np.ndarray) -> np.ndarray:
        """[N, 3] u32 -> [N, 3] f64 world."""
        return self.origin.astype(np.float64) + self.step * integers.astype(np.float64)


_WHOLE = ("source", "turn", "order", "rotations")  # arrays of `Coded`


@dataclass(frozen=True)
class Coded:
    """A group in integers, with what is needed to predict another from it.

    Attributes:
        integers: the input of `_native.encode_group`.
        source: [N] int, index in the group of each Gaussian that is coded, in the order of the integers.
        turn, order: [N, 4], [N, 3], the form of each (`canonical_axes`, `in_form`).
        rotations: [N, 4] f32, canonical quaternions before rounding: trajectories are for what moves, not for what the
            steps leave.
        steps: attribute -> [C] f32; node_step: of the nodes' translations, world units.
    """

    integers: dict
    source: np.ndarray
    turn: np.ndarray
    order: np.ndarray
    rotations: np.ndarray
    grid: Grid
    steps: dict[str, np.ndarray]
    node_step: float

    def state(self) -> dict[str, np.ndarray]:
        """Everything that predicting needs, as arrays: what a later run goes on from."""
        whole = {n: np.asarray(getattr(self, n)) for n in (*_WHOLE, "node_step")}
        grid = {f"grid.{n}": np.asarray(v) for n, v in vars(self.grid).items()}
        channels = {
            f"channels.{n}.{key}": np.asarray(v) for n, c in self.integers["channels"].items() for key, v in c.items()
        }
        layers = np.asarray(self.integers["layers"])
        steps = {f"steps.{n}": v for n, v in self.steps.items()}
        shifts = np.asarray(self.integers["shifts"] or ())
        whole |= {"layers": layers, "shifts": shifts, "positions": self.integers["positions"]}
        return {**whole, **grid, **channels, **steps}

    @staticmethod
    def restored(state: dict[str, np.ndarray]) -> Coded:
        """Inverse of `state`."""
        grid = Grid(state["grid.origin"], float(state["grid.step"]), int(state["grid.bits"]))
        steps = {n.removeprefix("steps."): v for n, v in state.items() if n.startswith("steps.")}
        channels: dict[str, dict] = {}
        for name, v in state.items():
            if name.startswith("channels."):
                _, attribute, key = name.split(".")
                channels.setdefault(attribute, {})[key] = v if key == "values" else v.tolist()
        lists = {"layers": state["layers"].tolist(), "positions": state["positions"], "channels": channels}
        lists["shifts"] = state["shifts"].tolist() or None
        whole = (state[n] for n in _WHOLE)
        return Coded(grid.header() | lists, *whole, grid, steps, float(state["node_step"]))


def code_group(
    group: Group,
    quality: float,
    *,
    keep_all: bool = False,
    layers: int | None = None,
    views: int = 0,
    cameras: list[Camera] = (),
    pictures: PictureTargets | None = None,
) -> Coded:
    """An independent group in integers.

    Args:
        group: T >= 1 frames of N Gaussians.
        quality: 0 to 100.
        keep_all: code every Gaussian, also the invisible ones.
        layers: number of layers of falling importance; None: STILL_LAYERS for many Gaussians in a single frame, else 1.
        views: by which integers are refined; 0: they are not.
        cameras: from which the subject was captured, if it was.
        pictures: by which integers are refined instead.
    """
    s, frames, trained = stack_group(group), len(group), group.nodes is not None
    turn, axes = canonical_axes(s.log_scales[frames // 2])
    s = align_axes(s, frames // 2, turn, axes)
    plan = plan_group(s, quality, layers=layers, keep_all=keep_all, trained=trained, cameras=cameras)
    grid, nodes, plan, positions, quats = _placed(s, group.nodes if frames > 1 else None, plan)
    s = s.take(plan.source)
    targets = targets_of(s.means[frames // 2], views, cameras, pictures)
    channels, forms = _canonical(s, quats, grid.to_world(positions), positions, plan, targets)
    s, rotations = replace(s, quats=in_form(s.quats, forms)), in_form(quats, forms).astype(np.float32)
    shifts = [plan.shifts[n] for n in SHIFTED if n in plan.shifts]
    out = {
        "frames": frames,
        **grid.header(),
        "layers": np.bincount(plan.layer, minlength=plan.layers).tolist(),
        "shifts": np.stack(shifts, 1).tolist() if plan.layers > 1 else None,
        "positions": positions,
        "channels": channels,
        "trajectories": {},
    }
    if s.lifetimes is not None:
        out["lifetimes"] = s.lifetimes.astype(np.uint16)
    if frames > 1 and len(positions):
        x = grid.to_world(positions)
        motion = nodes and carry(nodes, positions, x, frames)
        out |= motion_integers(s, channels, rotations, plan.even, plan.measured, plan.price, x, nodes, motion)
        if targets:
            out = refine_group(out, s, plan.measured.weights, plan.price, targets)
    turn, axes = in_form(turn[plan.source], forms), axes[plan.source]
    return Coded(out, plan.source, turn, axes, rotations, grid, plan.even, plan.node_step)


def _placed(s: Stack, given: GivenNodes | None, plan: Plan) -> tuple[Grid, Nodes | None, Plan, np.ndarray, np.ndarray]:
    """The grid, the nodes, and the plan in the order of the integers, with positions [N, 3] u32 and quaternions [N, 4]
    of the pose from which the nodes carry each Gaussian nearest to all frames."""
    rest = s.means[len(s.means) // 2] if given is None else given.rest
    grid = Grid.around(rest[plan.source], float(plan.steps["means"][0]), room=0 if given is None else 1)
    most = np.minimum(plan.shifts["means"], grid.bits - 1)
    plan = replace(plan, shifts=plan.shifts | {"means": most})
    plan = plan.ordered(_native.morton_order(grid.to_integers(rest[plan.source])))
    nodes, x, quats = _rest_pose(s.take(plan.source), rest[plan.source], grid, given, plan)
    positions = grid.to_integers(x, most[plan.layer])
    order = _native.morton_order(positions)
    order = order[plan.layer[order].argsort(kind="stable")]
    return grid, nodes, plan.ordered(order), positions[order], quats[order]


def _canonical(
    s: Stack,
    quats: np.ndarray,
    x: np.ndarray,
    positions: np.ndarray,
    plan: Plan,
    targets: DrawnTargets | PictureTargets | None,
) -> tuple[dict, np.ndarray]:
    """Channels of canonical values, those of a single frame refined by `targets`, and the form [N] of each Gaussian.

    x: [N, 3], `positions` in the world.
    """
    layers = rdo.layers_of(positions, np.bincount(plan.layer, minlength=plan.layers).tolist())
    values = along_curves(canonical_appearance(s), plan.curves)
    weights = curved.sensitivities(plan.measured.weights, values, plan.curves)
    channels = {
        n: quantize_channels(v, plan.steps[n], weights[n], layers, plan.shifts[n], plan.price)
        for n, v in values.items()
    }
    for n, own in plan.curves.items():
        channels[n]["curves"] = [c.row() for c in own]
    shifts = plan.own_shifts()
    if targets and len(s.means) == 1:
        source, placed = s.frame(0), replace(s.frame(0), means=x)
        channels = refine_still(channels, shifts, values, weights, layers, plan.price, source, placed, targets)
    turning = {"steps": plan.steps["quats"].tolist(), "offsets": [0.0] * 3, "levers": plan.levers.tolist()}
    sizes, heard = dequantize_channels(channels["log_scales"]), plan.measured.weights["quats"]
    turning["values"], forms = code_turns(quats, sizes, positions, turning, layers, shifts["quats"], heard, plan.price)
    return channels | {"quats": turning}, forms


def group_integers(group: Group, quality: float, **options) -> dict:
    """The integers of `code_group`."""
    return code_group(group, quality, **options).integers


def _rest_pose(
    s: Stack, rest: np.ndarray, grid: Grid, given: GivenNodes | None, plan: Plan
) -> tuple[Nodes | None, np.ndarray, np.ndarray]:
    """Nodes, and the means [N, 3] and quaternions [N, 4] that they carry nearest to all frames: what jitters in `rest`
    ([N, 3], in Morton order) is not the canonical of all."""
    positions = grid.to_integers(rest)
    x, frames = grid.to_world(positions), len(s.means)
    if frames == 1 or not len(x):
        return None, s.means[0], s.quats[0]
    if given is None:
        nodes = choose_nodes(positions, x, s.means, grid.step, plan.node_step, grid.to_world)
    else:
        heard = plan.measured.weights["means"]
        nodes = given_nodes(given, positions, plan.node_step, grid, heard, plan.price)
    if nodes is None:
        means, quats = s.means.mean(0, dtype=np.float64), s.quats.mean(0)
    else:
        motion = carry(nodes, positions, x, frames)
        back = quat_conjugate(motion.turned)
        means = x + s.held(rotate(back, s.means - motion.carried)).mean(0)
        quats = s.held(quat_multiply(back, s.quats)).mean(0)
    return nodes, means, quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)


def _residual(
    s: Stack, channels: dict, rotations: np.ndarray, x: np.ndarray, motion: NodeMotion | None
) -> dict[str, np.ndarray]:
    """[T, N, C] f32 of each attribute: what canonical values and nodes leave over; held outside a lifetime, in which
    the nodes go on."""
    dq = quat_multiply(s.quats, quat_conjugate(rotations[None]))
    if motion is not None:
        dq = quat_multiply(dq, quat_conjugate(motion.turned))
    residual = {
        "means": s.means - (x[None].astype(np.float32) if motion is None else motion.carried),
        "quats": np.copysign(1, dq[..., :1]) * dq[..., 1:],
    }
    for name, values in s.appearance.items():
        residual[name] = values - dequantize_channels(channels[name])[None].astype(np.float32)
    return {n: s.held(r) for n, r in residual.items()}


def motion_integers(s: Stack, channels, rotations, steps, measured: Importance, price: float, x, nodes, motion) -> dict:
    """ "nodes" and "trajectories" of a group with canonical positions x [N, 3], channels and rotations [N, 4], which
    `nodes` carry as `motion` says (both None: not at all)."""
    out = {"trajectories": {}}
    for name, values in _residual(s, channels, rotations, x, motion).items():
        step = trajectory_step(1 / np.sqrt((1 / steps[name].astype(np.float64) ** 2).mean()), len(s.means))
        weights = measured.turns if name == "quats" else measured.weights[name]
        coefficients = rdo.trajectory(values, weights, step, price)
        if coefficients.any():
            out["trajectories"][name] = {"coefficients": coefficients, "step": step}
    if nodes is not None:
        out["nodes"] = {
            "positions": nodes.positions,
            "coefficients": nodes.coefficients,
            "rotation_step": nodes.rotation_step,
            "translation_step": nodes.translation_step,
            "neighbors": min(NEIGHBORS, len(nodes.positions)),
        }
    return out
