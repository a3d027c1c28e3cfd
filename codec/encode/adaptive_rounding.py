"""Stage refine: adaptive rounding. After quantization, integers move by one where that lowers the rendered error by
more than their bits cost.

Each value rounded on its own leaves errors that other values could compensate. The decoded frame is rendered and
compared with a target picture; the gradient of the squared difference moves the latent of each integer
(straight-through estimator, Bengio et al. 2013). Positions and nodes are fixed, since all other values are decoded from
them. Sizes are settled first, since the steps of the rotations follow from them; then the rotations are coded again,
and the other values compensate their rounding. In a predicted group, only trajectories move.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import _native
from ..bitstream.channels import channel_values
from ..bitstream.color import correlate
from ..model.gaussians import Gaussians, living
from ..model.rotations import turned_harmonics
from ..render.cpu import CpuBackend
from ..render.optimizer import Adam
from ..render.sensitivity import derivatives
from ..threads import prefetched
from .quantize import Quantized, ReferenceGroup, with_rotations
from .refinement_views import Target
from .rounding_variables import CanonicalVariable, TrajectoryVariable, trajectory_variable
from .settings import EncodeSettings

SIZES = "log_scales"
MOVING_CANONICAL = (SIZES, "logit_opacities", "sh0", "shN")
MOVING_OVER_TIME = ("means", *MOVING_CANONICAL)
HIDDEN = -30.0  # logit of an opacity that no renderer shows


class AdaptiveRounding:
    """Adaptive rounding of one group, by target pictures from the caller.

    Args:
        quantized: the group.
        reference: group from which it is predicted.
        only: attributes that may move; None: all.
        sizes: whether canonical sizes may move.
    """

    def __init__(
        self,
        quantized: Quantized,
        settings: EncodeSettings,
        reference: ReferenceGroup | None = None,
        only: Sequence[str] | None = None,
        sizes: bool = True,
    ):
        self._quantized, self._settings, self._reference = quantized, settings, reference
        may = lambda n: only is None or n in only  # noqa: E731
        canonical = [n for n in MOVING_CANONICAL if reference is None and (sizes or n != SIZES)]
        moving = [n for n in canonical if n in quantized.integers.channels and may(n)]
        self._variables: list[CanonicalVariable | TrajectoryVariable] = [
            trajectory_variable(n, quantized, settings)
            for n in MOVING_OVER_TIME
            if n in quantized.integers.trajectories and may(n)
        ] + [CanonicalVariable(n, quantized, settings) for n in moving]
        self._pool = ThreadPoolExecutor(os.cpu_count() or 1)

    @property
    def frames(self) -> int:
        """Frames of the group."""
        return self._quantized.form.frames

    @property
    def gaussians(self) -> int:
        """Gaussians of the group."""
        return len(self._quantized.form.rest)

    def source(self, t: int) -> Gaussians:
        """Frame `t` of the group before quantization, in the order of the integers."""
        return self._shown(self._quantized.form.frame(t), t)

    def follow(self, targets: Iterable[Target], count: int, rate: float) -> None:
        """One step of Adam for each target.

        Args:
            targets: `count` of them: (frame, camera, background, picture [H, W, 3] f32, 0 to 1).
            rate: quantization steps by which the first target moves a latent; it falls to 0 linearly.
        """
        backend, names = CpuBackend(), {v.attribute for v in self._variables}
        adam = Adam(backend, self._settings.rounding.adam)
        settled = int(self._settings.rounding.sizes_until * count)  # sizes settle before the last target
        for step, (t, camera, background, picture) in enumerate(prefetched(targets)):
            if step == settled:
                self._settle_sizes()
            off = lambda image, picture=picture: np.ascontiguousarray(image - picture)  # noqa: E731
            turns = None if self._turns is None else self._turns[t]
            derivative = derivatives(backend, self._at_rest(t), camera, off, names, background, turns)
            by_integers = lambda v, d=derivative, t=t: v.by_integers(d[v.attribute], t)  # noqa: E731
            grads = self._pool.map(by_integers, self._variables)
            latents = {id(v): v.latents.values for v in self._variables}
            rates = dict.fromkeys(latents, rate * (1 - step / count))
            adam.step(latents, dict(zip(latents, grads, strict=True)), rates)
            list(self._pool.map(lambda v: v.latents.round(), self._variables))

    def frame(self, t: int) -> Gaussians:
        """Frame `t` decoded from the current integers."""
        g = self._at_rest(t)
        return g if self._turns is None else replace(g, shN=turned_harmonics(g.shN, self._turns[t]))

    def _at_rest(self, t: int) -> Gaussians:
        """`frame`, with SH that is not rotated."""
        before, values = self._before[t]

        def now(attribute: str) -> np.ndarray:
            moved = values[attribute].copy()
            for v in self._variables:
                if v.attribute == attribute:
                    v.add(moved, t)
            return moved

        moved = dict(zip(values, self._pool.map(now, values), strict=True))
        return self._shown(_with_values(before, moved), t)

    def quantized(self) -> Quantized:
        """The group with the current integers."""
        q = self._quantized
        channels, trajectories = dict(q.integers.channels), dict(q.integers.trajectories)
        for v in self._variables:
            v.put(channels, trajectories)
        return replace(q, integers=replace(q.integers, channels=channels, trajectories=trajectories))

    def _settle_sizes(self) -> None:
        """Fixes the sizes from now on, and codes the rotations again, whose steps follow from them."""
        moving = [v for v in self._variables if isinstance(v, CanonicalVariable) and v.attribute == SIZES]
        if not moving:
            return
        q = self._quantized
        channels = dict(q.integers.channels)
        moving[0].put(channels, {})
        q = replace(q, integers=replace(q.integers, channels=channels))
        self._quantized = with_rotations(q, self._settings.rdo)
        self._variables.remove(moving[0])
        for name in ("_decoded", "_before"):  # decoded again; `_turns` stays, since the nodes do not change
            vars(self).pop(name, None)

    @cached_property
    def _before(self) -> list[tuple[Gaussians, dict[str, np.ndarray]]]:
        """Each frame decoded from the start integers of the variables, as Gaussians and as coded values; SH at rest."""
        out = []
        for t in range(self.frames):
            g = Gaussians(**self._decoded.frame(t))
            if self._turns is not None:
                g = replace(g, shN=turned_harmonics(g.shN, self._turns[t], back=True))
            out.append((g, {n: v for n, v in channel_values(g).items() if n in MOVING_OVER_TIME}))
        return out

    @cached_property
    def _decoded(self):
        """The group decoded from the start integers of the variables."""
        reference = self._reference.decoded if self._reference else None
        return _native.DecodedGroup.reconstruct(self._quantized.integers, reference)

    @cached_property
    def _turns(self) -> np.ndarray | None:
        """Rotations [T, N, 4] of the SH in each frame; None: SH is not rotated."""
        q = self._quantized.integers
        turns = q.turned_harmonics and q.nodes is not None and "shN" in q.channels
        return self._decoded.carried()[1] if turns else None

    def _shown(self, g: Gaussians, t: int) -> Gaussians:
        """`g` with opacity `HIDDEN` for Gaussians whose lifetime does not include frame `t`."""
        life = self._quantized.form.lifetimes
        if life is None:
            return g
        return replace(g, logit_opacities=np.where(living(life, t), g.logit_opacities, np.float32(HIDDEN)))


def _with_values(g: Gaussians, values: dict[str, np.ndarray]) -> Gaussians:
    """Inverse of `channel_values`, with the rotations of `g`."""
    shN = correlate(values["shN"].reshape(g.shN.shape)) if "shN" in values else g.shN
    opacities, sh0 = values["logit_opacities"][:, 0], correlate(values["sh0"])
    return Gaussians(values["means"], g.quats, values["log_scales"], opacities, sh0, shN)
