"""Stage refine: adaptive rounding. After quantization, integers move by one where that lowers the rendered error by
more than their bits cost.

Rounding each value on its own leaves errors that another value could make up for. The decoded frame is drawn and
compared with a target picture; the gradient of the squared difference moves the latent under each integer, straight
through the rounding (Bengio et al. 2013). Integers that others are decoded from stay: positions, nodes, rotations. Of a
single frame, sizes move too, and its rotations are coded again; of a predicted group, only trajectories move.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import _native
from ..bitstream.channels import channel_values
from ..bitstream.color import correlate
from ..model.gaussians import Gaussians, living
from ..render.cpu import CpuBackend
from ..render.optimizer import Adam
from ..render.sensitivity import derivatives
from ..threads import prefetched
from .quantize import Quantized, ReferenceGroup, with_rotations
from .refinement_views import Target
from .rounding_variables import CanonicalVariable, TrajectoryVariable, trajectory_variable
from .settings import EncodeSettings

MOVING_CANONICAL = ("logit_opacities", "sh0", "shN")  # rotations follow from sizes, and everything from positions
MOVING_STILL = ("log_scales", *MOVING_CANONICAL)
MOVING_OVER_TIME = ("means", "log_scales", *MOVING_CANONICAL)
HIDDEN = -30.0  # logit of an opacity that no renderer shows


class AdaptiveRounding:
    """The quantizer of one group: it is handed to whoever has pictures of the group.

    Args:
        quantized: the group. reference: what it is predicted from.
        only: attributes that may move; None: all that can.
    """

    def __init__(
        self,
        quantized: Quantized,
        settings: EncodeSettings,
        reference: ReferenceGroup | None = None,
        only: Sequence[str] | None = None,
    ):
        self._quantized, self._settings, self._reference = quantized, settings, reference
        self._still = quantized.form.frames == 1 and reference is None and only is None
        canonical = MOVING_STILL if self._still else MOVING_CANONICAL if reference is None else ()
        may = lambda n: only is None or n in only  # noqa: E731
        moving = [n for n in canonical if n in quantized.integers.channels and may(n)]
        self._variables: list[CanonicalVariable | TrajectoryVariable] = [
            trajectory_variable(n, quantized, settings)
            for n in MOVING_OVER_TIME
            if n in quantized.integers.trajectories and may(n)
        ] + [CanonicalVariable(n, quantized, settings) for n in moving]

    @property
    def frames(self) -> int:
        """Frames of the group."""
        return self._quantized.form.frames

    @property
    def gaussians(self) -> int:
        """Gaussians of the group."""
        return len(self._quantized.form.rest)

    def source(self, t: int) -> Gaussians:
        """Frame `t` of the group before it was quantized, in the order of the integers."""
        return self._shown(self._quantized.form.frame(t), t)

    def follow(self, targets: Iterable[Target], count: int, rate: float) -> None:
        """One step of Adam for each target.

        Args:
            targets: `count` of them: (frame, camera, background, picture [H, W, 3] f32, 0 to 1).
            rate: quantization steps that the first target moves a latent; it falls to 0 linearly.
        """
        backend, names = CpuBackend(), {v.attribute for v in self._variables}
        adam = Adam(backend, self._settings.rounding.adam)
        for step, (t, camera, background, picture) in enumerate(prefetched(targets)):
            off = lambda image, picture=picture: np.ascontiguousarray(image - picture)  # noqa: E731
            derivative = derivatives(backend, self.frame(t), camera, off, names, background)
            grads = [v.by_integers(derivative[v.attribute], t) for v in self._variables]
            latents = {k: v.latents.values for k, v in enumerate(self._variables)}
            adam.step(latents, dict(enumerate(grads)), dict.fromkeys(latents, rate * (1 - step / count)))
            for v in self._variables:
                v.latents.round()

    def frame(self, t: int) -> Gaussians:
        """Frame `t` as decoded with the integers as they are now."""
        before, values = self._before[t]
        now = {n: v.copy() for n, v in values.items()}
        for v in self._variables:
            v.add(now[v.attribute], t)
        return self._shown(_with_values(before, now), t)

    def quantized(self) -> Quantized:
        """The group with the integers as they are now."""
        q = self._quantized
        channels, trajectories = dict(q.integers.channels), dict(q.integers.trajectories)
        for v in self._variables:
            v.put(channels, trajectories)
        q = replace(q, integers=replace(q.integers, channels=channels, trajectories=trajectories))
        return with_rotations(q, self._settings.rdo) if self._still else q

    @cached_property
    def _before(self) -> list[tuple[Gaussians, dict[str, np.ndarray]]]:
        """Each frame as decoded at the start, as Gaussians and as coded values. Rotations of a single frame, which are
        coded again, are those of the source."""
        reference = self._reference.decoded if self._reference else None
        decoded = _native.DecodedGroup.reconstruct(self._quantized.integers, reference)
        frames = [Gaussians(**decoded.frame(t)) for t in range(self.frames)]
        if self._still:
            frames = [replace(frames[0], quats=self._quantized.form.coded_rotations)]
        return [(g, {n: v for n, v in channel_values(g).items() if n in MOVING_OVER_TIME}) for g in frames]

    def _shown(self, g: Gaussians, t: int) -> Gaussians:
        """The same with an opacity that shows nothing, where frame `t` is outside of a lifetime."""
        life = self._quantized.form.lifetimes
        if life is None:
            return g
        return replace(g, logit_opacities=np.where(living(life, t), g.logit_opacities, np.float32(HIDDEN)))


def _with_values(g: Gaussians, values: dict[str, np.ndarray]) -> Gaussians:
    """Inverse of `channel_values`, with the rotations of `g`."""
    shN = correlate(values["shN"].reshape(g.shN.shape)) if "shN" in values else g.shN
    opacities, sh0 = values["logit_opacities"][:, 0], correlate(values["sh0"])
    return Gaussians(values["means"], g.quats, values["log_scales"], opacities, sh0, shN)
