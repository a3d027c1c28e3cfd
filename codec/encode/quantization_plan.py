"""Stage plan: importance + quality -> which Gaussians are coded, in which layer, with which steps.

Gaussians that no view shows are removed. Companding and scale exponents map values so that equal errors are equally
visible. Layers collect Gaussians of similar sensitivity. Steps share out the error that the quality allows (reverse
water-filling). A predicted group keeps the parameters of its reference; only its births choose a layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bitstream.quantization import error_for, steps_for, subject_radius
from ..model.attributes import GRID_BITS_MAX
from ..model.gaussians import sigmoid
from ..render.sensitivity import Importance, coarsest, steps_for_error
from . import companding, rdo
from .coded_form import CodedForm
from .rotation_residuals import fit_scale_exponents, step_factors
from .settings import EncodeSettings, PlanSettings


@dataclass(frozen=True)
class Grid:
    """The integer lattice of positions: origin [3] f32, world units; step, world units; bits of a coordinate."""

    origin: np.ndarray
    step: float
    bits: int

    @staticmethod
    def around(means: np.ndarray, step: float, room: int = 0) -> Grid:
        """The lattice that holds `means` [N, 3], with 2^room times their extent along each axis."""
        low = means.min(0) if len(means) else np.zeros(3)
        extent = float((means.max(0) - low).max()) if len(means) else 0.0
        finest = extent / (2 ** (GRID_BITS_MAX - room) - 2)
        step = float(np.float32(max(step, finest)))  # far floaters make it coarser, not an error
        return Grid(low.astype(np.float32), step, room + max(1, int(np.ceil(extent / step + 1)).bit_length()))

    def to_integers(self, means: np.ndarray, shift: np.ndarray | int = 0) -> np.ndarray:
        """[N, 3] world -> [N, 3] u32, multiples of 2^shift ([N])."""
        unit = 2 ** np.broadcast_to(shift, len(means))[:, None]
        q = np.rint((means - self.origin) / (self.step * unit))
        return (np.clip(q, 0, 2**self.bits // unit - 1) * unit).astype(np.uint32)

    def to_world(self, integers: np.ndarray) -> np.ndarray:
        """[N, 3] u32 -> [N, 3] f64 world."""
        return self.origin.astype(np.float64) + self.step * integers.astype(np.float64)


@dataclass(frozen=True)
class Parameters:
    """Parameters that a predicted group shares with its reference.

    Attributes:
        grid: lattice of positions.
        steps: attribute -> [C] f32 of the first layer, for companded values; for quats times `step_factors`.
        shifts: attribute -> [L] int, doublings of each layer's steps.
        curves: attribute -> a curve for each channel, if it is companded.
        scale_exponents: [3, 3] i32, of the steps of quats.
        trajectory_steps: attribute -> step of a value in one frame.
        node_step: step of node translations, world units.
    """

    grid: Grid
    steps: dict[str, np.ndarray]
    shifts: dict[str, np.ndarray]
    curves: dict[str, list[companding.Curve]]
    scale_exponents: np.ndarray
    trajectory_steps: dict[str, float]
    node_step: float

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.shifts["means"])


@dataclass(frozen=True)
class Plan:
    """Which Gaussians are coded, and how.

    Attributes:
        index: [n] int, indices of the coded Gaussians in the coded form.
        layer: [n] int, the layer of each.
        importance: of each.
        price: of a bit, in mean squared error of the image.
        parameters: of the group.
    """

    index: np.ndarray
    layer: np.ndarray
    importance: Importance
    price: float
    parameters: Parameters

    def ordered(self, order: np.ndarray) -> Plan:
        """The plan with the Gaussians at `order`."""
        kept = self.index[order], self.layer[order], self.importance.take(order)
        return Plan(*kept, self.price, self.parameters)


@dataclass(frozen=True)
class Known:
    """A reference: its parameters, and for each of its n Gaussians the layer ([n] int) and the decoded logit of the
    opacity ([n])."""

    parameters: Parameters
    layer: np.ndarray
    opacities: np.ndarray


def plan_group(
    form: CodedForm, importance: Importance, quality: float, settings: EncodeSettings, known: Known | None = None
) -> Plan:
    """The plan of a group.

    Args:
        importance: of all Gaussians of `form`.
        known: data of the reference, if the group is predicted.
    """
    error = error_for(quality)
    index = _kept(form, importance, error, settings, known)
    form, importance = form.take(index), importance.take(index)
    price = rdo.bit_price(error, len(index), form.group.rate_optimized, settings.rdo)
    if known is None:
        parameters, layer = _parameters(form, importance, quality, settings)
    else:
        parameters, born = known.parameters, form.lineage < 0
        layer = known.layer[np.maximum(form.lineage, 0)] if len(known.layer) else np.zeros(len(index), int)
        layer[born] = layer_of(importance.take(np.flatnonzero(born)), parameters.layers, settings.plan)
    return Plan(index, layer, importance, price, parameters)


def _kept(
    form: CodedForm, importance: Importance, error: float, settings: EncodeSettings, known: Known | None
) -> np.ndarray:
    """[n] int, Gaussians that are worth coding: Gaussians that matter, and survivors that show at all, since they cost
    nothing. Survivors that have faded and no longer matter are removed: they would show as in the reference."""
    count, removal = len(form.rest), importance.removal
    if settings.keep_all:
        return np.arange(count)
    least = settings.plan.prune * error / max(count, 1)
    if known is None:
        return np.flatnonzero(removal >= least)
    needed = np.where(form.group.parents >= 0, settings.plan.rebirth * least, least)  # left out before, or new
    old = np.flatnonzero(form.lineage >= 0)
    logits = form.values["logit_opacities"][old, 0], known.opacities[form.lineage[old]]
    now, before = (sigmoid(x) for x in logits)
    needed[old] = np.where(before > settings.plan.faded * now, least, 0)
    return np.flatnonzero((removal >= needed) & (removal > 0))


def _parameters(
    form: CodedForm, importance: Importance, quality: float, settings: EncodeSettings
) -> tuple[Parameters, np.ndarray]:
    """Parameters of an independent group, and the layer of each Gaussian."""
    error, radius = error_for(quality), subject_radius(form.rest)
    nominal, layers = steps_for(quality, radius), settings.layers or _usual_layers(form, settings.plan)
    over_time = importance.with_weights(quats=importance.scene_rotations)
    even = _steps(form, over_time, error, nominal, radius)
    curves, exponents, bent = _bent(form, importance, settings)
    layer = layer_of(bent, layers, settings.plan)
    room = {n: np.log2(coarsest(n, radius) / v.mean()) for n, v in even.items()}
    shifts = _layer_shifts(bent, layer, layers, room, settings.plan)
    own = {n: v[layer] for n, v in shifts.items()}
    steps = _steps(form, bent, error, nominal, radius, shifts=own, curves=curves, exponents=exponents)
    grid = Grid.around(form.rest, float(steps["means"][0]), room=0 if form.group.nodes is None else 1)
    shifts["means"] = np.minimum(shifts["means"], grid.bits - 1)
    mean_step = {n: float(1 / np.sqrt((1 / v.astype(np.float64) ** 2).mean())) for n, v in even.items()}
    return Parameters(grid, steps, shifts, curves, exponents, mean_step, nominal.node_translation), layer


def layer_of(importance: Importance, layers: int, settings: PlanSettings) -> np.ndarray:
    """[N] int, layer of each Gaussian: equal ranges of the logarithm of sensitivity, the most sensitive in layer 0."""
    if not len(importance.removal) or layers == 1:
        return np.zeros(len(importance.removal), int)
    appearance = [w / np.maximum(w.mean(0), 1e-30) for n, w in importance.weights.items() if n != "means"]
    level = np.log2(np.concatenate(appearance, 1) + settings.least_sensitivity).mean(1)
    edges = np.linspace(*np.percentile(level, settings.level_percentiles), layers + 1)[1:-1]
    return layers - 1 - np.searchsorted(edges, level)


def _layer_shifts(importance, layer, layers: int, room: dict, settings: PlanSettings) -> dict[str, np.ndarray]:
    """attribute -> [L] int, doublings of each layer's step, from its mean sensitivity; at most `room`, since the
    derivative of the image does not predict the error of larger steps."""
    count = np.maximum(np.bincount(layer, minlength=layers), 1)
    shifts = {}
    for n, w in importance.weights.items():
        own = (w / np.maximum(w.sum(0) / max(len(w), 1), 1e-30)).mean(1)
        mean = np.maximum(np.bincount(layer, own, minlength=layers) / count, 1e-9)
        most = np.clip(room[n], 0, settings.shift_most)
        shifts[n] = np.clip(np.rint(0.5 * np.log2(mean.max() / mean)), 0, most).astype(int)
    return shifts


def _bent(form: CodedForm, importance: Importance, settings: EncodeSettings):
    """Companding curves, scale exponents of rotations, and the importance of values that are coded with both."""
    curves = companding.fit_all(form.values, importance.weights, settings.companding)
    weights = dict(importance.weights)
    for n, own in curves.items():
        weights[n] = weights[n] * companding.slopes(companding.compand(form.values[n], own), own) ** 2
    sizes = form.values["log_scales"]
    exponents = fit_scale_exponents(sizes, weights["quats"], settings.scale_exponents)
    weights["quats"] = weights["quats"] * _relative(step_factors(sizes, exponents))[0] ** 2
    return curves, exponents, importance.with_weights(**weights)


def _relative(factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, C] factors relative to the geometric mean of each channel, and [C] that mean."""
    level = np.exp(np.log(factors).mean(0)) if len(factors) else np.ones(factors.shape[1])
    return factors / level, level


