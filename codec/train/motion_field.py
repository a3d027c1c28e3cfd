"""Motion field of a group: a hash grid and an MLP, (rest position, time in the group) -> rigid motion.

The field is evaluated at the nodes of the deformation graph, so that the stream does not change and a query costs next
to nothing. Its coarse levels and the MLP move all nodes together where their gradients agree, its fine levels part of
them; in fine-tuning the temporal encoding joins the frames of a group. It is added to the free variables of the nodes,
which keep what a smooth field cannot say. Initially it is zero. After V3 (Wang et al. 2024), whose grid stands for one
frame, is evaluated at every Gaussian, and is not joined over time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..render.backend import Backend
from ..render.optimizer import Adam, AdamSettings
from .hash_grid import HashGrid
from .settings import MotionFieldSettings


@dataclass(frozen=True)
class FieldMotion:
    """What a field says of M nodes at one frame.

    Attributes:
        turn, shift: [M, 3] rotation vectors, and [M, 3] translations in world units.
        layers: input and output of the MLP, and what is between its layers, for the step along its gradients.
    """

    turn: torch.Tensor
    shift: torch.Tensor
    layers: list[torch.Tensor]


class MotionField:
    """Motion of M nodes in `frames` frames.

    Args:
        nodes: [M, 3] positions at rest, world units.
        radius: of the moving Gaussians, world units: the unit of translations.
        frames: of the group; 1: the field does not depend on time.
        backend: device of the optimiser; adam: its settings.
    """

    def __init__(
        self,
        nodes: torch.Tensor,
        radius: float,
        frames: int,
        settings: MotionFieldSettings,
        seed: int,
        backend: Backend,
        adam: AdamSettings,
    ):
        low = nodes.min(0).values
        self._points = ((nodes - low) / (nodes.max(0).values - low).max().clamp(min=1e-9)).contiguous()
        self._radius, self._rates = radius, {"grid": settings.grid_rate, "mlp": settings.mlp_rate}
        times = (torch.arange(frames) + 0.5) / frames
        orders = torch.arange(min(settings.temporal_frequencies, frames) if frames > 1 else 0)
        self._encoding = torch.cos(math.pi * times[:, None] * orders)  # [T, K], as the temporal transform has them
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self._grid = HashGrid(
                settings.levels, settings.features, settings.log2_table, settings.coarsest, settings.finest
            )
            inputs, width = settings.levels * settings.features + len(orders), settings.width
            layers = [torch.nn.Linear(inputs, width), torch.nn.Linear(width, width), torch.nn.Linear(width, 6)]
        torch.nn.init.zeros_(layers[-1].weight)
        torch.nn.init.zeros_(layers[-1].bias)
        self._parameters = {"grid": self._grid.table.data}
        for i, layer in enumerate(layers):
            self._parameters |= {f"mlp.{i}.weight": layer.weight.data, f"mlp.{i}.bias": layer.bias.data}
        self._adam = Adam(backend, adam)

    @torch.no_grad()
    def __call__(self, frame: int = 0) -> FieldMotion:
        """Motion at a frame."""
        x, p = self._grid.lookup(self._points), self._parameters
        layers = [torch.cat([x, self._encoding[frame].expand(len(x), -1)], 1)]
        for i in range(3):
            y = torch.addmm(p[f"mlp.{i}.bias"], layers[-1], p[f"mlp.{i}.weight"].T)
            layers.append(y.relu_() if i < 2 else y)
        return FieldMotion(y[:, :3], self._radius * y[:, 3:], layers)

    @torch.no_grad()
    def step(self, motion: FieldMotion, by_turns: torch.Tensor, by_shifts: torch.Tensor, decay: float) -> None:
        """One step along the gradients by the rotation vectors and the translations of a motion, [M, 3] both; all
        learning rates times `decay`."""
        layers, p, grads = motion.layers, self._parameters, {}
        by = torch.cat([by_turns, self._radius * by_shifts], 1)
        for i in (2, 1, 0):
            grads[f"mlp.{i}.weight"], grads[f"mlp.{i}.bias"] = by.T @ layers[i], by.sum(0)
            by = by @ p[f"mlp.{i}.weight"]
            by = by * (layers[i] > 0) if i else by
        grads["grid"] = self._grid.by_table(self._points, by[:, : -self._encoding.shape[1] or None])
        self._adam.step(p, grads, {n: decay * self._rates[n.split(".")[0]] for n in p})
