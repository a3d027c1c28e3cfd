"""What a group is coded with, before anything is rounded: who is coded, in which layer, along what, with which steps.

Sensitivity is measured; who is not seen goes; curves and levers bend values to where errors show alike; layers gather
Gaussians of like sensitivity; steps share out the error that the quality allows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..bitstream.quantization import Steps, error_for, steps_for, subject_radius
from ..model.camera import Camera
from ..render.sensitivity import VIEWS, Importance, coarsest, measure, steps_for_error
from . import companding as curved
from . import rdo
from .rotation_residuals import fit_levers, widths
from .stack import Stack, canonical_appearance

LEVEL_RANGE = (3, 97)  # percentiles of log sensitivity between which layers are even
LEAST_LEVEL = 1e-4  # of the mean sensitivity
STILL_LAYERS, STILL_LEAST = 4, 1000  # layers of a single frame of so many Gaussians
FEW = 20_000  # Gaussians, for which there is time to look longer
MORE_VIEWS = 48  # from which these, and a single frame, are measured
SHIFT_MOST = 8  # doublings of a layer's step
PRUNE = 0.3  # a Gaussian goes if the picture without it errs by less than this share of the error per coded Gaussian


@dataclass(frozen=True)
class Plan:
    """Attributes:
    source, layer: [N] int, the Gaussians that are coded, and the layer of each.
    layers: how many there are.
    measured: of these Gaussians.
    shifts: attribute -> [L] int, doublings of each layer's steps.
    steps: attribute -> [C] f32, of the first layer; of quats times `widths` by the levers.
    even: the same without layers, curves and levers, of quats by turns about the axes of the scene.
    curves: attribute -> a curve for each channel. levers: [3, 3], of quats.
    node_step: of translations of nodes, world units. price: of a bit.
    """

    source: np.ndarray
    layer: np.ndarray
    layers: int
    measured: Importance
    shifts: dict[str, np.ndarray]
    steps: dict[str, np.ndarray]
    even: dict[str, np.ndarray]
    curves: dict[str, list[curved.Curve]]
    levers: np.ndarray
    node_step: float
    price: float

    def ordered(self, order: np.ndarray) -> Plan:
        """The same of the Gaussians at `order`."""
        taken = self.source[order], self.layer[order], self.measured.take(order)
        return replace(self, source=taken[0], layer=taken[1], measured=taken[2])

    def own_shifts(self) -> dict[str, np.ndarray]:
        """attribute -> [N] int, of each Gaussian."""
        return {n: v[self.layer] for n, v in self.shifts.items()}


def plan_group(
    s: Stack, quality: float, *, layers: int | None, keep_all: bool, trained: bool, cameras: list[Camera] = ()
) -> Plan:
    """The plan of an independent group.

    Args:
        s: with its axes by falling scale. layers, keep_all, cameras: as in `code_group`.
        trained: as in `rdo.bit_price`.
    """
    middle, count = len(s.means) // 2, s.means.shape[1]
    measured, error = measure_stack(s, cameras), error_for(quality)
    source = np.arange(count) if keep_all else np.flatnonzero(measured.removal >= PRUNE * error / max(count, 1))
    s, measured, radius = s.take(source), measured.take(source), subject_radius(s.means[middle])
    nominal, layers = steps_for(quality, radius), layers or _layers(s)
    turning = replace(measured, weights=measured.weights | {"quats": measured.turns})
    even = _steps(s, turning, error, nominal)
    curves, levers, heard = _bent(s, middle, measured)
    layer = layer_of(heard, layers)
    room = {n: np.log2(coarsest(n, radius) / v.mean()) for n, v in even.items()}
    shifts = layer_shifts(heard, layer, layers, room)
    steps = _steps(s, heard, error, nominal, {n: v[layer] for n, v in shifts.items()}, curves, levers)
    price = rdo.bit_price(error, len(source), trained)
    fixed = (shifts, steps, even, curves, levers, nominal.node_translation, price)
    return Plan(source, layer, layers, measured, *fixed)


def measure_stack(s: Stack, cameras: list[Camera] = ()) -> Importance:
    """What each Gaussian of a group matters, from its first, middle and last frame."""
    frames, count = s.means.shape[:2]
    if not count:
        sizes = {"means": 3, "quats": 3} | {n: v.shape[2] for n, v in s.appearance.items()}
        return Importance({n: np.zeros((0, c)) for n, c in sizes.items()}, np.zeros((0, 3)), np.zeros(0))
    shown = [s.frame(t) for t in sorted({0, frames // 2, frames - 1})]
    return measure(shown, cameras, MORE_VIEWS if frames == 1 or count <= FEW else VIEWS)


def layer_of(measured: Importance, layers: int) -> np.ndarray:
    """[N] int, layer of each Gaussian: equal ranges of the logarithm of sensitivity, the most sensitive in layer 0."""
    if not len(measured.removal) or layers == 1:
        return np.zeros(len(measured.removal), int)
    appearance = [w / np.maximum(w.mean(0), 1e-30) for n, w in measured.weights.items() if n != "means"]
    level = np.log2(np.concatenate(appearance, 1) + LEAST_LEVEL).mean(1)
    edges = np.linspace(*np.percentile(level, LEVEL_RANGE), layers + 1)[1:-1]
    return layers - 1 - np.searchsorted(edges, level)


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


def along_curves(values: dict[str, np.ndarray], curves: dict[str, list[curved.Curve]]) -> dict[str, np.ndarray]:
    """`values` (attribute -> [N, C]) as they are coded."""
    return {n: curved.along(v, curves.get(n)) for n, v in values.items()}


def _layers(s: Stack) -> int:
    """Layers that make a group smallest: trajectories of a Gaussian miss their neighbours in other layers."""
    return STILL_LAYERS if len(s.means) == 1 and s.means.shape[1] >= STILL_LEAST else 1