def _steps(
    form: CodedForm, importance, error: float, nominal, radius: float, *, shifts=None, curves=None, exponents=None
) -> dict[str, np.ndarray]:
    """[C] f32 step of each channel, for each attribute; a Gaussian's steps are 2^shifts ([N] each) times these, for
    quats also times its `step_factors`. `importance` is that of `_bent` if there are curves and exponents."""
    weights = importance.weights
    if not len(importance.removal):
        return {n: np.full(w.shape[1], nominal[n], np.float32) for n, w in weights.items()}
    values = {n: companding.compand(v, (curves or {}).get(n)) for n, v in form.values.items()}
    factors = step_factors(form.values["log_scales"], np.zeros((3, 3)) if exponents is None else exponents)
    factors, level = _relative(factors)
    values |= {"means": form.rest, "quats": form.coded_rotations[:, 1:] / factors}
    steps = steps_for_error(weights, {n: values[n] for n in weights}, error, radius, shifts)
    return steps | {"quats": steps["quats"] / level.astype(np.float32)}


def _usual_layers(form: CodedForm, settings: PlanSettings) -> int:
    """Number of layers that makes a group smallest: in several, trajectories lose their neighbours in other layers."""
    return settings.still_layers if form.frames == 1 and len(form.rest) >= settings.still_least else 1
