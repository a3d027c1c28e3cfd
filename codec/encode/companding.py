"""Companding: log_scales and logit_opacities are coded along a curve that is steep where the picture is insensitive.

If an axis is thinner than a pixel, or an opacity is nearly 0 or 1, the same error of the value is less visible. Steps
that widen as the measured sensitivity falls save bits there (spec 13.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model.attributes import COMPANDED
from .settings import CompandingSettings

PIECES = 8  # of the bitstream


@dataclass(frozen=True)
class Curve:
    """Piecewise linear curve, coded value -> value: pieces of `width` from `low` on, in coded values; piece j has the
    slope 2^(slopes[j] / 16). Coded `low` has the value `low`."""

    low: float
    width: float
    slopes: tuple[int, ...]

    def row(self) -> list[float]:
        """[10] low, width, slopes, as in QuantizedChannels."""
        return [self.low, self.width, *map(float, self.slopes)]

    @staticmethod
    def of(row: np.ndarray) -> Curve:
        """Inverse of `row`."""
        return Curve(float(row[0]), float(row[1]), tuple(map(int, row[2:])))

    def coded(self, values: np.ndarray) -> np.ndarray:
        """Values -> coded values, which are quantized."""
        starts, ends, rises = self._pieces()
        piece = np.clip(np.searchsorted(ends, values, side="right") - 1, 0, PIECES - 1)
        return starts[piece] + (values - ends[piece]) / rises[piece]

    def values(self, coded: np.ndarray) -> np.ndarray:
        """Inverse of `coded`."""
        starts, ends, rises = self._pieces()
        piece = self._piece(coded)
        return ends[piece] + rises[piece] * (coded - starts[piece])

    def rise(self, coded: np.ndarray) -> np.ndarray:
        """Slope of the curve, d(value) / d(coded value)."""
        return self._pieces()[2][self._piece(coded)]

    def _piece(self, coded: np.ndarray) -> np.ndarray:
        return np.clip((coded - self.low) // self.width, 0, PIECES - 1).astype(int)

    def _pieces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[PIECES] each: starts of the pieces as coded values, their starts as values, their slopes."""
        rises = 2.0 ** (np.array(self.slopes) / 16)
        return (
            self.low + self.width * np.arange(PIECES),
            self.low + self.width * np.concatenate([[0], rises.cumsum()[:-1]]),
            rises,
        )


def fit(values: np.ndarray, weights: np.ndarray, settings: CompandingSettings) -> Curve:
    """The curve along which values [N] with sensitivities `weights` [N] are equally sensitive."""
    bins = settings.bins
    low, high = np.percentile(values, settings.tails)
    high = max(high, low + 1e-3)
    edges = np.linspace(low, high, bins + 1)
    place = np.clip(np.searchsorted(edges, values) - 1, 0, bins - 1)
    mean = np.bincount(place, weights, bins) + settings.prior * weights.mean()
    mean /= np.bincount(place, minlength=bins) + settings.prior
    mean = np.convolve(np.pad(mean, 1, mode="edge"), (0.25, 0.5, 0.25), "valid")
    density = np.sqrt(np.maximum(mean / max(mean.max(), 1e-30), settings.steepest**-2))
    coded = np.concatenate([[0], np.cumsum(density) * (high - low) / bins])
    knots = np.interp(np.linspace(0, coded[-1], PIECES + 1), coded, edges)
    width = np.float32(coded[-1] / PIECES)
    slopes = np.rint(16 * np.log2(np.diff(knots) / width)).clip(0, 255).astype(int)
    return Curve(float(np.float32(low)), float(width), tuple(slopes.tolist()))


def fit_all(values: dict, weights: dict, settings: CompandingSettings) -> dict[str, list[Curve]]:
    """attribute -> one curve per channel, for companded attributes; `values`, `weights`: attribute -> [N, C]."""
    if len(values["log_scales"]) < settings.least:
        return {}
    pairs = {n: zip(values[n].T, weights[n].T, strict=True) for n in COMPANDED}
    return {n: [fit(v, w, settings) for v, w in channels] for n, channels in pairs.items()}


def compand(values: np.ndarray, curves: list[Curve] | None) -> np.ndarray:
    """Values [N, C] -> coded values; unchanged without curves."""
    return np.stack([c.coded(v) for v, c in zip(values.T, curves, strict=True)], 1) if curves else values


def expand(coded: np.ndarray, curves: list[Curve] | None) -> np.ndarray:
    """Inverse of `compand`."""
    return np.stack([c.values(v) for v, c in zip(coded.T, curves, strict=True)], 1) if curves else coded


def slopes(coded: np.ndarray, curves: list[Curve] | None) -> np.ndarray | float:
    """[N, C] slopes of the curves, d(value) / d(coded value); 1 without curves."""
    return np.stack([c.rise(v) for v, c in zip(coded.T, curves, strict=True)], 1) if curves else 1.0
