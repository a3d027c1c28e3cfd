"""Recolouring: the colours of a group are fitted to the pictures of a capture; geometry and motion stay as they are.

In: a group, pictures. Out: the group with new colours and colour trajectories. First one affine map of all colours,
since a grade or another light is mostly affine; it also changes Gaussians that no camera sees. Then Adam on the
harmonics and the lowest temporal frequencies of every Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..bitstream.color import TO_RGB, correlate, decorrelate
from ..model.gaussians import SH_C0, Gaussians, living
from ..model.parametric_group import ParametricGroup
from ..model.rotations import turned_harmonics
from ..model.temporal_transform import dct_basis
from ..render.cpu import CpuBackend
from ..render.optimizer import Adam, AdamSettings
from ..render.sensitivity import derivatives, params_of
from .refinement import Picture
from .settings import RecolorSettings

HIDDEN = -30.0  # logit of an opacity that no renderer shows
NAMES = ("sh0", "shN")


def fit_colors(
    group: ParametricGroup, first: Iterable[Picture], pictures: Iterable[Picture], count: int, settings: RecolorSettings
) -> ParametricGroup:
    """The group with colours fitted to pictures.

    Args:
        first: pictures for the affine map.
        pictures: `count` pictures, one a step.
    """
    fit = _Fit(group, settings)
    fit.map_colors(first)
    for step, picture in enumerate(pictures):
        fit.step(picture, 1 - step / count)
    return fit.group()


class _Fit:
    """Colours of a group as Y, Co, Cg: canonical values [N, C], and coefficients [N, K, C] of the temporal DCT."""

    def __init__(self, group: ParametricGroup, settings: RecolorSettings):
        self._group, self._settings, self._backend = group, settings, CpuBackend()
        self._frames, self._turns = [_shown(group, t) for t in range(len(group))], group.harmonics_turns()
        self._basis = dct_basis(len(group)).astype(np.float32)  # [T, T]
        n, g = len(group.canonical), group.canonical
        self.values = {"sh0": decorrelate(g.sh0.astype(np.float32))}
        if g.sh_degree:
            self.values["shN"] = decorrelate(g.shN.astype(np.float32)).reshape(n, -1)
        self.values = {name: np.ascontiguousarray(v) for name, v in self.values.items()}
        self.over_time = {name: self._coefficients(name) for name in self.values}
        self._adam = Adam(self._backend, AdamSettings(eps=1e-8))

    def _coefficients(self, name: str) -> np.ndarray:
        """[N, K, C] f32; the constant part is moved to the canonical values and 0 here."""
        c, (n, channels) = self._group.trajectories.get(name), self.values[name].shape
        least = min(self._settings.frequencies if name == "sh0" else 1, len(self._group))
        out = np.zeros((n, max(least, 0 if c is None else len(c)), channels), np.float32)
        if c is not None:
            own = decorrelate(c.transpose(2, 0, 1).reshape(n, len(c), -1, 3)).reshape(n, len(c), channels)
            out[:, : len(c)] = own
            self.values[name] += own[:, 0] / np.float32(len(self._group) ** 0.5)
            out[:, 0] = 0
        return out

    def frame(self, t: int) -> Gaussians:
        """Frame `t` with the current colours."""
        g = self._at_rest(t)
        return g if self._turns is None else replace(g, shN=turned_harmonics(g.shN, self._turns[t]))

    def _at_rest(self, t: int) -> Gaussians:
        """`frame` without the turn of the harmonics."""
        g, now = self._frames[t], {}
        for name, v in self.values.items():
            c = self.over_time[name]
            at = self._basis[1 : c.shape[1], t]
            now[name] = v + np.einsum("k,nkc->nc", at, c[:, 1:]) if len(at) else v
        shN = correlate(now["shN"].reshape(g.shN.shape)) if "shN" in now else g.shN
        return replace(g, sh0=correlate(now["sh0"]), shN=shN)

    def map_colors(self, pictures: Iterable[Picture]) -> None:
        """Maps all colours by the affine map that brings rendered pixels nearest to the pictures."""
        ours, theirs = [], []
        for t, camera, background, picture in pictures:
            image, alpha = self._backend.render(params_of(self.frame(t)), camera, background)
            inside = alpha > self._settings.opaque
            ours.append(image[inside])
            theirs.append(picture[inside])
        x, y = np.concatenate(ours).astype(np.float64), np.concatenate(theirs).astype(np.float64)
        if len(x) < self._settings.pixels_least:
            return
        x = np.column_stack([x, np.ones(len(x))])
        prior = self._settings.prior * len(x)  # towards the identity, for colours that hardly vary
        A = np.linalg.solve(x.T @ x + prior * np.eye(4), x.T @ y + prior * np.eye(4, 3))  # [4, 3]
        turn, shift = A[:3].T, (0.5 * A[:3].sum(0) + A[3] - 0.5) / SH_C0
        by = np.linalg.inv(TO_RGB) @ turn @ TO_RGB  # on Y, Co, Cg
        for arrays in (self.values, self.over_time):
            for name, v in arrays.items():
                arrays[name] = np.ascontiguousarray((v.reshape(-1, 3) @ by.T).reshape(v.shape), np.float32)
        self.values["sh0"] += decorrelate(shift[None]).astype(np.float32)

    def step(self, picture: Picture, left: float) -> None:
        """One step of Adam; `left`: share of the steps that remain, a factor of the rates."""
        t, camera, background, target = picture
        off = lambda image: np.ascontiguousarray(image - target)  # noqa: E731
        turns = None if self._turns is None else self._turns[t]
        derivative = derivatives(self._backend, self._at_rest(t), camera, off, self.values, background, turns)
        params, grads, rates = {}, {}, {}
        for name, v in self.values.items():
            rate = left * self._settings.rates[name]
            params[name], grads[name], rates[name] = v, derivative[name], rate
            c, moving = self.over_time[name], f"{name} over time"
            if c.shape[1] > 1:
                at = self._basis[: c.shape[1], t].copy()
                at[0] = 0  # the constant is in the canonical values
                params[moving], grads[moving] = c, at[:, None] * derivative[name][:, None]
                rates[moving] = rate * self._settings.over_time
        self._adam.step(params, grads, rates)

    def group(self) -> ParametricGroup:
        """The group in its new colours."""
        g, n = self._group.canonical, len(self._group.canonical)
        shN = correlate(self.values["shN"].reshape(g.shN.shape)) if "shN" in self.values else g.shN
        trajectories = {name: c for name, c in self._group.trajectories.items() if name not in NAMES}
        for name, c in self.over_time.items():
            rgb = correlate(c.reshape(n, c.shape[1], -1, 3)).reshape(c.shape)
            if rgb.any():
                trajectories[name] = np.ascontiguousarray(rgb.transpose(1, 2, 0))
        canonical = replace(g, sh0=correlate(self.values["sh0"]), shN=shN)
        return replace(self._group, canonical=canonical, trajectories=trajectories)


def _shown(group: ParametricGroup, t: int) -> Gaussians:
    """Frame `t` of the group; Gaussians outside of their lifetime are transparent."""
    g, life = group.frame(t), group.lifetimes
    if life is None:
        return g
    shown = living(life, t)
    return replace(g, logit_opacities=np.where(shown, g.logit_opacities, np.float32(HIDDEN)))


def picture_count(cameras: int, frames: int, settings: RecolorSettings) -> int:
    """Steps for a group of `frames` frames of `cameras` training cameras."""
    return max(settings.steps_least, min(settings.passes * cameras, settings.frame_pictures) * frames)
