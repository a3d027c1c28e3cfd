"""Motion field of a group: a hash grid and an MLP, (rest position, time in the group) -> rigid motion.

The field is evaluated at the nodes of the deformation graph, so that the stream does not change and a query costs next
to nothing. Its coarse levels and the MLP move all nodes together where their gradients agree, its fine levels part of
them; in fine-tuning the temporal encoding joins the frames of a group. It is added to the free variables of the nodes,
which keep what a smooth field cannot say. Initially it is zero. After V3 (Wang et al. 2024), whose grid stands for one
frame, is evaluated at every Gaussian, and is not joined over time.
"""

from __future__ import annotations

import math

import torch

from ..render.backend import Backend
from ..render.optimizer import Adam, AdamSettings
from .hash_grid import HashGrid
from .settings import MotionFieldSettings


class MotionField(torch.nn.Module):
    """Motion of M nodes in `frames` frames.

    Args:
        nodes: [M, 3] positions at rest, world units.
        radius: of the moving Gaussians, world units: the unit of translations.
        frames: of the group; 1: the field does not depend on time.
    """

    def __init__(self, nodes: torch.Tensor, radius: float, frames: int, settings: MotionFieldSettings, seed: int):
        super().__init__()
        low = nodes.min(0).values
        self._points = ((nodes - low) / (nodes.max(0).values - low).max().clamp(min=1e-9)).contiguous()
        self._radius, self._rates = radius, {"grid": settings.grid_rate, "mlp": settings.mlp_rate}
        times = (torch.arange(frames) + 0.5) / frames
        orders = torch.arange(min(settings.temporal_frequencies, frames) if frames > 1 else 0)
        self._encoding = torch.cos(math.pi * times[:, None] * orders)  # [T, K], as the temporal transform has them
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.grid = HashGrid(
                settings.levels, settings.features, settings.log2_table, settings.coarsest, settings.finest
            )
            inputs, width = settings.levels * settings.features + len(orders), settings.width
            layer, act = torch.nn.Linear, torch.nn.ReLU
            self.mlp = torch.nn.Sequential(layer(inputs, width), act(), layer(width, width), act(), layer(width, 6))
        torch.nn.init.zeros_(self.mlp[-1].weight)
        torch.nn.init.zeros_(self.mlp[-1].bias)

    def forward(self, frame: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
        """Rotation vectors [M, 3] and translations [M, 3] in world units at a frame."""
        time = self._encoding[frame].expand(len(self._points), -1)
        out = self.mlp(torch.cat([self.grid(self._points), time], 1))
        return out[:, :3], self._radius * out[:, 3:]

    def start_optimizer(self, backend: Backend, settings: AdamSettings) -> None:
        """Forgets what an optimiser knew of earlier steps."""
        self._adam = Adam(backend, settings)

    def step(self, decay: float) -> None:
        """One step along the gradients, which are cleared; all learning rates times `decay`."""
        values = dict(self.named_parameters())
        grads = {n: p.grad if p.grad is not None else torch.zeros_like(p) for n, p in values.items()}
        rates = {n: decay * self._rates[n.split(".")[0]] for n in values}
        with torch.no_grad():
            self._adam.step({n: p.data for n, p in values.items()}, grads, rates)
        self.zero_grad()
