"""Groups -> payloads: each independent, or predicted from the last independent one where that is cheaper.

The coder remembers the last independent group as it was coded, and where the Gaussians of the groups since came from;
`state` is that memory as arrays, from which a later run goes on as if it had never stopped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .. import _native
from ..capture import Capture
from ..errors import CaptureError
from ..model.camera import Camera
from ..model.gaussians import Group
from .inter_group import predict_group
from .intra_group import Coded, code_group
from .quantization_plan import FEW
from .refinement_views import PictureTargets

FRAME_VIEWS = 10  # by which a group of few Gaussians is refined, if nobody says
SEEN, FRAME_PICTURES = 4, 80  # where there are pictures, so often each of them, so many of a frame at most
DOUBT = 0.7  # a predicted group of more than so many bytes a frame of its reference is coded both ways


@dataclass
class CodedGroup:
    """Payload of a group, the bytes of its units, and whether it is independent."""

    payload: bytes
    units: list[dict]
    gaussians: int
    independent: bool


@dataclass(frozen=True)
class _Payload:
    data: bytes

    @cached_property
    def decoded(self):
        """`_native.DecodedGroup`, made when the first group refers to it."""
        return _native.DecodedGroup(self.data, len(_native.levels()))


@dataclass(frozen=True)
class _Reference:
    coded: Coded
    payload: _Payload
    frames: int  # of it and of the groups since
    back: int  # groups since, itself included
    index: np.ndarray  # of each Gaussian of the group before: which one it is in the reference, -1: none


class GroupCoder:
    """Codes groups in their order. A shallow copy is a coder of its own, for trying.

    Args:
        keep_all, layers: as in `code_group`. refine: as in `EncodeSettings`.
        cameras: of the capture, if there was one. capture: whose pictures groups are refined by, if they can be had.
        random_access: frames from one independent group to the next at most; 0 or 1: every group is independent.
    """

    def __init__(
        self,
        *,
        keep_all: bool,
        layers: int | None,
        random_access: int,
        refine: int | None = None,
        cameras: list[Camera] = (),
        capture: Capture | None = None,
    ):
        self._options = {"keep_all": keep_all, "cameras": cameras}
        self._layers, self._refine, self._capture = layers, refine, capture
        self._random_access, self._reference = random_access, None

    def code(self, group: Group, quality: float, first_frame: int) -> CodedGroup:
        """The next group, which begins at `first_frame` of the stream.

        Raises:
            CaptureError: its parents do not fit the group before, or a picture cannot be read.
        """
        parents, r, refining = self._parents(group), self._reference, self._refining(group, first_frame)
        if parents is None or r.frames + len(group) > self._random_access:
            return self._independent(group, quality, refining)
        options = self._options | refining | {"decoded": r.payload.decoded}
        integers = predict_group(group, parents, r.back, r.coded, quality=quality, **options)
        payload, units = _native.encode_group(integers, r.payload.decoded)
        if len(payload) > DOUBT * len(r.payload.data):
            other = self._independent(group, quality, refining)
            if len(other.payload) <= len(payload):
                return other
        self._reference = replace(r, frames=r.frames + len(group), back=r.back + 1, index=parents)
        return CodedGroup(payload, units, len(integers["positions"]), False)

    def _independent(self, group: Group, quality: float, refining: dict) -> CodedGroup:
        coded = code_group(group, quality, layers=self._layers, **self._options, **refining)
        payload, units = _native.encode_group(coded.integers)
        if self._random_access > len(group):
            index = np.arange(len(group.frames[0]))
            self._reference = _Reference(coded, _Payload(payload), len(group), 1, index)
        return CodedGroup(payload, units, len(coded.source), True)

    def _refining(self, group: Group, first_frame: int) -> dict:
        """By what a group is refined: `views` and `pictures` of `code_group`."""
        pictured = self._capture is not None and group.calibration is not None
        if pictured:
            usual = min(SEEN * len(self._capture.indices("train")), FRAME_PICTURES)
        else:
            usual = FRAME_VIEWS if len(group) > 1 and len(group.frames[0]) <= FEW else 0
        views = usual * len(group) if self._refine is None else self._refine
        if not pictured:
            return {"views": views}
        given = self._capture, group.calibration, first_frame, views, len(group.frames[0])
        return {"views": views, "pictures": PictureTargets(*given)}

    def state(self) -> dict[str, np.ndarray]:
        """What the next group may be predicted from; empty if from nothing."""
        r = self._reference
        if r is None:
            return {}
        numbers = {"frames": np.array(r.frames), "back": np.array(r.back)}
        return {**numbers, "index": r.index, "payload": np.frombuffer(r.payload.data, np.uint8), **r.coded.state()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Goes on behind the groups after which another coder had this `state`."""
        if "payload" in state:
            payload, numbers = _Payload(state["payload"].tobytes()), (int(state["frames"]), int(state["back"]))
            self._reference = _Reference(Coded.restored(state), payload, *numbers, state["index"])

    def _parents(self, group: Group) -> np.ndarray | None:
        """[N] int, which Gaussian of the reference each one is, -1: none; None: nothing is known."""
        if group.parents is None or self._reference is None:
            return None
        parents, before = np.asarray(group.parents), self._reference.index
        count = len(group.frames[0])
        known = parents[parents >= 0] if parents.shape == (count,) else parents
        if parents.shape != (count,) or len(np.unique(known)) < len(known) or known.max(initial=-1) >= len(before):
            raise CaptureError(
                f"parents of a group: expected, for each of its {count} Gaussians, another one of the {len(before)} "
                f"of the group before, or -1"
            )
        return np.where(parents >= 0, before[np.maximum(parents, 0)] if len(before) else -1, -1)
