"""Curves: sizes and opacities are coded along a line that rises where the picture hears them (spec 13.1).

A thin axis is smaller than a pixel, an opacity is as good as 0 or 1: there the same error of the value shows less. With
steps that widen as the measured sensitivity falls, integers tell no more than can be seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PIECES = 8  # of the bitstream
CURVED = ("log_scales", "logit_opacities")
LEAST = 16000  # Gaussians from which sensitivity by value is known well enough to save anything
BINS, TAILS = 24, (0.2, 99.8)  # of the histogram, between these percentiles
STEEPEST = 32.0  # relative to where the picture hears most
DOUBT = 20  # a bin counts as so many more Gaussians of the mean sensitivity


@dataclass(frozen=True)
class Curve:
    """Pieces of `width` from `low` on, in coded values; piece j rises by 2^(slopes[j] / 16). `low` is its own value."""

    low: float
    width: float
    slopes: tuple[int, ...]

    def row(self) -> list[float]:
        """The curve as the bitstream core takes it."""
        return [self.low, self.width, *map(float, self.slopes)]

    @staticmethod
    def of(row: list[float]) -> Curve:
        """Inverse of `row`."""
        return Curve(row[0], row[1], tuple(map(int, row[2:])))

    def coded(self, values: np.ndarray) -> np.ndarray:
        """Values -> what is quantized."""
        starts, ends, rises = self._pieces()
        piece = np.clip(np.searchsorted(ends, values, side="right") - 1, 0, PIECES - 1)
        return starts[piece] + (values - ends[piece]) / rises[piece]

    def values(self, coded: np.ndarray) -> np.ndarray:
        """Inverse of `coded`."""
        starts, ends, rises = self._pieces()
        piece = self._piece(coded)
        return ends[piece] + rises[piece] * (coded - starts[piece])

    def rise(self, coded: np.ndarray) -> np.ndarray:
        """How much larger a step of the value is than one that is coded."""
        return self._pieces()[2][self._piece(coded)]

    def _piece(self, coded: np.ndarray) -> np.ndarray:
        return np.clip((coded - self.low) // self.width, 0, PIECES - 1).astype(int)

    def _pieces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[PIECES] where they start, coded and as values, and how they rise."""
        rises = 2.0 ** (np.array(self.slopes) / 16)
        return (
            self.low + self.width * np.arange(PIECES),
            self.low + self.width * np.concatenate([[0], rises.cumsum()[:-1]]),
            rises,
        )


def fit(values: np.ndarray, weights: np.ndarray) -> Curve:
    """The curve along which [N] values of [N] sensitivities are equally sensitive."""
    low, high = np.percentile(values, TAILS)
    high = max(high, low + 1e-3)
    edges = np.linspace(low, high, BINS + 1)
    place = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    mean = np.bincount(place, weights, BINS) + DOUBT * weights.mean()
    mean /= np.bincount(place, minlength=BINS) + DOUBT
    mean = np.convolve(np.pad(mean, 1, mode="edge"), (0.25, 0.5, 0.25), "valid")
    heard = np.sqrt(np.maximum(mean / max(mean.max(), 1e-30), STEEPEST**-2))
    coded = np.concatenate([[0], np.cumsum(heard) * (high - low) / BINS])
    knots = np.interp(np.linspace(0, coded[-1], PIECES + 1), coded, edges)
    width = np.float32(coded[-1] / PIECES)
    slopes = np.rint(16 * np.log2(np.diff(knots) / width)).clip(0, 255).astype(int)
    return Curve(float(np.float32(low)), float(width), tuple(slopes.tolist()))


def fit_all(values: dict[str, np.ndarray], weights: dict[str, np.ndarray]) -> dict[str, list[Curve]]:
    """attribute -> a curve for each channel of those that have curves; `values`, `weights`: attribute -> [N, C]."""
    if len(values["log_scales"]) < LEAST:
        return {}
    return {n: [fit(v, w) for v, w in zip(values[n].T, weights[n].T, strict=True)] for n in CURVED}


def along(values: np.ndarray, curves: list[Curve] | None) -> np.ndarray:
    """[N, C] values as they are coded; without curves they are so already."""
    return np.stack([c.coded(v) for v, c in zip(values.T, curves, strict=True)], 1) if curves else values


def back(coded: np.ndarray, curves: list[Curve] | None) -> np.ndarray:
    """Inverse of `along`."""
    return np.stack([c.values(v) for v, c in zip(coded.T, curves, strict=True)], 1) if curves else coded


def rises(coded: np.ndarray, curves: list[Curve]) -> np.ndarray:
    """[N, C], how much larger steps of values are than those that are coded."""
    return np.stack([c.rise(v) for v, c in zip(coded.T, curves, strict=True)], 1)


def sensitivities(weights: dict[str, np.ndarray], values: dict[str, np.ndarray], curves: dict) -> dict[str, np.ndarray]:
    """`weights` of coded values; `values`: attribute -> [N, C], coded."""
    return weights | {n: weights[n] * rises(values[n], own) ** 2 for n, own in curves.items()}
