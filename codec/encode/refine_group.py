"""Refinement of a group: once all is coded it is decoded, and what can still move makes up for the rest.

Canonical opacities and colours move, and coefficients of trajectories as far as those of each Gaussian go. Sizes stay,
since rotations are decoded by them; so does what a reference tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gscodec import _native
from gscodec.bitstream.color import decorrelate
from gscodec.bitstream.transform import dct_basis
from gscodec.camera import Camera
from gscodec.encode import curves as curved
from gscodec.encode import rdo
from gscodec.encode.channels import curves_of, margins_of, shifts_of
from gscodec.encode.refine import Moving, refine, with_values
from gscodec.encode.stack import Stack
from gscodec.gaussians import Gaussians

CANONICAL = ("logit_opacities", "sh0", "shN")
OVER_TIME = ("means", "log_scales", *CANONICAL)
HIDDEN = -30.0  # logit of an opacity


@dataclass(frozen=True)
class _Canonical:
    """Canonical integers [N, C], of steps [N, C] along curves; `before`: [N, C] what is quantized, at the start."""

    moving: Moving
    step: np.ndarray
    before: np.ndarray
    curves: list[curved.Curve]

    def add(self, values: np.ndarray, t: int) -> None:
        now = self.before + self.step * self.moving.change
        values += curved.back(now, self.curves) - curved.back(self.before, self.curves)

    def by_integers(self, derivative: np.ndarray, t: int) -> np.ndarray:
        if not self.curves:
            return derivative * self.step
        return derivative * self.step * curved.rises(self.before + self.step * self.moving.change, self.curves)


@dataclass(frozen=True)
class _Trajectory:
    """Coefficients [M, C]: of `frequency` [M] of the Gaussian `own` [M], sorted by it, along `basis` [K, T] times the
    step. Those of each Gaussian begin at `starts`."""

    moving: Moving
    basis: np.ndarray
    frequency: np.ndarray
    own: np.ndarray
    starts: np.ndarray

    def add(self, values: np.ndarray, t: int) -> None:
        sums = np.add.reduceat(self.basis[self.frequency, t, None] * self.moving.change, self.starts, 0)
        values[self.own[self.starts]] += sums

    def by_integers(self, derivative: np.ndarray, t: int) -> np.ndarray:
        return self.basis[self.frequency, t, None] * derivative[self.own]


def refine_group(integers: dict, s: Stack, weights: dict, price: float, cameras: list[Camera], reference=None) -> dict:
    """`integers` of a group, refined.

    Args:
        s: what it was made of, in the order of the integers. weights: of `Importance`. price: of a bit.
        cameras: of `refine`. reference: the decoded group that a predicted one refers to.
    """
    frames, (payload, _) = len(s.means), _native.encode_group(integers, reference)
    decoded = _native.DecodedGroup(payload, len(_native.levels()), reference=reference)
    before = [Gaussians(**decoded.frame(t)) for t in range(frames)]
    values = [_values(g) for g in before]
    given = {"means": s.means} | s.appearance
    left = {n: s.held(v - np.stack([at[n] for at in values])) for n, v in given.items()}
    parts = _trajectories(integers, left, weights, price)
    if reference is None:
        parts += _canonical(integers, left, weights, price)

    def visible(g, t):
        seen = decoded.visible(t)
        return g if seen is None else replace(g, logit_opacities=np.where(seen, g.logit_opacities, HIDDEN))

    def shown(t):
        now = {n: v.copy() for n, v in values[t].items()}
        for p in parts:
            p.add(now[p.moving.attribute], t)
        return visible(with_values(before[t], now), t), [lambda d, p=p: p.by_integers(d, t) for p in parts]

    refine([p.moving for p in parts], lambda t: visible(s.frame(t), t), shown, cameras, frames)
    return _with_integers(integers, parts)


def _values(g: Gaussians) -> dict[str, np.ndarray]:
    """[N, C] of the attributes that move, as `with_values` takes them."""
    values = {"means": g.means, "log_scales": g.log_scales, "logit_opacities": g.logit_opacities[:, None]}
    values["sh0"] = decorrelate(g.sh0)
    return values | ({"shN": decorrelate(g.shN).reshape(len(g), -1)} if g.sh_degree else {})


def _canonical(integers: dict, left: dict, weights: dict, price: float) -> list[_Canonical]:
    ends = np.cumsum(integers["layers"])
    spans = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]
    layers = [(own, rdo.neighbours(integers["positions"][own])) for own in spans]
    shifts, parts = shifts_of(integers), []
    for n in CANONICAL:
        if n in integers["channels"]:
            c = integers["channels"][n]
            unit = np.repeat(1 << shifts[n], integers["layers"])[:, None]
            q, step = c["values"].T / unit, (unit * np.array(c["steps"])).astype(np.float32)
            curves, before = curves_of(c), np.array(c["offsets"], np.float32) + step * q
            values = curved.back(before, curves) + left[n].mean(0)
            latents = q + (curved.along(values, curves) - before) / step
            heard = curved.sensitivities(weights, {n: before}, {n: curves} if curves else {})[n]
            parts.append(
                _Canonical(Moving(n, latents, q, margins_of(q, heard, step, layers, price)), step, before, curves)
            )
    return parts


def _trajectories(integers: dict, left: dict, weights: dict, price: float) -> list[_Trajectory]:
    parts = []
    for n, coded in integers["trajectories"].items():
        if n in OVER_TIME:
            q, step, frames = coded["coefficients"].transpose(2, 0, 1), coded["step"], len(left[n])
            used = np.flip(np.maximum.accumulate(np.flip((q != 0).any(2), 1), 1), 1)  # as far as each Gaussian's go
            own, frequency = np.nonzero(used)
            starts = np.flatnonzero(np.diff(own, prepend=-1))
            basis, some = dct_basis(frames)[: q.shape[1]], own[starts]
            latents = np.einsum("kt,tnc->nkc", basis / step, left[n][:, some])[used[some]]
            q = q[own, frequency]
            margins = rdo.trajectory_margins(q, weights[n][own], step, frames, price)
            basis = (basis * step).astype(np.float32)
            parts.append(_Trajectory(Moving(n, q + latents, q, margins), basis, frequency, own, starts))
    return parts


def _with_integers(integers: dict, parts: list) -> dict:
    channels, trajectories = dict(integers["channels"]), dict(integers["trajectories"])
    for p in parts:
        n, moved = p.moving.attribute, p.moving.change
        if isinstance(p, _Canonical):
            c = channels[n]
            unit = np.rint(p.step[:, :1] / np.float32(c["steps"][0])).astype(np.int32)
            channels[n] = c | {"values": np.ascontiguousarray(c["values"] + (moved * unit).T, dtype=np.int32)}
        else:
            coefficients = trajectories[n]["coefficients"].copy()
            coefficients[p.frequency, :, p.own] += moved
            trajectories[n] = trajectories[n] | {"coefficients": coefficients}
    return integers | {"channels": channels, "trajectories": trajectories}
