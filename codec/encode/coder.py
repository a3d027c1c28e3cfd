"""Groups -> payloads: measure, plan, quantize, refine, pack; independent, or predicted where that is cheaper.

A group is predicted from the last independent one. `CoderState` holds the data for that, and the lineage of the
Gaussians since; it is returned with each group and never changed, so that a group can be tried more than once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from .. import _native
from ..bitstream.quantized_group import QuantizedGroup
from ..model.camera import Camera
from ..model.parametric_group import ParametricGroup, checked_parents
from ..render.sensitivity import Importance, sensitivity_cameras
from .adaptive_rounding import AdaptiveRounding
from .coded_form import CodedForm, ReferenceForm, coded_form
from .companding import Curve
from .measure import measure_group
from .quantization_plan import Known, Parameters, plan_group
from .quantize import Quantized, ReferenceGroup, dequantize, grid_of, quantize
from .refinement_views import Target, drawn_views
from .settings import EncodeSettings


class RefineByPictures(Protocol):
    """Refines a group, which begins at frame `first_frame` of the capture, by the pictures that it was trained on."""

    def __call__(
        self, group: ParametricGroup, first_frame: int, quantizer: AdaptiveRounding, views: int | None = None
    ) -> None:
        """Refines by `views` pictures; None: by as many as usually pay."""

    def masked_pictures(
        self, group: ParametricGroup, first_frame: int, count: int, seed: int
    ) -> Iterable[tuple[Target, np.ndarray | None]]:
        """`count` of the pictures, in the order that `seed` draws, each with its mask [H, W] u8; None: no mask."""


FORM = ("rest", "rotations", "axis_order", "axis_rotation")  # arrays of a `ReferenceForm`

CamerasAt = Callable[[int], Sequence[Camera]]  # frame of the stream -> cameras from which the subject was captured


@dataclass(frozen=True)
class CodedGroup:
    """A coded group.

    Attributes:
        payload: bytes of the group.
        units: its units with their bytes.
        gaussians: number of coded Gaussians.
        independent: the group refers to no other group.
    """

    payload: bytes
    units: list[dict]
    gaussians: int
    independent: bool


@dataclass(frozen=True)
class CoderState:
    """State from which the next group may be predicted.

    Attributes:
        payload: of the last independent group.
        form: form in which that group was coded.
        trajectory_steps: attribute -> step of a value in one frame.
        node_step: step of node translations, world units.
        frames: number of frames of that group and of the groups since.
        back: distance in groups from the next group to that group.
        lineage: [N] index of each Gaussian of the group before in the integers of the independent group; -1: none.
    """

    payload: bytes
    form: ReferenceForm
    trajectory_steps: dict[str, float]
    node_step: float
    frames: int
    back: int
    lineage: np.ndarray

    @cached_property
    def decoded(self):
        """The independent group as `_native.DecodedGroup`."""
        return _native.DecodedGroup(self.payload, len(_native.levels()))

    @cached_property
    def integers(self) -> QuantizedGroup:
        """The integers of the independent group."""
        return self.decoded.quantized()

    @cached_property
    def known(self) -> Known:
        """Parameters and layers that a predicted group shares with the independent group."""
        q = self.integers
        names = ("means", *q.channels)
        shifts = np.zeros((len(q.layers), len(names)), int) if q.shifts is None else q.shifts.astype(int)
        curves = {n: [Curve.of(row) for row in c.companding] for n, c in q.channels.items() if c.companding is not None}
        parameters = Parameters(
            grid_of(q),
            {n: c.steps for n, c in q.channels.items()},
            dict(zip(names, shifts.T, strict=True)),
            curves,
            q.scale_exponents,
            self.trajectory_steps,
            self.node_step,
        )
        opacities = dequantize(q.channels["logit_opacities"], curves.get("logit_opacities"))[:, 0]
        return Known(parameters, np.repeat(np.arange(len(q.layers)), q.layers), opacities)

    def after(self, group: ParametricGroup, lineage: np.ndarray) -> CoderState:
        """The state after one more predicted group."""
        return replace(self, frames=self.frames + len(group), back=self.back + 1, lineage=lineage)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All fields as arrays, from which a later run continues."""
        arrays = {n: np.asarray(getattr(self, n)) for n in ("node_step", "frames", "back", "lineage")}
        arrays |= {f"form.{n}": getattr(self.form, n) for n in FORM}
        arrays |= {f"rounding.{n}": v for n, v in self.form.rounding.items()}
        arrays |= {f"trajectory_steps.{n}": np.asarray(v) for n, v in self.trajectory_steps.items()}
        return {"payload": np.frombuffer(self.payload, np.uint8), **arrays}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> CoderState | None:
        """Inverse of `to_arrays`; None where there is no state."""
        if "payload" not in arrays:
            return None
        of = lambda kind: {n.partition(".")[2]: v for n, v in arrays.items() if n.startswith(f"{kind}.")}  # noqa: E731
        return CoderState(
            arrays["payload"].tobytes(),
            ReferenceForm(**of("form"), rounding=of("rounding")),
            {n: float(v) for n, v in of("trajectory_steps").items()},
            float(arrays["node_step"]),
            int(arrays["frames"]),
            int(arrays["back"]),
            arrays["lineage"],
        )


