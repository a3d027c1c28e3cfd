"""Gaussians of one frame, the data model that every stage shares.

Names are gsplat's; a name tells the state of activation (`log_scales`, `logit_opacities`). Arrays are numpy f32 here;
the differentiable side (train, render) holds torch tensors under the same names. Data that crosses a module boundary
goes through `validate`, so that the stages themselves need no checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..errors import CaptureError

SH_C0 = 0.28209479177387814  # Y_00; colour = 0.5 + SH_C0 * sh0 (3D Gaussian Splatting, Kerbl et al. 2023)
SH_COUNTS = {0: 0, 3: 1, 8: 2, 15: 3}  # K of shN -> SH degree
OPACITY_LIMIT = 1e-6  # least distance of opacities from 0 and 1
GOP = 30  # most frames in a group, by default: one second
RANDOM_ACCESS = 150  # most frames from one independent group to the next, by default: five seconds


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities of logits, f64, without overflow."""
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -80, 80)))


def logit(opacities: np.ndarray | float) -> np.ndarray:
    """Inverse of `sigmoid`; 0 and 1, whose logits are not finite, are moved by `OPACITY_LIMIT`."""
    p = np.clip(opacities, OPACITY_LIMIT, 1 - OPACITY_LIMIT)
    return np.log(p / (1 - p))


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians of one frame.

    Attributes:
        means: [N, 3] f32, world units.
        quats: [N, 4] f32, wxyz, unit length.
        log_scales: [N, 3] f32, natural log of the standard deviations in world units.
        logit_opacities: [N] f32.
        sh0: [N, 3] f32, coefficient of Y_00 per colour channel.
        shN: [N, K, 3] f32, the higher bands, K = 0, 3, 8 or 15 (SH degree 0 to 3).
    """

    means: np.ndarray
    quats: np.ndarray
    log_scales: np.ndarray
    logit_opacities: np.ndarray
    sh0: np.ndarray
    shN: np.ndarray

    @staticmethod
    def none() -> Gaussians:
        """No Gaussians, of SH degree 0."""
        return Gaussians(*(np.zeros((0, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (3,), (0, 3))))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return SH_COUNTS[self.shN.shape[1]]

    def take(self, index: np.ndarray) -> Gaussians:
        """The Gaussians at `index` ([M] int or [N] bool), in that order."""
        return Gaussians(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def validate(self, where: str) -> Gaussians:
        """Checks shapes and values and returns f32, contiguous, unit-quaternion arrays.

        Args:
            where: source of the data, for the message, e.g. "statue/000003.ply".

        Raises:
            CaptureError: a shape is wrong, a value is not finite or a quaternion is zero.
        """
        n = len(self.means)
        k = self.shN.shape[1] if self.shN.ndim == 3 else -1
        if k not in SH_COUNTS:
            raise CaptureError(f"{where}: {k} SH coefficients a channel, expected 0, 3, 8 or 15 (degree 0 to 3)")
        shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,), "sh0": (n, 3)}
        shapes["shN"] = (n, k, 3)
        arrays = {}
        for name, shape in shapes.items():
            a = np.ascontiguousarray(getattr(self, name), np.float32)
            if a.shape != shape:
                raise CaptureError(f"{where}: {name} has shape {a.shape}, expected {shape}")
            bad = ~np.isfinite(a.reshape(n, -1)).all(1) if n else np.zeros(0, bool)
            if bad.any():
                raise CaptureError(
                    f"{where}: {name} of Gaussian {int(bad.argmax())} is not finite ({int(bad.sum())} such Gaussians); "
                    "drop them before encoding"
                )
            arrays[name] = a
        norm = np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
        if n and norm.min() == 0:
            raise CaptureError(
                f"{where}: the quaternion of Gaussian {int(norm.argmin())} is zero, expected unit length"
            )
        arrays["quats"] = (arrays["quats"] / norm).astype(np.float32)
        return Gaussians(**arrays)


PARAMETERS = tuple(f.name for f in fields(Gaussians))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenates sets with the same SH degree."""
    return Gaussians(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)})


def living(lifetimes: np.ndarray, t: int) -> np.ndarray:
    """[N] bool: whether frame `t` is in each lifetime [t0, t1) ([N, 2])."""
    return (lifetimes[:, 0] <= t) & (t < lifetimes[:, 1])


def shown_at(g: Gaussians, lifetimes: np.ndarray | None, t: int) -> Gaussians:
    """The Gaussians of `g` that live at frame `t`; all of them if `lifetimes` ([N, 2]) is None."""
    if lifetimes is None:
        return g
    return g.take(living(lifetimes, t))
