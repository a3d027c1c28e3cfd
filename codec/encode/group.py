"""Floats to integers: one group of Gaussians -> the integer maps that `_native.encode_group` turns into bytes.

Stages: choose each Gaussian's canonical form, measure what it matters, prune what nobody sees, fit the motion, find the
pose from which it carries each Gaussian nearest to all frames, quantize that (its positions give the order), quantize
what motion leaves over. Every later stage works on the values that the decoder will have, so errors do not add up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product

import numpy as np

from gscodec import _native
from gscodec.bitstream.color import decorrelate
from gscodec.bitstream.quantization import Steps, error_for, steps_for, subject_radius, trajectory_step
from gscodec.camera import Camera
from gscodec.encode import curves as curved
from gscodec.encode import rdo
from gscodec.encode.canonical import canonical_axes, quat_conjugate, quat_multiply, rotate
from gscodec.encode.motion import NEIGHBORS, NodeMotion, Nodes, carry, choose_nodes, given_nodes
from gscodec.encode.parallel import each_frame
from gscodec.encode.refine import refine
from gscodec.encode.turns import code_turns, fit_levers, in_form, widths
from gscodec.gaussians import Gaussians, Group
from gscodec.gaussians import Nodes as GivenNodes
from gscodec.render.sensitivity import STILL_VIEWS, VIEWS, Importance, coarsest, measure, steps_for_error

GRID_BITS_MAX = 21
SHIFTED = ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN")
LEVEL_RANGE = (3, 97)  # percentiles of log sensitivity between which layers are even
LEAST_LEVEL = 1e-4  # of the mean sensitivity
STILL_LAYERS, STILL_LEAST = 4, 1000  # layers of a single frame of so many Gaussians, which can be refined too
SHIFT_MOST = 8  # doublings of a layer's step
PRUNE = 0.3  # a Gaussian goes if the picture without it errs by less than this share of the error per coded Gaussian


@dataclass(frozen=True)
class Stack:
    """All frames of a group as arrays, T first; values outside a lifetime repeat the nearest frame inside."""

    means: np.ndarray  # [T, N, 3]
    quats: np.ndarray  # [T, N, 4]
    log_scales: np.ndarray  # [T, N, 3]
    logit_opacities: np.ndarray  # [T, N]
    sh0: np.ndarray  # [T, N, 3]
    shN: np.ndarray  # [T, N, K, 3]
    lifetimes: np.ndarray | None  # [N, 2]

    def held(self, a: np.ndarray) -> np.ndarray:
        """[T, N, ...] of these Gaussians; outside a lifetime it repeats the nearest frame inside."""
        return a[self.near(np.arange(len(a))[:, None]), np.arange(a.shape[1])] if self.lifetimes is not None else a

    def near(self, t: np.ndarray) -> np.ndarray:
        """[..., N] the frame nearest to `t` ([...] or [..., 1]) in which each Gaussian is shown."""
        life = np.array([[0, len(self.means)]]) if self.lifetimes is None else self.lifetimes
        return np.clip(t, life[:, 0], life[:, 1] - 1)

    def take(self, index: np.ndarray) -> Stack:
        """The Gaussians at `index`, in that order."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Stack(*(a[:, index] for a in arrays), None if self.lifetimes is None else self.lifetimes[index])

    def only(self, t: int) -> Stack:
        """Frame `t` alone."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Stack(*(a[t : t + 1] for a in arrays), None)

    def frame(self, t: int) -> Gaussians:
        """All Gaussians as they are at frame `t`."""
        arrays = (self.means, self.quats, self.log_scales, self.logit_opacities, self.sh0, self.shN)
        return Gaussians(*(a[t] for a in arrays))

    @cached_property
    def appearance(self) -> dict[str, np.ndarray]:
        """[T, N, C] f32 of each attribute that only adds up over time."""
        frames, n, k, _ = self.shN.shape
        arrays = {
            "log_scales": self.log_scales,
            "logit_opacities": self.logit_opacities[..., None],
            "sh0": decorrelate(self.sh0),
        }
        if k:
            arrays["shN"] = decorrelate(self.shN).reshape(frames, n, 3 * k)
        return arrays


def stack_group(group: Group) -> Stack:
    """Loads all frames of `group` (f32)."""
    frames = each_frame(lambda t: group.frames[t], len(group))
    names = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
    arrays = each_frame(lambda k: np.stack([getattr(f, names[k]) for f in frames]), len(names))
    raw = Stack(*arrays, group.lifetimes)
    return Stack(*(raw.held(a) for a in arrays), group.lifetimes)


def align_axes(s: Stack, middle: int, turn: np.ndarray, order: np.ndarray) -> Stack:
    """Every Gaussian in the form that `canonical_axes` chose, in all frames, quaternions continuous in time."""
    quats = quat_multiply(s.quats, turn[None].astype(np.float32))
    quats[middle] *= np.where(quats[middle, :, :1] < 0, -1, 1)
    for t in [*range(middle + 1, len(quats)), *range(middle - 1, -1, -1)]:
        before = quats[t - 1] if t > middle else quats[t + 1]
        quats[t] *= np.where(np.einsum("nc,nc->n", quats[t], before) < 0, -1, 1).astype(np.float32)[:, None]
    scales = np.take_along_axis(s.log_scales, order[None], 2)
    return Stack(s.means, quats, scales, s.logit_opacities, s.sh0, s.shN, s.lifetimes)


def quantize_channels(
    values: np.ndarray, steps: np.ndarray, weights: np.ndarray, layers: list[tuple], shifts: np.ndarray, price: float
) -> dict:
    """[N, C] floats, along their curves -> channels of `encode_group`; offsets are the medians, so that small integers
    are common.

    Args:
        layers: of each its Gaussians (slice) and their neighbours (`rdo.neighbours`).
        shifts: [L] low bits that each layer leaves out.
    """
    offsets = np.median(values, axis=0) if len(values) else np.zeros(values.shape[1])
    offsets = offsets.astype(np.float32)
    q = np.zeros((len(steps), len(values)), np.int32)
    for (own, near), shift in zip(layers, shifts, strict=True):
        for c, step in enumerate(steps * 2.0**shift):
            x = (values[own, c] - offsets[c]) / step
            q[c, own] = rdo.keyframe(x, weights[own, c] * step**2, near, price).astype(np.int32) << shift
    return {"values": q, "steps": steps.tolist(), "offsets": offsets.tolist()}


def dequantize_channels(channels: dict) -> np.ndarray:
    """[N, C] f64, what the decoder makes of `quantize_channels`."""
    steps, offsets = (np.array(channels[k], np.float32) for k in ("steps", "offsets"))
    coded = (offsets + steps * channels["values"].T.astype(np.float32)).astype(np.float64)
    return curved.back(coded, curves_of(channels))


def curves_of(channels: dict) -> list[curved.Curve]:
    """Of each channel of an attribute; empty if it has none."""
    return [curved.Curve.of(row) for row in channels.get("curves", ())]


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
    refine_steps: int = 0,
    cameras: list[Camera] = (),
) -> Coded:
    """An independent group in integers.

    Args:
        group: T >= 1 frames of N Gaussians.
        quality: 0 to 100.
        keep_all: code every Gaussian, also the invisible ones.
        layers: number of layers of falling importance; None: STILL_LAYERS for many Gaussians in a single frame, else 1.
        refine_steps: views by which a single frame of many Gaussians is refined.
        cameras: from which the subject was captured, if it was.
    """
    s, layers = stack_group(group), layers or _layers(group)
    frames, middle = len(s.means), len(s.means) // 2
    turn, axes = canonical_axes(s.log_scales[middle])
    s = align_axes(s, middle, turn, axes)
    measured, error = measure_stack(s, cameras), error_for(quality)
    source = np.arange(len(turn)) if keep_all else np.flatnonzero(measured.removal >= PRUNE * error / max(len(turn), 1))
    nominal = steps_for(quality, subject_radius(s.means[middle]))
    all_turns = replace(measured, weights=measured.weights | {"quats": measured.turns})
    even = _steps(s.take(source), all_turns.take(source), error, nominal)
    curves, levers, heard = _bent(s.take(source), middle, measured.take(source))
    layer = layer_of(heard, layers)
    room = {n: np.log2(coarsest(n, subject_radius(s.means[middle])) / v.mean()) for n, v in even.items()}
    shifts = layer_shifts(heard, layer, layers, room)
    own_shifts = {n: v[layer] for n, v in shifts.items()}
    steps = _steps(s.take(source), heard, error, nominal, own_shifts, curves, levers)
    given = group.nodes if frames > 1 else None
    rest = s.means[middle] if given is None else given.rest
    grid = Grid.around(rest[source], float(steps["means"][0]), room=0 if given is None else 1)
    shifts["means"] = np.minimum(shifts["means"], grid.bits - 1)
    order = _native.morton_order(grid.to_integers(rest[source]))
    source, layer = source[order], layer[order]
    price = rdo.bit_price(error, len(source), group.nodes is not None)
    heard_means = measured.weights["means"][source]
    nodes, x, quats = _rest_pose(
        s.take(source), rest[source], grid, nominal.node_translation, given, heard_means, price
    )
    positions = grid.to_integers(x, shifts["means"][layer])
    order = _native.morton_order(positions)
    order = order[layer[order].argsort(kind="stable")]
    positions, quats, source, layer = positions[order], quats[order], source[order], layer[order]
    s, measured = s.take(source), measured.take(source)
    counts = np.bincount(layer, minlength=layers)
    parts = [
        (slice(b - n, b), rdo.neighbours(positions[b - n : b])) for n, b in zip(counts, counts.cumsum(), strict=True)
    ]
    values = along_curves(canonical_appearance(s), curves)
    weights = curved.sensitivities(measured.weights, values, curves)
    channels = {n: quantize_channels(v, steps[n], weights[n], parts, shifts[n], price) for n, v in values.items()}
    for n, own in curves.items():
        channels[n]["curves"] = [c.row() for c in own]
    own_shifts = {n: v[layer] for n, v in shifts.items()}
    if refine_steps and frames == 1 and len(positions) >= STILL_LEAST:
        shown = replace(s.frame(0), means=grid.to_world(positions))
        looking = partial(refine, s.frame(0), shown, steps=refine_steps, cameras=cameras)
        channels = _refined(looking, values, channels, own_shifts, weights, parts, price)
    turning = {"steps": steps["quats"].tolist(), "offsets": [0.0] * 3, "levers": levers.tolist()}
    sizes = dequantize_channels(channels["log_scales"])
    turning["values"], forms = code_turns(
        quats, sizes, positions, turning, parts, own_shifts["quats"], measured.weights["quats"], price
    )
    channels["quats"], s = turning, replace(s, quats=in_form(s.quats, forms))
    rotations = in_form(quats, forms).astype(np.float32)
    out = {
        "frames": frames,
        **grid.header(),
        "layers": counts.tolist(),
        "shifts": np.stack([shifts[n] for n in SHIFTED if n in shifts], 1).tolist() if layers > 1 else None,
        "positions": positions,
        "channels": channels,
        "trajectories": {},
    }
    if s.lifetimes is not None:
        out["lifetimes"] = s.lifetimes.astype(np.uint16)
    if frames > 1 and len(positions):
        x = grid.to_world(positions)
        motion = nodes and carry(nodes, positions, x, frames)
        out |= motion_integers(s, channels, rotations, even, measured, price, x, nodes, motion)
    turn = in_form(turn[source], forms)
    return Coded(out, source, turn, axes[source], rotations, grid, even, nominal.node_translation)


def _refined(
    refine: Callable[..., dict], values: dict, channels: dict, shifts: dict, weights: dict, layers: list, price: float
) -> dict:
    """`channels` of a single frame with refined integers; `values`: what they were quantized from, `shifts`: [N]; the
    others as in `quantize_channels`."""
    unit = {n: 2.0 ** shifts[n][:, None].astype(np.float32) for n in channels}
    step = {n: np.array(c["steps"], np.float32) * unit[n] for n, c in channels.items()}
    offset = {n: np.array(c["offsets"], np.float32) for n, c in channels.items()}
    curves = {n: curves_of(c) for n, c in channels.items()}

    def decode(q):
        coded = {n: offset[n] + step[n] * v for n, v in q.items()}
        slopes = {n: step[n] * curved.rises(coded[n], curves[n]) if curves[n] else step[n] for n in coded}
        return {n: curved.back(v, curves[n]) for n, v in coded.items()}, slopes

    latents = {n: (values[n] - offset[n]) / step[n] for n in channels}
    q = {n: c["values"].T / unit[n] for n, c in channels.items()}
    margins = {n: [np.zeros(v.shape, np.float32) for _ in range(2)] for n, v in q.items()}
    for n, v in q.items():
        for (own, near), c in product(layers, range(v.shape[1])):
            found = rdo.margins(v[own, c], weights[n][own, c] * step[n][own, c] ** 2, near, price)
            margins[n][0][own, c], margins[n][1][own, c] = found
    q = refine(latents, q, margins, decode)
    return {n: c | {"values": (q[n] << shifts[n][:, None]).T.astype(np.int32)} for n, c in channels.items()}


def _layers(group: Group) -> int:
    """Layers that make a group smallest: trajectories of a Gaussian miss their neighbours in other layers."""
    return STILL_LAYERS if len(group) == 1 and len(group.frames[0]) >= STILL_LEAST else 1


def group_integers(group: Group, quality: float, **options) -> dict:
    """The integers of `code_group`."""
    return code_group(group, quality, **options).integers


def layer_of(measured: Importance, layers: int) -> np.ndarray:
    """[N] int, layer of each Gaussian: equal ranges of the logarithm of sensitivity, the most sensitive in layer 0."""
    if not len(measured.removal) or layers == 1:
        return np.zeros(len(measured.removal), int)
    appearance = [w / np.maximum(w.mean(0), 1e-30) for n, w in measured.weights.items() if n != "means"]
    level = np.log2(np.concatenate(appearance, 1) + LEAST_LEVEL).mean(1)
    edges = np.linspace(*np.percentile(level, LEVEL_RANGE), layers + 1)[1:-1]
    return layers - 1 - np.searchsorted(edges, level)


def shifts_of(integers: dict) -> dict[str, np.ndarray]:
    """[L] int of each attribute: low bits that the layers of a group in integers leave out."""
    names = [n for n in SHIFTED if n == "means" or n in integers["channels"]]
    shifts = integers["shifts"] or np.zeros((len(integers["layers"]), len(names)), int)
    return dict(zip(names, np.array(shifts, int).T, strict=True))


def layer_shifts(measured: Importance, layer: np.ndarray, layers: int, room: dict) -> dict[str, np.ndarray]:
    """[L] int of each attribute: how often each layer's step is doubled, by its mean sensitivity; `room`: so often at
    most, since the derivative says too little farther off."""
    count = np.maximum(np.bincount(layer, minlength=layers), 1)
    shifts = {}
    for n, w in measured.weights.items():
        own = (w / np.maximum(w.sum(0) / max(len(w), 1), 1e-30)).mean(1)
        mean = np.maximum(np.bincount(layer, own, minlength=layers) / count, 1e-9)
        shifts[n] = np.clip(np.rint(0.5 * np.log2(mean.max() / mean)), 0, np.clip(room[n], 0, SHIFT_MOST)).astype(int)
    return shifts


def _bent(s: Stack, middle: int, measured: Importance) -> tuple[dict[str, list[curved.Curve]], np.ndarray, Importance]:
    """Curves of attributes, levers of rotations, and the importance of what is coded along them."""
    values = canonical_appearance(s)
    curves = curved.fit_all(values, measured.weights)
    weights = curved.sensitivities(measured.weights, along_curves(values, curves), curves)
    levers = fit_levers(s.log_scales[middle], weights["quats"])
    weights["quats"] = weights["quats"] * _relative(widths(s.log_scales[middle], levers))[0] ** 2
    return curves, levers, replace(measured, weights=weights)


def _relative(widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, C] and [C]: widths relative to the geometric mean of each channel, and that."""
    level = np.exp(np.log(widths).mean(0)) if len(widths) else np.ones(widths.shape[1])
    return widths / level, level


