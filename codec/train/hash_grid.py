"""Multi-resolution hash grid (Instant-NGP, Mueller et al. 2022) of the motion field: native, and a plain reference.

[N, 3] in [0, 1] -> [N, levels * features]. Levels grow geometrically from base_resolution to max_resolution cells on a
side; a level whose vertices fit the table is dense, the others are hashed. The MLP after it runs in torch.
"""

from __future__ import annotations

import numpy as np
import torch

from .. import _native
from ..errors import UsageError

PRIMES = (1, 2654435761, 805459861)


class HashGrid(torch.nn.Module):
    """A trainable grid of features.

    Args:
        levels, features: L and F; F is 1, 2, 4 or 8.
        log2_table: at most 2**log2_table entries a level.
        base_resolution, max_resolution: cells on a side of the first and the last level.

    Attributes:
        table: [entries, F] f32, initially uniform in +-1e-4, as in the paper.
        cells: [L] cells on a side of each level.

    Raises:
        UsageError: a size that the kernels do not support.
    """

    def __init__(
        self,
        levels: int = 16,
        features: int = 4,
        log2_table: int = 15,
        base_resolution: int = 16,
        max_resolution: int = 512,
    ):
        super().__init__()
        growth = (max_resolution / base_resolution) ** (1 / max(levels - 1, 1))
        self.cells = [int(base_resolution * growth**l + 1e-6) for l in range(levels)]
        self.features, self.table_size = features, 2**log2_table
        try:
            self.native = _native.HashGrid(features, self.cells, self.table_size)
        except ValueError as e:
            raise UsageError(f"hash grid: {e}") from None
        self.table = torch.nn.Parameter(torch.empty(self.native.entries, features).uniform_(-1e-4, 1e-4))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """[N, 3] in [0, 1] (clamped) -> [N, L * F]; gradients for the table, and for points that require one."""
        return _Lookup.apply(points, self.table, self)

    def lookup(self, points: torch.Tensor) -> torch.Tensor:
        """`forward` at points [N, 3] f32, without gradients and their bookkeeping."""
        out = np.empty((len(points), len(self.cells) * self.features), np.float32)
        self.native.forward(points.numpy(), self.table.detach().numpy(), out)
        return torch.from_numpy(out)

    def by_table(self, points: torch.Tensor, grad_out: torch.Tensor) -> torch.Tensor:
        """Gradient [entries, F] by the table, from that by the result of `forward` at points [N, 3] f32."""
        grad = torch.zeros_like(self.table)
        table = self.table.detach().numpy()
        self.native.backward(points.numpy(), table, grad_out.contiguous().numpy(), grad.numpy(), None)
        return grad

    def reference(self, points: torch.Tensor) -> torch.Tensor:
        """`forward` in plain torch, in the dtype of `points`."""
        table, outputs, first = self.table.to(points.dtype), [], 0
        corners = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])
        for cells in self.cells:
            entries = min((cells + 1) ** 3, self.table_size)
            x = points.clamp(0, 1) * cells
            low = x.detach().floor().clamp_max(cells - 1)
            frac = x - low
            v = low.long()[:, None] + corners  # [N, 8, 3]
            if entries == (cells + 1) ** 3:
                row = (v[..., 2] * (cells + 1) + v[..., 1]) * (cells + 1) + v[..., 0]
            else:
                h = v * torch.tensor(PRIMES)
                row = (h[..., 0] ^ h[..., 1] ^ h[..., 2]) & (entries - 1)
            weight = torch.where(corners.bool(), frac[:, None], 1 - frac[:, None]).prod(2)  # [N, 8]
            outputs.append((weight[..., None] * table[first + row]).sum(1))
            first += entries
        return torch.cat(outputs, 1)


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points, table, grid):
        if points.ndim != 2 or points.shape[1] != 3:
            raise UsageError(f"points have shape {tuple(points.shape)}, expected [N, 3]")
        x = points.detach().float().contiguous()
        ctx.native, ctx.dtype = grid.native, points.dtype
        ctx.save_for_backward(x, table)
        return grid.lookup(x)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_out):
        x, table = ctx.saved_tensors
        grad_table = torch.zeros_like(table)
        grad_points = torch.zeros_like(x) if ctx.needs_input_grad[0] else None
        ctx.native.backward(
            x.numpy(),
            table.detach().numpy(),
            grad_out.float().contiguous().numpy(),
            grad_table.numpy(),
            None if grad_points is None else grad_points.numpy(),
        )
        return None if grad_points is None else grad_points.to(ctx.dtype), grad_table, None
