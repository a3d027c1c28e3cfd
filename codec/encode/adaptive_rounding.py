"""Refinement: integers move to where the picture is nearest to the source, given all other integers.

Rounding each value on its own leaves errors that another could make up for. The decoded frame is drawn and compared
with what it is to look like (targets.py); the gradient of the squared difference moves what lies under the integers,
and passes straight through the rounding (Bengio et al. 2013). Integers that others are decoded by stay: positions,
nodes, rotations.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..bitstream.color import correlate
from ..model.gaussians import Gaussians
from ..render.cpu import CpuBackend
from ..render.sensitivity import derivatives
from .parallel import ahead
from .refinement_views import DrawnTargets, PictureTargets

BETAS = (0.9, 0.99)
EPS = 1e-6  # of the squared differences' sum, by a step: what changes less stays (its square may be 0 in f32)
INSIDE = 0.02  # quantization steps: so far from where it would change, at least, starts what is under an integer


class Moving:
    """Integers of one attribute and what lies under them, in quantization steps, arrays of one shape.

    Args:
        latents: what was quantized. integers: to what.
        margins: how much farther than half a step above, and below, an integer still is the better one (`rdo.margins`).

    Attributes:
        change: of the integers since the start: -1, 0 or 1.
    """

    def __init__(self, attribute: str, latents: np.ndarray, integers: np.ndarray, margins: tuple):
        up, down = margins
        self.attribute, self._integers, self._margins = attribute, integers, margins
        self._under = np.clip(latents, integers - 0.5 - down + INSIDE, integers + 0.5 + up - INSIDE).astype(np.float32)
        self._first, self._second = (np.zeros_like(self._under) for _ in range(2))
        self.change = np.zeros(self._under.shape, np.int8)

    @property
    def integers(self) -> np.ndarray:
        """As they are now."""
        return self._integers + self.change

    def follow(self, derivative: np.ndarray, rate: float, step: int) -> None:
        """Adam's `step` (from 1) along the derivative by the integers."""
        self._first += (1 - BETAS[0]) * (derivative - self._first)
        self._second += (1 - BETAS[1]) * (derivative * derivative - self._second)
        size = np.sqrt(self._second / (1 - BETAS[1] ** step)) + EPS
        self._under -= rate * self._first / (1 - BETAS[0] ** step) / size
        off, (up, down) = self._under - self._integers, self._margins
        self.change = (off > 0.5 + up).astype(np.int8) - (-off > 0.5 + down)


def refine(
    parts: list[Moving],
    targets: DrawnTargets | PictureTargets,
    source: Callable[[int], Gaussians],
    shown: Callable[[int], tuple[Gaussians, list[Callable]]],
    frames: int = 1,
) -> None:
    """Moves the integers of `parts`, one step for each of `targets`.

    Args:
        source: frame -> Gaussians as they are to look.
        shown: frame -> the same as they look with the integers as they are now, and for each of `parts` what makes the
            derivative by its integers of that by its attribute ([N, C]).
    """
    backend, names = CpuBackend(), {p.attribute for p in parts}
    first = targets.drift / len(targets) ** 0.5
    for step, (t, camera, background, target) in enumerate(ahead(targets.draw(source, frames)), 1):
        now, chain = shown(t)
        off = lambda image, target=target: np.ascontiguousarray(image - target)  # noqa: E731
        derivative = derivatives(backend, now, camera, off, names, background)
        rate = first * (1 - (step - 1) / len(targets))
        for part, by_integers in zip(parts, chain, strict=True):
            part.follow(by_integers(derivative[part.attribute]), rate, step)


def with_values(g: Gaussians, values: dict[str, np.ndarray]) -> Gaussians:
    """`g` with other values, attribute -> [N, C] as they are coded: colours decorrelated."""
    means, shN = values.get("means", g.means), g.shN
    if "shN" in values:
        shN = correlate(values["shN"].reshape(shN.shape))
    return Gaussians(
        means, g.quats, values["log_scales"], values["logit_opacities"][:, 0], correlate(values["sh0"]), shN
    )