def along_curves(values: dict[str, np.ndarray], curves: dict[str, list[curved.Curve]]) -> dict[str, np.ndarray]:
    """`values` (attribute -> [N, C]) as they are coded."""
    return {n: curved.along(v, curves.get(n)) for n, v in values.items()}


def canonical_appearance(s: Stack) -> dict[str, np.ndarray]:
    """[N, C] f64 of each attribute that only adds up over time: the mean over the frames."""
    return {n: v.mean(0, dtype=np.float64) for n, v in s.appearance.items()}


def measure_stack(s: Stack, cameras: list[Camera] = ()) -> Importance:
    """What each Gaussian of a group matters, from its first, middle and last frame."""
    frames, count = s.means.shape[:2]
    if not count:
        sizes = {"means": 3, "quats": 3} | {n: v.shape[2] for n, v in s.appearance.items()}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    shown = [s.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    return measure(shown, cameras, VIEWS if frames > 1 else STILL_VIEWS)


def _steps(
    s: Stack,
    measured: Importance,
    error: float,
    nominal: Steps,
    shifts: dict[str, np.ndarray] | None = None,
    curves: dict | None = None,
    levers: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """[C] f32 step of each channel of each attribute; those of a Gaussian are 2^shifts ([N] each) times that, of quats
    times its `widths` by the levers. `measured` is that of `_bent`, where there are curves and levers."""
    if not len(measured.removal):
        return {n: np.full(w.shape[1], getattr(nominal, n), np.float32) for n, w in measured.weights.items()}
    middle = s.only(len(s.means) // 2)
    values = along_curves({n: v[0] for n, v in middle.appearance.items()}, curves or {})
    width, level = _relative(widths(middle.log_scales[0], np.zeros((3, 3)) if levers is None else levers))
    values |= {"means": middle.means[0], "quats": middle.quats[0, :, 1:] / width}
    steps = steps_for_error(measured.weights, values, error, subject_radius(middle.means[0]), shifts)
    return steps | {"quats": steps["quats"] / level.astype(np.float32)}


def _rest_pose(
    s: Stack, rest, grid: Grid, node_step: float, given: GivenNodes | None, weights: np.ndarray, price: float
) -> tuple[Nodes | None, np.ndarray, np.ndarray]:
    """Nodes, and the means [N, 3] and quaternions [N, 4] that they carry nearest to all frames: what jitters in `rest`
    ([N, 3], in Morton order) is not the canonical of all."""
    positions = grid.to_integers(rest)
    x, frames = grid.to_world(positions), len(s.means)
    if frames == 1 or not len(x):
        return None, s.means[0], s.quats[0]
    if given is None:
        nodes = choose_nodes(positions, x, s.means, grid.step, node_step, grid.to_world)
    else:
        nodes = given_nodes(given, positions, node_step, grid, weights, price)
    if nodes is None:
        means, quats = s.means.mean(0, dtype=np.float64), s.quats.mean(0)
    else:
        motion = carry(nodes, positions, x, frames)
        back = quat_conjugate(motion.turned)
        means = x + s.held(rotate(back, s.means - motion.carried)).mean(0)
        quats = s.held(quat_multiply(back, s.quats)).mean(0)
    return nodes, means, quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)


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
