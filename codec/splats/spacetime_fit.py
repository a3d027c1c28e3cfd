"""A sequence -> Spacetime Gaussians, by least squares for each Gaussian: cubic positions, linear rotations, an opacity
that is a Gaussian in time, one size and one colour. Other motions and fades are only approximated; the caller compares
the frames and decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..errors import UsageError
from ..model.gaussian_sequence import GaussianSequence
from ..model.gaussians import Gaussians, logit, sigmoid
from .spacetime import FADE_MIN, SpacetimeGaussians

VALUES_MAX = 60_000_000  # Gaussians times frames that are fitted at once, 56 bytes each
HIDDEN = 0.002  # target opacity of a Gaussian next to its lifetime
HIDDEN_WEIGHT = 0.1  # weight of that target, as a share of the weight of the highest opacity
EDGE = 3  # frames next to a lifetime that have this target
WIDEST, NARROWEST = 1e4, 1e-3  # widths in time; a wider opacity is constant
POWERS = 4  # coefficients of a cubic


@dataclass(frozen=True)
class _Tracks:
    """All Gaussians of a sequence over its T frames: `frames` with [T, N] in front, `shown` [T, N] bool."""

    frames: Gaussians
    shown: np.ndarray


def fit_spacetime(sequence: GaussianSequence, identities: Sequence[np.ndarray]) -> SpacetimeGaussians:
    """The scene whose state at time t / T is nearest to frame t of the sequence. Harmonics are left out.

    Args:
        identities: for each group [N] int; equal numbers are the same Gaussian.

    Raises:
        UsageError: the sequence is empty, or too long for one fit.
    """
    count = 1 + max((int(i.max(initial=-1)) for i in identities), default=-1)
    if not 0 < count * sequence.frame_count <= VALUES_MAX:
        raise UsageError(
            f"{count} Gaussians in {sequence.frame_count} frames, expected 1 to {VALUES_MAX} in all for a .splatv; "
            "choose fewer frames"
        )
    tracks = _tracks(sequence, identities, count)
    times = np.arange(sequence.frame_count) / sequence.frame_count
    opacity = sigmoid(tracks.frames.logit_opacities)
    weights = np.where(tracks.shown, np.maximum(opacity, 1e-3), 0.0)  # [T, N]
    peaks, centers, widths = _fade(opacity, weights, tracks.shown, times)
    dt = times[:, None] - centers
    motion = _polynomial(dt, tracks.frames.means, weights, POWERS)
    turning = _polynomial(dt, _continuous(tracks.frames.quats, tracks.shown), weights, 2)
    share = weights / weights.sum(0)
    mean = lambda a: np.einsum("tn,tnc->nc", share, a)  # noqa: E731
    rest = Gaussians(
        means=motion[0],
        quats=turning[0],
        log_scales=mean(tracks.frames.log_scales),
        logit_opacities=logit(peaks),
        sh0=mean(tracks.frames.sh0),
        shN=np.zeros((count, 0, 3), np.float32),
    )
    return SpacetimeGaussians(rest, motion[1:], turning[1], centers, widths)


def _tracks(sequence: GaussianSequence, identities: Sequence[np.ndarray], count: int) -> _Tracks:
    frames, names = sequence.frame_count, [f.name for f in fields(Gaussians) if f.name != "shN"]
    sizes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh0": (3,)}
    out = {n: np.zeros((frames, count, *sizes[n]), np.float32) for n in names}
    shown, t = np.zeros((frames, count), bool), 0
    for i in range(len(sequence.groups)):
        group, own = sequence.groups[i], identities[i]
        for k in range(len(group)):
            g = group.frame(k)
            for n in names:
                out[n][t, own] = getattr(g, n)
            life = group.lifetimes
            shown[t, own] = True if life is None else (life[:, 0] <= k) & (k < life[:, 1])
            t += 1
    return _Tracks(Gaussians(shN=np.zeros((frames, count, 0, 3), np.float32), **out), shown)


def _polynomial(dt: np.ndarray, values: np.ndarray, weights: np.ndarray, powers: int) -> np.ndarray:
    """[powers, N, C] f64, the polynomial in dt [T, N] nearest to values [T, N, C]; a ridge keeps unneeded high powers
    near 0."""
    wanted = dt.shape[0] * 1e-9 * np.arange(powers) ** 2 + 1e-12  # ridge: few frames do not determine high powers
    basis = np.stack([dt**p for p in range(powers)])  # [P, T, N]
    normal = np.einsum("ptn,qtn,tn->npq", basis, basis, weights) + np.diag(wanted)
    right = np.einsum("ptn,tnc,tn->npc", basis, values.astype(np.float64), weights)
    return np.linalg.solve(normal, right).transpose(1, 0, 2)


def _fade(opacity, weights, shown, times) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Highest opacities, their times and the widths, [N] each: a parabola fitted to the logarithm of the opacities. If
    a Gaussian would be visible next to its lifetime, the fit includes a low opacity there."""
    near = np.zeros_like(shown)
    for k in range(1, EDGE + 1):
        near[k:] |= shown[:-k]
        near[:-k] |= shown[k:]
    near &= ~shown
    value, weight = np.log(np.maximum(opacity, 1e-6)), weights**2
    middle = (weights * times[:, None]).sum(0) / weights.sum(0)
    dt = times[:, None] - middle
    free = _polynomial(dt, value[..., None], weight, 3)[..., 0]
    value = np.where(near, np.log(HIDDEN), value)
    weight = np.where(near, HIDDEN_WEIGHT * weight.max(0), weight)
    bound = _polynomial(dt, value[..., None], weight, 3)[..., 0]
    left = np.where(near, free[0] + dt * (free[1] + dt * free[2]), -np.inf).max(0, initial=-np.inf)
    a, b, c = np.where(left > np.log(FADE_MIN), bound, free)
    falls = c < -1 / WIDEST**2
    c = np.minimum(c, -(WIDEST**-2))
    shift = np.where(falls, -b / (2 * c), 0)
    far = np.abs(shift) > 1  # opacity still rises or falls at the end of the clip: the peak stays near
    shift = np.clip(shift, -1, 1)
    mean = (weights * opacity).sum(0) / weights.sum(0)
    peaks = np.where(falls, np.exp(np.minimum(a + b * shift + c * shift**2, 0)), mean)
    peaks = np.where(falls & far, opacity.max(0), peaks)
    widths = np.where(falls, 1 / np.sqrt(-c), np.inf)
    return np.clip(peaks, 1e-4, 1 - 1e-4), middle + shift, np.maximum(widths, NARROWEST)


def _continuous(quats: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """[T, N, 4], each quaternion with the sign that is nearer to the last shown one."""
    out, last = quats.astype(np.float64), quats[shown.argmax(0), np.arange(quats.shape[1])].astype(np.float64)
    for t in range(len(out)):
        out[t] *= np.where(np.einsum("nc,nc->n", out[t], last) < 0, -1, 1)[:, None]
        last = np.where(shown[t][:, None], out[t], last)
    return out
