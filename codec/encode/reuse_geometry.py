"""A stream with other colours: groups of an old stream -> groups with the same geometry and motion units.

Each group is decoded, given new colours (of splats, or fitted to pictures), and packed again (recolor.py). All streams
of the tiles except the colours keep their bytes, and so do the units of the nodes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .. import _native
from ..bitstream.quantized_group import QuantizedGroup
from ..decode.parametric import parametric_group
from ..decode.stream import Stream
from ..model.parametric_group import ParametricGroup
from .adaptive_rounding import AdaptiveRounding
from .coder import CamerasAt, RefineByPictures
from .encode import EncodeReport, completed
from .measure import measure_group
from .quantize import ReferenceGroup
from .recolor import COLORS, recolored
from .settings import EncodeSettings
from .writer import StreamWriter

Colors = Callable[[ParametricGroup, int], ParametricGroup]  # group, its first frame -> the same in new colours


@dataclass(frozen=True)
class _Coded:
    """A recoloured group, to which later groups may refer."""

    payload: bytes
    decoded: object  # _native.DecodedGroup
    integers: QuantizedGroup


def encode_recolored(
    old: Stream,
    colors: Colors,
    writer: StreamWriter,
    settings: EncodeSettings,
    *,
    cameras: CamerasAt = lambda _: (),
    refine_by_pictures: RefineByPictures | None = None,
    on_group: Callable[[EncodeReport], None] | None = None,
) -> EncodeReport:
    """Writes the groups of `old` in the colours that `colors` gives them, after the groups that `writer` already has.

    Args:
        cameras: frame -> cameras from which sensitivity is measured.
        refine_by_pictures: of a capture: moves the colours to match its pictures best.

    Raises:
        BitstreamError: `old` is damaged.
        CaptureError: the new colours do not fit its Gaussians.
    """
    report = EncodeReport(seconds={"input": 0.0, "code": 0.0})
    with completed(writer, report):
        known = _known(writer, old)
        for i in range(writer.groups, len(old.groups)):
            start, mark = old.groups[i]["start_frame"], time.perf_counter()
            decoded = old.group(i)
            group, q = colors(parametric_group(decoded), start), decoded.quantized()
            report.seconds["input"] += time.perf_counter() - mark
            mark = time.perf_counter()
            before = known[i - q.reference] if q.reference else None
            reference = before and ReferenceGroup(before.integers, before.decoded, q.reference)
            importance = measure_group(group, list(cameras(start + q.frames // 2)), settings.plan)
            quantized = recolored(q, group, importance, settings, reference)
            if refine_by_pictures and group.calibration is not None and len(q) and settings.refine != 0:
                rounding = AdaptiveRounding(quantized, settings, reference, only=COLORS)
                refine_by_pictures(group, start, rounding)
                quantized = rounding.quantized()
            payload, units = _native.encode_group(quantized.integers, reference and reference.decoded)
            known = {k: c for k, c in known.items() if q.reference} | {i: _coded(payload, old, reference)}
            kept = {str(k): np.frombuffer(c.payload, np.uint8) for k, c in known.items()}
            writer.append(payload, q.frames, sync=old.groups[i]["sync"], state=kept)
            report.seconds["code"] += time.perf_counter() - mark
            _account(report, units, old.groups[i] | {"bytes": len(payload), "predicted": bool(q.reference)}, len(q))
            if on_group:
                report.frames = writer.frames
                on_group(report)
    return report


def _coded(payload: bytes, old: Stream, reference: ReferenceGroup | None) -> _Coded:
    options = {"reference": reference.decoded} if reference else {}
    decoded = _native.DecodedGroup(payload, old.config["level"], **options)
    return _Coded(payload, decoded, decoded.quantized())


def _known(writer: StreamWriter, old: Stream) -> dict[int, _Coded]:
    """number -> group, for the groups since the last independent one that an earlier run wrote."""
    known: dict[int, _Coded] = {}
    for i, payload in sorted((int(k), a.tobytes()) for k, a in writer.state().items()):
        back = _native.reference_of(payload)
        before = known[i - back] if back else None
        known[i] = _coded(payload, old, before and ReferenceGroup(before.integers, before.decoded, back))
    return known


def _account(report: EncodeReport, units: list[dict], group: dict, gaussians: int) -> None:
    entry = {"frame": group["start_frame"], "ended": ""} | {n: group[n] for n in ("frames", "bytes", "predicted")}
    report.group_list.append(entry)
    report.predicted += entry["predicted"]
    report.gaussians = max(report.gaussians, gaussians)
    for u in units:
        name = u["type"] if not u.get("attribute") else f"{u['type']} {u['attribute']}"
        report.units[name] = report.units.get(name, 0) + u["bytes"]


def color_bytes(report: EncodeReport) -> int:
    """Bytes of colours in the groups that a report counts."""
    return sum(size for name, size in report.units.items() if name.rpartition(" ")[2] in COLORS)
