"""Refinement of what is coded: integers that nothing else is decoded by make up for what the others have left.

Of a single frame sizes, opacities and colours move, before its rotations are coded, which follow the sizes. Of a group
that is coded whole canonical opacities and colours move, and the coefficients of trajectories as far as those of each
Gaussian go; what a reference tells stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from .. import _native
from ..bitstream.color import decorrelate
from ..bitstream.transform import dct_basis
from ..model.gaussians import Gaussians
from . import companding as curved
from . import rdo
from .adaptive_rounding import Moving, refine, with_values
from .channels import coded_values, curves_of, shifts_of
from .refinement_views import DrawnTargets, PictureTargets
from .stack import Stack

CANONICAL = ("logit_opacities", "sh0", "shN")
OVER_TIME = ("means", "log_scales", *CANONICAL)
HIDDEN = -30.0  # logit of an opacity


class _Canonical:
    """Canonical integers of an attribute.

    Args:
        channels: of `quantize_channels`. shifts: [N] low bits that each Gaussian's layer leaves out.
        coded: [N, C] what they were quantized from. weights: [N, C] its sensitivities.
        layers: of `rdo.layers_of`.
    """

    def __init__(self, name: str, channels: dict, shifts: np.ndarray, coded, weights, layers: list, price: float):
        self._channels, self._curves, self._unit = channels, curves_of(channels), 1 << shifts[:, None]
        self._offset = np.array(channels["offsets"], np.float32)
        self._step = (self._unit * np.array(channels["steps"])).astype(np.float32)
        q = channels["values"].T / self._unit
        margins, weights = np.zeros((2, *q.shape), np.float32), weights * self._step**2
        for (own, near), c in product(layers, range(q.shape[1])):
            margins[:, own, c] = rdo.margins(q[own, c], weights[own, c], near, price)
        self.moving = Moving(name, (coded - self._offset) / self._step, q, margins)
        self._before = self.values()

    def _coded(self) -> np.ndarray:
        return self._offset + self._step * self.moving.integers

    def values(self) -> np.ndarray:
        """[N, C], as they are now."""
        return curved.back(self._coded(), self._curves)

    def add(self, values: np.ndarray, t: int) -> None:
        """To `values` [N, C] of the decoded frame `t`, what has changed."""
        values += self.values() - self._before

    def by_integers(self, derivative: np.ndarray, t: int) -> np.ndarray:
        """The derivative by them, from that by the values."""
        return derivative * (self._step * curved.rises(self._coded(), self._curves) if self._curves else self._step)

    def put(self, integers: dict) -> None:
        """Puts them into those of the group."""
        q = (self.moving.integers * self._unit).astype(np.int32)
        moved = {self.moving.attribute: self._channels | {"values": np.ascontiguousarray(q.T)}}
        integers["channels"] = integers["channels"] | moved


@dataclass(frozen=True)
class _Trajectory:
    """Coefficients [M, C]: of `frequency` [M] of the Gaussian `own` [M], sorted by it, along `basis` [K, T] times the
    step. Those of each Gaussian begin at `starts`. Methods as in `_Canonical`."""

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

    def put(self, integers: dict) -> None:
        coded = integers["trajectories"][self.moving.attribute]
        coefficients = coded["coefficients"].copy()
        coefficients[self.frequency, :, self.own] += self.moving.change
        moved = {self.moving.attribute: coded | {"coefficients": coefficients}}
        integers["trajectories"] = integers["trajectories"] | moved


def refine_still(
    channels: dict,
    shifts: dict,
    values: dict,
    weights: dict,
    layers: list,
    price: float,
    source: Gaussians,
    placed: Gaussians,
    targets: DrawnTargets | PictureTargets,
) -> dict:
    """`channels` of a single frame, refined.

    Args:
        shifts: attribute -> [N]. values, weights: attribute -> [N, C], what is coded. layers, price: as it was.
        source: as it is to look. placed: the same at decoded positions. targets: of `refine`.
    """
    parts = [_Canonical(n, c, shifts[n], values[n], weights[n], layers, price) for n, c in channels.items()]

    def shown(t):
        now = with_values(placed, {p.moving.attribute: p.values() for p in parts})
        return now, [lambda d, p=p: p.by_integers(d, t) for p in parts]

    refine([p.moving for p in parts], targets, lambda _: source, shown)
    return _with_integers({"channels": channels}, parts)["channels"]


def refine_group(
    integers: dict, s: Stack, weights: dict, price: float, targets: DrawnTargets | PictureTargets, reference=None
) -> dict:
    """`integers` of a group, refined.

    Args:
        s: what it was made of, in the order of the integers. weights: of `Importance`. price: of a bit.
        targets: of `refine`. reference: the decoded group that a predicted one refers to.
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

    refine([p.moving for p in parts], targets, lambda t: visible(s.frame(t), t), shown, frames)
    return _with_integers(integers, parts)


def _values(g: Gaussians) -> dict[str, np.ndarray]:
    """[N, C] of the attributes that move, as `with_values` takes them."""
    values = {"means": g.means, "log_scales": g.log_scales, "logit_opacities": g.logit_opacities[:, None]}
    values["sh0"] = decorrelate(g.sh0)
    return values | ({"shN": decorrelate(g.shN).reshape(len(g), -1)} if g.sh_degree else {})


def _canonical(integers: dict, left: dict, weights: dict, price: float) -> list[_Canonical]:
    """`left`: attribute -> [T, N, C], what is missing in each frame."""
    layers, shifts, parts = rdo.layers_of(integers["positions"], integers["layers"]), shifts_of(integers), []
    for n in CANONICAL:
        if n in integers["channels"]:
            c = integers["channels"][n]
            curves, before = curves_of(c), coded_values(c)
            coded = curved.along(curved.back(before, curves) + left[n].mean(0), curves)
            heard = curved.sensitivities(weights, {n: before}, {n: curves} if curves else {})[n]
            own = np.repeat(shifts[n], integers["layers"])
            parts.append(_Canonical(n, c, own, coded, heard, layers, price))
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


def _with_integers(integers: dict, parts: list[_Canonical | _Trajectory]) -> dict:
    integers = dict(integers)
    for p in parts:
        p.put(integers)
    return integers
