"""Entropy model of training: differentiable bits of canonical attributes and of residual coefficients.

Bits are code lengths of integers under Laplace distributions, with uniform noise in place of rounding (Balle et al.
2017). The mean of a residual coefficient is 0. The mean of a canonical value follows from the context of the coder: the
nearest Gaussians before it in Morton order (spec 7.3), in the form that the encoder codes (axes by falling scale,
rotations relative to that of the nearest Gaussian, colours as Y, Co, Cg). Positions have no term, because they cost the
same everywhere.
"""

from __future__ import annotations

import numpy as np
import torch

from .. import _native
from ..bitstream.color import STEP_WEIGHTS, TO_YCOCG
from ..bitstream.quantization import Steps
from ..model.attributes import ATTRIBUTES
from ..model.rotations import quat_conjugate, quat_multiply
from .settings import EntropyModelSettings

GRID_MAX = 2**20  # steps along an axis, bound of the Morton order: with far floaters steps are coarser
LN2 = float(np.log(2))
_H = 0.5**0.5
_AXIS_ROTATIONS = torch.zeros(27, 4)  # [9 a + 3 b + c]: rotates axes a, b, c to first, second, third
_AXIS_ROTATIONS[[5, 7, 11, 15, 19, 21]] = torch.tensor(
    [[1, 0, 0, 0], [0, 0, _H, -_H], [0, _H, -_H, 0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [0, _H, 0, -_H]]
)


def laplace_bits(x: torch.Tensor, log_scale: torch.Tensor) -> torch.Tensor:
    """Bits of integers under a Laplace distribution of scale exp(log_scale), at real x (a relaxed quantizer's output).

    Probability of the unit interval around x, computed without cancellation; differentiable in both.
    """
    return _LaplaceBits.apply(x, log_scale)


class _LaplaceBits(torch.autograd.Function):
    """Derivatives in closed form: a few passes over memory instead of one for each operation."""

    @staticmethod
    def forward(ctx, x: torch.Tensor, log_scale: torch.Tensor) -> torch.Tensor:
        rate = torch.exp(-log_scale)
        a = x.abs()
        inside, near = a < 0.5, a.clamp(max=0.5)
        rising, falling = torch.exp((near - 0.5) * rate), torch.exp(-(near + 0.5) * rate)
        p = (1 - 0.5 * (rising + falling)).clamp(min=1e-9)  # a very large scale would round it to 0
        off, beyond = (a - 0.5) * rate, -torch.expm1(-rate)
        bits = torch.where(inside, -torch.log2(p), off / LN2 + 1 - torch.log2(beyond))
        share = rate / (2 * LN2) / p
        by_x = torch.where(inside, share * (rising - falling), rate / LN2) * x.sign()
        by_scale = None
        if ctx.needs_input_grad[1]:
            tail = (rate * (1 - beyond) / beyond - off) / LN2
            by_scale = torch.where(inside, share * (rising * (0.5 - near) + falling * (0.5 + near)), tail)
        ctx.save_for_backward(by_x, by_scale)
        ctx.shape = log_scale.shape
        return bits

    @staticmethod
    def backward(ctx, seed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        by_x, by_scale = ctx.saved_tensors
        return seed * by_x, None if by_scale is None else (seed * by_scale).sum_to_size(ctx.shape)


def neighbours(means: torch.Tensor, step: float) -> torch.Tensor:
    """Context of each Gaussian: indices [N, 4] of the nearest among the 32 before it in Morton order; its own index
    where there is none."""
    low, high = means.min(0).values, means.max(0).values
    step = max(step, float((high - low).max()) / GRID_MAX)
    grid = torch.round((means - low) / step).numpy().astype(np.uint32)
    order = _native.morton_order(grid).astype(np.int64)
    index = _native.context_neighbors(np.ascontiguousarray(grid[order]))
    near = np.empty_like(index)
    near[order] = order[index]
    return torch.from_numpy(near)


class CanonicalRate:
    """Bits of the canonical attributes of N Gaussians, whose neighbours stay the same.

    Args:
        means: [N, 3], which define the order and the neighbours.
        steps: quantization steps of the stream.
    """

    def __init__(self, means: torch.Tensor, steps: Steps, settings: EntropyModelSettings):
        self.settings = settings
        self.near = neighbours(means, steps["means"])
        self.to_ycocg = torch.from_numpy(TO_YCOCG.T).float()
        weights = {True: torch.from_numpy(STEP_WEIGHTS).float(), False: 1.0}
        self.steps = {a.name: steps[a.name] * weights[a.decorrelated] for a in ATTRIBUTES if a.name != "means"}

    def channels(self, params: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Values of each attribute, [N, C], as the encoder codes them, in steps, before rounding; differentiable."""
        order = params["log_scales"].detach().argsort(dim=1, descending=True, stable=True)
        values = {
            "log_scales": params["log_scales"].gather(1, order),
            "quats": rotation_residuals(params["quats"], order, self.near[:, 0]),
            "logit_opacities": params["logit_opacities"][:, None],
            "sh0": params["sh0"] @ self.to_ycocg,
            "shN": params["shN"] @ self.to_ycocg,
        }
        return {n: (v / self.steps[n]).flatten(1) for n, v in values.items()}

    def bits(self, params: dict[str, torch.Tensor], generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Estimated bits of each attribute, all Gaussians together."""
        return {n: self._bits(n, x, generator) for n, x in self.channels(params).items() if x.shape[1]}

    def _bits(self, attribute: str, x: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        x = x + torch.rand(x.shape, generator=generator) - 0.5
        around = x[self.near]
        mean = torch.zeros_like(x) if attribute == "quats" else around.mean(1)  # relative rotations go to either side
        with torch.no_grad():  # the scale follows the differences of the neighbours
            spread = (around - mean[:, None]).abs().mean(1) + self.settings.spread_min
            scale = spread * (x - mean).abs().mean(0) / spread.mean(0)
        return laplace_bits(x - mean, scale.clamp(min=self.settings.scale_min).log()).sum()

    def gradients(
        self, params: dict[str, torch.Tensor], generator: torch.Generator
    ) -> tuple[float, dict[str, torch.Tensor]]:
        """Sum of all bits, and its gradients by the attributes that have bits."""
        leaves = {n: p.detach().clone().requires_grad_() for n, p in params.items()}
        bits = self.bits(leaves, generator)
        total = sum(bits.values())
        grads = torch.autograd.grad(total, [leaves[n] for n in bits])
        return float(total.detach()), dict(zip(bits, grads, strict=True))


def rotation_residuals(quats: torch.Tensor, order: torch.Tensor, nearest: torch.Tensor) -> torch.Tensor:
    """Rotation of each Gaussian relative to that of its nearest neighbour (spec 13.1): sines of half the angles about
    the first, second and third axis, [N, 3]. Of the equivalent rotations of an ellipsoid, the smallest.

    Args:
        quats: [N, 4] wxyz.
        order: [N, 3], axes by falling scale.
        nearest: [N] index.
    """
    own = torch.nn.functional.normalize(quats, dim=1)
    own = quat_multiply(own, _AXIS_ROTATIONS[order[:, 0] * 9 + order[:, 1] * 3 + order[:, 2]])
    between = quat_multiply(quat_conjugate(own[nearest]), own)
    form = torch.eye(4)[between.detach().abs().argmax(1)]
    w, x, y, z = quat_multiply(between, quat_conjugate(form)).unbind(1)
    first = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    second = torch.asin((2 * (w * y - z * x)).clamp(-0.999, 0.999))
    third = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return torch.sin(torch.stack([first, second, third], 1) / 2)
