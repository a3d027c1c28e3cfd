"""Trainable Gaussians: attribute tensors and their optimiser, which gain and lose Gaussians together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from .. import _native
from ..model.gaussians import PARAMETERS, SH_C0, Gaussians, logit
from ..model.rotations import turned_harmonics
from ..render.backend import Backend
from ..render.optimizer import Adam, AdamSettings

NAMES = PARAMETERS
REMOVED_LOGIT = -20.0  # logit of the opacity of a Gaussian that is removed, or not there yet


@dataclass(frozen=True)
class SizeBound:
    """Largest scale of a Gaussian by its place (`SizeSettings`).

    Attributes:
        center: [3], world units.
        near: distance from `center` below which the bound is constant, world units.
        share: largest scale over the distance.
    """

    center: torch.Tensor
    near: float
    share: float

    def log_scales(self, means: torch.Tensor) -> torch.Tensor:
        """[N, 1] natural logs of the largest scales at `means` [N, 3]."""
        distance = (means - self.center).norm(dim=1, keepdim=True)
        return torch.log(self.share * distance.clamp(min=self.near))


class Model:
    """N Gaussians as tensors (`params[name]`, f32) and, once `start_optimizer` is called, their optimiser."""

    def __init__(self, params: dict[str, torch.Tensor]):
        self.params = {n: params[n].detach().clone().float().contiguous() for n in NAMES}
        self._adam: Adam | None = None
        self._bound: SizeBound | None = None

    def __len__(self) -> int:
        return len(self.params["means"])

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.params["shN"].shape[1] + 1) - 1

    def start_optimizer(self, backend: Backend, settings: AdamSettings, bound: SizeBound | None = None) -> None:
        """A new Adam for a new stage or frame, with zero moments; no Gaussian grows beyond `bound`."""
        self._adam, self._bound = Adam(backend, settings), bound

    def step(self, grads: dict[str, torch.Tensor], rates: dict[str, float]) -> None:
        """One step of the optimiser on the attributes in `rates`."""
        self._adam.step(self.params, grads, rates)
        if self._bound is not None:
            self.limit_sizes(self._bound.log_scales(self.params["means"]))

    def limit_sizes(self, log_scales: torch.Tensor) -> None:
        """Limits the scales of each Gaussian to `log_scales` [N, 1], natural logs."""
        self.params["log_scales"] = torch.minimum(self.params["log_scales"], log_scales)

    def select(self, index: torch.Tensor) -> None:
        """Keeps the Gaussians at `index` ([M] int or [N] bool)."""
        for n in NAMES:
            self.params[n] = self.params[n][index].contiguous()
        if self._adam is not None:
            self._adam.select(index.numpy())

    def append(self, params: dict[str, torch.Tensor]) -> None:
        """Adds Gaussians, with zero moments."""
        for n in NAMES:
            self.params[n] = torch.cat([self.params[n], params[n].to(self.params[n].dtype)])
        if self._adam is not None:
            self._adam.append(len(params["means"]))

    def set_degree(self, degree: int) -> None:
        """Gives the Gaussians spherical harmonics of this degree; higher ones are dropped, missing ones are 0."""
        count = (degree + 1) ** 2 - 1
        shN = self.params["shN"]
        self.params["shN"] = torch.nn.functional.pad(shN, (0, 0, 0, count - shN.shape[1])).contiguous()
        if self._adam is not None:
            self._adam.resize("shN", count)

    @property
    def alive(self) -> torch.Tensor:
        """[N] bool: Gaussians that have not been removed."""
        return self.params["logit_opacities"] > REMOVED_LOGIT

    def gaussians(self) -> Gaussians:
        """A copy in numpy, quaternions normalised."""
        arrays = {n: p.detach().numpy().copy() for n, p in self.params.items()}
        arrays["quats"] /= np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
        return Gaussians(**arrays)


def quat_product(a: torch.Tensor, b: torch.Tensor, *, inverse_a: bool = False, inverse_b: bool = False) -> torch.Tensor:
    """Products [N, 4] of unit quaternions `a`, `b` [N, 4] f32, or of their inverses; native and without a gradient."""
    return torch.from_numpy(_native.quat_product(a.numpy(), b.numpy(), (inverse_a, inverse_b)))


def harmonics_turned(shN: torch.Tensor, rotations: torch.Tensor, *, back: bool = False) -> torch.Tensor:
    """`shN` [N, K, 3], turned by unit quaternions [N, 4], or by their inverse; native and without a gradient."""
    return torch.from_numpy(turned_harmonics(shN.numpy(), rotations.numpy(), back=back))


def from_points(points: np.ndarray, colors: np.ndarray, *, opacity: float) -> Model:
    """Round Gaussians half as wide as the distance to their neighbours, with SH of degree 0.

    Args:
        points: [N, 3] world units.
        colors: [N, 3] in 0..1.
        opacity: of all Gaussians, 0..1.
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
            "logit_opacities": torch.full((n,), float(logit(opacity))),
            "sh0": tensor((colors - 0.5) / SH_C0),
            "shN": torch.zeros(n, 0, 3),
        }
    )


def from_gaussians(g: Gaussians) -> Model:
    """A model that starts from given Gaussians."""
    return Model({n: torch.from_numpy(np.array(getattr(g, n), np.float32)) for n in NAMES})
