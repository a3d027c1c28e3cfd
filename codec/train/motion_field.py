"""Motion field of a group: a hash grid and an MLP, (rest position, time in the group) -> rigid motion.

The field is evaluated at the nodes of the deformation graph, so that the stream does not change and a query is cheap.
Its coarse levels and the MLP move all nodes together where their gradients agree, its fine levels groups of nodes; in
fine-tuning the temporal encoding connects the frames of a group. The field is added to the free variables of the nodes,
which keep the motion that a smooth field cannot express. Initially it is zero. After V3 (Wang et al. 2024), which has
one grid for each frame, evaluates it at every Gaussian, and does not connect frames.
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
    """Motion of M nodes at one frame from a field.

    Attributes:
        turn: [M, 3] rotation vectors.
        shift: [M, 3] translations, world units.
        layers: input of the MLP, values between its layers, and its output, for the gradients.
    """

    turn: torch.Tensor
    shift: torch.Tensor
    layers: list[torch.Tensor]


class MotionField:
    """Motion of M nodes in `frames` frames.

    Args:
        nodes: [M, 3] positions at rest, world units.
        radius: of the moving Gaussians, world units: the unit of translations.
        frames: number of frames in the group; 1: the field does not depend on time.
        backend: device of the optimiser.
        adam: settings of the optimiser.
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
        self._encoding = torch.cos(math.pi * times[:, None] * orders)  # [T, K], cosines of the temporal transform
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
