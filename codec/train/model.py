"""Trainable Gaussians: attribute tensors with their Adam moments, and the surgery that densification needs."""

from __future__ import annotations

import math

import numpy as np
import torch

from .. import _native
from ..model.gaussians import SH_C0, Gaussians
from .settings import AdamSettings

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
HIDDEN = -20.0  # logit of the opacity of what is not there


class Model:
    """N Gaussians as tensors (`params[name]`, f32) with Adam moments of the same shapes."""

    def __init__(self, params: dict[str, torch.Tensor]):
        self.params = {n: params[n].detach().clone().float().contiguous() for n in NAMES}
        self._first = {n: torch.zeros_like(p) for n, p in self.params.items()}
        self._second = {n: torch.zeros_like(p) for n, p in self.params.items()}
        self._steps = 0

    def __len__(self) -> int:
        return len(self.params["means"])

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.params["shN"].shape[1] + 1) - 1

    @torch.no_grad()
    def adam(self, grads: dict[str, torch.Tensor], rates: dict[str, float], settings: AdamSettings) -> None:
        """One Adam step (Kingma and Ba 2015) on the attributes in `rates`, each in one pass over memory."""
        self._steps += 1
        for name, rate in rates.items():
            tensors = (self.params[name], grads[name].float().contiguous(), self._first[name], self._second[name])
            _native.adam(
                tuple(t.numpy() for t in tensors), rate, (settings.beta1, settings.beta2), settings.eps, self._steps
            )

    def restart(self) -> None:
        """Forgets the moments (a new frame, a new stage)."""
        self._steps = 0
        for store in (self._first, self._second):
            for t in store.values():
                t.zero_()

    def select(self, index: torch.Tensor) -> None:
        """Keeps the Gaussians at `index` ([M] int or [N] bool)."""
        for store in (self.params, self._first, self._second):
            for n in NAMES:
                store[n] = store[n][index].contiguous()

    def append(self, params: dict[str, torch.Tensor]) -> None:
        """Adds Gaussians with fresh moments."""
        for n in NAMES:
            new = params[n].to(self.params[n].dtype)
            self.params[n] = torch.cat([self.params[n], new])
            for store in (self._first, self._second):
                store[n] = torch.cat([store[n], torch.zeros_like(new)])

    def set_degree(self, degree: int) -> None:
        """Gives the Gaussians spherical harmonics of this degree: higher ones go, lower ones that are missing are 0."""
        more = (degree + 1) ** 2 - 1 - self.params["shN"].shape[1]
        for store in (self.params, self._first, self._second):
            store["shN"] = torch.nn.functional.pad(store["shN"], (0, 0, 0, more)).contiguous()

    def gaussians(self) -> Gaussians:
        """A copy in numpy, quaternions normalised."""
        arrays = {n: p.detach().numpy().copy() for n, p in self.params.items()}
        arrays["quats"] /= np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
        return Gaussians(**arrays)


def from_points(points: np.ndarray, colors: np.ndarray, *, opacity: float, sh_count: int = 0) -> Model:
    """Round Gaussians half as wide as the distance to their neighbours, in the given colours (0..1).

    Args:
        points: [N, 3]; colors: [N, 3].
        opacity: high where points are known to lie on the subject, low where they are guesses.
    """
    from scipy.spatial import cKDTree

    n = len(points)
    near = cKDTree(points).query(points, min(4, n))[0].reshape(n, -1)[:, 1:] if n > 1 else np.ones((n, 1))
    spacing = np.maximum(near.mean(1), 1e-6 + 1e-3 * near.mean()) if n else np.zeros(0)
    tensor = lambda a: torch.tensor(np.ascontiguousarray(a), dtype=torch.float32)  # noqa: E731
    quats = np.zeros((n, 4))
    quats[:, 0] = 1
    return Model(
        {
            "means": tensor(points),
            "quats": tensor(quats),
            "log_scales": tensor(np.log(0.5 * spacing)[:, None].repeat(3, 1)),
            "logit_opacities": torch.full((n,), float(np.log(opacity / (1 - opacity)))),
            "sh0": tensor((colors - 0.5) / SH_C0),
            "shN": torch.zeros(n, sh_count, 3),
        }
    )


def from_gaussians(g: Gaussians) -> Model:
    """A model that starts from given Gaussians."""
    return Model({n: torch.from_numpy(np.array(getattr(g, n), np.float32)) for n in NAMES})
