"""Variables of adaptive rounding: the integers of one attribute and their latents, in quantization steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model.temporal_transform import dct_basis
from . import companding, rdo
from .quantize import Quantized
from .settings import EncodeSettings, RoundingSettings


class Latents:
    """Integers and their latents (values before rounding), arrays of one shape.

    Args:
        latents: values that were quantized.
        integers: the result.
        thresholds: distances beyond half a step, above and below, up to which an integer still is the better one.

    Attributes:
        values: the latents, f32; an optimiser moves them in place.
        change: of the integers since the start: -1, 0 or 1.
    """

    def __init__(self, latents: np.ndarray, integers: np.ndarray, thresholds: tuple, settings: RoundingSettings):
        up, down = thresholds
        self.integers = integers
        self._low, self._high = ((integers + a).astype(np.float32) for a in (-0.5 - down, 0.5 + up))
        inside = np.clip(latents, self._low + settings.inside, self._high - settings.inside)
        self.values = np.ascontiguousarray(inside, np.float32)
        self.change = np.zeros(self.values.shape, np.int8)

    @property
    def now(self) -> np.ndarray:
        """The current integers."""
        return self.integers + self.change

    def round(self) -> None:
        """Sets `change` from the current latents."""
        self.change = (self.values > self._high).astype(np.int8) - (self.values < self._low)


class CanonicalVariable:
    """Canonical integers of an attribute."""

    def __init__(self, attribute: str, quantized: Quantized, settings: EncodeSettings):
        self.attribute, plan = attribute, quantized.plan
        channels = quantized.integers.channels[attribute]
        self._curves, self._offset = plan.parameters.curves.get(attribute), channels.offsets
        self._unit = quantized.factors(attribute).astype(int)
        self._step = (self._unit * channels.steps).astype(np.float32)
        q = channels.values.T / self._unit
        coded = channels.offsets + self._step * q
        if attribute in quantized.coefficients:  # the mean of the residual over time is part of the latent
            left = quantized.coefficients[attribute][0] - _first_coefficient(quantized, attribute)
            scale = plan.parameters.trajectory_steps[attribute]  # a coefficient's step is sqrt(T) times as large
            wanted = companding.compand(companding.expand(coded, self._curves) + scale * left.T, self._curves)
        else:
            wanted = companding.compand(quantized.form.values[attribute], self._curves)
        slopes = companding.slopes(coded, self._curves)
        weights = plan.importance.weights[attribute] * (slopes * self._step) ** 2
        thresholds = np.zeros((2, *q.shape), np.float32)
        for own, near in quantized.layers:
            for c in range(q.shape[1]):
                found = rdo.decision_thresholds(q[own, c], weights[own, c], near, plan.price, settings.rdo)
                thresholds[:, own, c] = found
        self.latents = Latents((wanted - self._offset) / self._step, q, thresholds, settings.rounding)
        self._before = self._values() if self._curves else None

    def _coded(self) -> np.ndarray:
        return self._offset + self._step * self.latents.now

    def _values(self) -> np.ndarray:
        return companding.expand(self._coded(), self._curves)

    def add(self, values: np.ndarray, t: int) -> None:
        """Adds the change since the start to `values` [N, C] of the decoded frame `t`."""
        values += self._values() - self._before if self._curves else self._step * self.latents.change

    def by_integers(self, derivative: np.ndarray, t: int) -> np.ndarray:
        """The derivative by the integers, from the derivative by the values of frame `t`."""
        if not self._curves:
            return derivative * self._step
        return derivative * (self._step * companding.slopes(self._coded(), self._curves))

    def put(self, channels: dict, trajectories: dict) -> None:
        """Writes the integers into those of the group."""
        q = (self.latents.now * self._unit).astype(np.int32)
        channels[self.attribute] = replace(channels[self.attribute], values=np.ascontiguousarray(q.T))


def _first_coefficient(quantized: Quantized, attribute: str) -> np.ndarray | float:
    coded = quantized.integers.trajectories.get(attribute)
    return 0.0 if coded is None else coded.coefficients[0]


@dataclass(frozen=True)
class TrajectoryVariable:
    """DCT coefficients of an attribute, up to the last nonzero one of each Gaussian. Methods as in `CanonicalVariable`.

    Attributes:
        latents: [M, C] integers.
        basis: [K, T] f32, times the step.
        frequency: [M] temporal frequency of each row.
        own: [M] Gaussian of each row, sorted.
        starts: first row of each Gaussian.
    """

    attribute: str
    latents: Latents
    basis: np.ndarray
    frequency: np.ndarray
    own: np.ndarray
    starts: np.ndarray

    def add(self, values: np.ndarray, t: int) -> None:
        sums = np.add.reduceat(self.basis[self.frequency, t, None] * self.latents.change, self.starts, 0)
        values[self.own[self.starts]] += sums

    def by_integers(self, derivative: np.ndarray, t: int) -> np.ndarray:
        return self.basis[self.frequency, t, None] * derivative[self.own]

    def put(self, channels: dict, trajectories: dict) -> None:
        coefficients = trajectories[self.attribute].coefficients.copy()
        coefficients[self.frequency, :, self.own] += self.latents.change
        trajectories[self.attribute] = replace(trajectories[self.attribute], coefficients=coefficients)


def trajectory_variable(attribute: str, quantized: Quantized, settings: EncodeSettings) -> TrajectoryVariable:
    """The variable of the trajectories of `attribute`, which the group has."""
    coded, plan = quantized.integers.trajectories[attribute], quantized.plan
    q, frames = coded.coefficients.transpose(2, 0, 1), quantized.form.frames  # [N, K, C]
    used = np.flip(np.maximum.accumulate(np.flip((q != 0).any(2), 1), 1), 1)
    own, frequency = np.nonzero(used)
    starts = np.flatnonzero(np.diff(own, prepend=-1))
    wanted = quantized.coefficients[attribute][: q.shape[1]].transpose(2, 0, 1)[own, frequency]
    q, weights = q[own, frequency], plan.importance.weights[attribute][own] * coded.step**2
    thresholds = rdo.trajectory_thresholds(q, weights, frames, plan.price, settings.rdo)
    latents = Latents(wanted, q, thresholds, settings.rounding)
    basis = (dct_basis(frames)[: coded.coefficients.shape[0]] * coded.step).astype(np.float32)
    return TrajectoryVariable(attribute, latents, basis, frequency, own, starts)