@dataclass(frozen=True)
class GroupCoder:
    """Codes groups.

    Attributes:
        settings: of the encoder.
        fps: frames a second of the stream.
        cameras: frame -> cameras of the capture, if there is one; sensitivity is measured from them, too.
        refine_by_pictures: refinement by the pictures of a capture, if they are available.
    """

    settings: EncodeSettings
    fps: float = 30.0
    cameras: CamerasAt = lambda _: ()
    refine_by_pictures: RefineByPictures | None = None

    def measure(self, group: ParametricGroup, first_frame: int) -> Importance:
        """Importance of the Gaussians, which `code` needs at any quality."""
        return measure_group(group, list(self.cameras(first_frame + len(group) // 2)), self.settings.plan)

    def has_pictures(self, group: ParametricGroup) -> bool:
        """Whether `group` can be compared with the pictures that it was trained on."""
        return self.refine_by_pictures is not None and group.calibration is not None

    def quantized(self, group: ParametricGroup, importance: Importance, quality: float) -> Quantized:
        """An independent group in integers, before refinement."""
        form = coded_form(group, np.full(len(group.canonical), -1))
        plan = plan_group(form, importance.with_axes(form.axis_order), quality, self.settings)
        return quantize(form, plan, self.settings.rdo)

    def code(
        self, state: CoderState | None, group: ParametricGroup, importance: Importance, quality: float, first_frame: int
    ) -> tuple[CodedGroup, CoderState | None]:
        """Codes the next group, which begins at `first_frame` of the stream; returns it and the state after it.

        Raises:
            CaptureError: its parents do not fit the group before, or a picture cannot be read.
        """
        lineage = _lineage(group, state)
        if lineage is None or state.frames + len(group) > self.settings.random_access:
            return self._independent(state, group, importance, quality, first_frame)
        if group.turned_harmonics != state.integers.turned_harmonics:
            return self._independent(state, group, importance, quality, first_frame)
        reference = ReferenceGroup(state.integers, state.decoded, state.back)
        form = coded_form(group, lineage, state.form)
        own = importance.with_axes(form.axis_order)
        plan = plan_group(form, own, quality, self.settings, state.known)
        coded, _ = self._packed(quantize(form, plan, self.settings.rdo, reference), group, first_frame, reference)
        if len(coded.payload) > self.settings.doubt * len(state.payload):
            other = self._independent(state, group, importance, quality, first_frame)
            if len(other[0].payload) <= len(coded.payload):
                return other
        return coded, state.after(group, lineage)

    def _independent(self, state, group, importance, quality, first_frame) -> tuple[CodedGroup, CoderState | None]:
        coded, quantized = self._packed(self.quantized(group, importance, quality), group, first_frame)
        if self.settings.random_access <= len(group):
            return coded, None  # no later group is near enough to be predicted
        return coded, _state_of(quantized, coded.payload, chosen=self.has_pictures(group))

    def _packed(
        self, quantized: Quantized, group: ParametricGroup, first_frame: int, reference: ReferenceGroup | None = None
    ) -> tuple[CodedGroup, Quantized]:
        """Stages refine and pack."""
        quantized = self._refined(quantized, group, first_frame, reference)
        payload, units = _native.encode_group(quantized.integers, reference.decoded if reference else None)
        return CodedGroup(payload, units, len(quantized.integers), reference is None), quantized

    def _refined(self, quantized, group, first_frame, reference) -> Quantized:
        if self.settings.refine == 0 or not len(quantized.integers):
            return quantized
        if self.has_pictures(group):
            rounding = AdaptiveRounding(quantized, self.settings, reference)
            self.refine_by_pictures(group, first_frame, rounding)
            return rounding.quantized()
        views, middle = self._drawn_views(group), len(group) // 2
        if not views:
            return quantized
        sizes = len(group) == 1  # few views per frame measure sizes poorly
        rounding = AdaptiveRounding(quantized, self.settings, reference, sizes=sizes)
        form, rate = quantized.form, self.settings.rounding.drawn_rate / views**0.5
        cameras = sensitivity_cameras(form.means[middle], list(self.cameras(first_frame + middle)), views)
        rounding.follow(drawn_views(rounding.source, cameras, form.frames), views, rate)
        return rounding.quantized()

    def _drawn_views(self, group: ParametricGroup) -> int:
        """Number of drawn views by which a group of splats is refined."""
        s = self.settings
        if s.refine is not None:
            return s.refine
        return s.rounding.frame_views * len(group) if len(group) > 1 and len(group.canonical) <= s.plan.few else 0


def _state_of(quantized: Quantized, payload: bytes, *, chosen: bool) -> CoderState:
    """The state after an independent group; `chosen`: pictures have chosen its rounding, which stays."""
    form: CodedForm = quantized.form
    parameters, channels = quantized.plan.parameters, quantized.integers.channels
    lineage = np.full(len(form.group.canonical), -1)
    lineage[form.index] = np.arange(len(form.index))
    values = form.values.items() if chosen else ()
    rounding = {n: dequantize(channels[n], parameters.curves.get(n)) - v for n, v in values}
    known = ReferenceForm(*(getattr(form, n) for n in FORM), rounding)
    return CoderState(payload, known, parameters.trajectory_steps, parameters.node_step, form.frames, 1, lineage)


def _lineage(group: ParametricGroup, state: CoderState | None) -> np.ndarray | None:
    """[N] int, index in the independent group of the Gaussian that each one continues, -1: none; None: unknown.

    Raises:
        CaptureError: two Gaussians have the same parent, or a parent does not exist.
    """
    if group.parents is None or state is None:
        return None
    before = state.lineage
    parents = checked_parents(group.parents, len(group.canonical), len(before))
    return np.where(parents >= 0, before[np.maximum(parents, 0)] if len(before) else -1, -1)
