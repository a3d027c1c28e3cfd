"""The data model every stage shares: Gaussians of one frame, groups of frames, a sequence of groups.

Names are gsplat's; the state of activation is in the name (`log_scales`, `logit_opacities`). Arrays are numpy f32 here;
the differentiable side (train, render) holds torch tensors under the same names. What crosses a module boundary goes
through `validate`, so that the stages themselves need no checks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ..errors import CaptureError
from .camera import Calibration

SH_C0 = 0.28209479177387814  # Y_00; colour = 0.5 + SH_C0 * sh0 (3D Gaussian Splatting, Kerbl et al. 2023)
SH_COUNTS = {0: 0, 3: 1, 8: 2, 15: 3}  # K of shN -> SH degree
GOP = 30  # frames of a group at most, unless told otherwise: a second


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
            where: what the message names, e.g. "statue/000003.ply".

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


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """One set out of several with the same SH degree."""
    return Gaussians(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)})


@dataclass(frozen=True)
class Nodes:
    """Coarse motion of a group: M control points, each a rigid motion per frame (HiFi4G's ED graph, DualGS's joints).

    They carry Gaussians from a pose of rest: that of the keyframe, and for what has come in since a place beside it.

    Attributes:
        positions: [M, 3] f32, position of each node at rest, world units.
        rotations: [T, M, 3] f32, rotation vector in radians from rest to frame t, about the node.
        translations: [T, M, 3] f32, displacement of the node from rest, world units.
        rest: [N, 3] f32, position of each Gaussian at rest.
    """

    positions: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    rest: np.ndarray


@dataclass(frozen=True)
class Group:
    """T consecutive frames with one set of N Gaussians: index i is the same Gaussian in all of them.

    Attributes:
        frames: T items; may be a lazy sequence that loads on access.
        lifetimes: [N, 2] int32, the frames [t0, t1) of the group in which Gaussian i is shown; None: all frames.
        nodes: coarse motion if the trainer knows it; the encoder fits its own otherwise.
        parents: [N] int32, index in the group before of the Gaussian that each one continues, -1 for a new one; no two
            have the same parent. None: nothing is known, as in the first group. This is all that the encoder needs
            to predict a group: a trainer that starts from the last group's Gaussians says so here.
        calibration: of the capture that it was trained on; None: it has no pictures to be held against.
    """

    frames: Sequence[Gaussians]
    lifetimes: np.ndarray | None = None
    nodes: Nodes | None = None
    parents: np.ndarray | None = None
    calibration: Calibration | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def visible(self, t: int) -> Gaussians:
        """The Gaussians that frame `t` of the group shows."""
        g = self.frames[t]
        if self.lifetimes is None:
            return g
        return g.take((self.lifetimes[:, 0] <= t) & (t < self.lifetimes[:, 1]))


@dataclass(frozen=True)
class GaussianSequence:
    """Groups in playing order at `fps` frames a second."""

    fps: float
    groups: Sequence[Group]
    cameras: list = field(default_factory=list)  # reference cameras (camera.Camera), shown to the viewer

    @property
    def frame_count(self) -> int:
        return sum(len(g) for g in self.groups)

    def with_groups(self, groups: Sequence[Group]) -> GaussianSequence:
        return replace(self, groups=groups)

    def frame(self, t: int) -> Gaussians:
        """Frame `t` of the sequence as shown.

        Raises:
            IndexError: `t` is outside the sequence.
        """
        for g in self.groups:
            if 0 <= t < len(g):
                return g.visible(t)
            t -= len(g)
        raise IndexError("frame outside the sequence")
