"""ParametricGroups -> .gsv: the loop over groups, with progress, interruption and resume.

Groups come one at a time (a trainer yields each when it is done), become integers, then bytes, and are appended. An
interrupted run continues where it stopped, to the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .. import _native
from ..bitstream.levels import smallest_level
from ..bitstream.quantization import QUALITY_DEFAULT
from ..errors import LimitError
from ..model.camera import Camera
from ..model.parametric_group import ParametricGroup
from .audio import AudioTrack
from .coder import CamerasAt, CodedGroup, CoderState, GroupCoder, RefineByPictures
from .quality_search import choose_quality
from .rate_control import code_at_rate
from .settings import EncodeSettings
from .writer import StreamWriter


@dataclass
class EncodeReport:
    """Result of encoding: `bytes` of the file, `units` with their bytes, `seconds` in each stage."""

    frames: int = 0
    groups: int = 0
    predicted: int = 0  # number of predicted groups, in this run
    bytes: int = 0
    gaussians: int = 0  # most in one group
    quality: float | None = None  # of the last group
    chosen_quality: bool = False  # found by search: coding costs about `loss` decibels
    loss: float = 0.0
    interrupted: bool = False
    seconds: dict = field(default_factory=dict)
    units: dict = field(default_factory=dict)
    group_list: list[dict] = field(default_factory=list)  # of this run: frame, frames, bytes, predicted, ended

    def group_rates(self) -> tuple[float | None, float | None]:
        """kB per frame of the first group of the stream, and of all later groups; None: this run has coded none."""
        first = [g for g in self.group_list if g["frame"] == 0]
        later = [g for g in self.group_list if g["frame"] > 0]
        rate = lambda some: sum(g["bytes"] for g in some) / sum(g["frames"] for g in some) / 1000  # noqa: E731
        return rate(first) if first else None, rate(later) if later else None

    def to_json(self) -> dict:
        """The report with the rates that follow from it."""
        frames = max(self.frames, 1)
        return {
            **self.__dict__,
            "kb_per_frame": self.bytes / frames / 1000,
            "bits_per_gaussian_frame": 8 * self.bytes / frames / self.gaussians if self.gaussians else None,
        }


def stream_config(
    *,
    fps: float,
    sh_degree: int,
    gaussians: int,
    frames: int,
    cameras: list[Camera] = (),
    up: str = "y",
    background=(0.5,) * 3,
) -> dict:
    """The config box: data that a player needs before the first group.

    Args:
        gaussians, frames: approximate numbers per group; the level is the smallest with room for twice the Gaussians.
    """
    return {
        "fps": fps,
        "level": smallest_level(gaussians=2 * gaussians, frames=frames),
        "metres_per_unit": 1.0,
        "up": up,
        "color_space": "srgb",
        "background": [float(b) for b in background],
        "sh_degree": sh_degree,
        "cameras": [
            {
                "name": c.name,
                "K": np.asarray(c.K, float).tolist(),
                "viewmat": np.asarray(c.viewmat, float).tolist(),
                "near": float(c.near),
                "low_pass": float(c.low_pass),
                "width": c.width,
                "height": c.height,
            }
            for c in cameras
        ],
    }


@dataclass(frozen=True)
class StreamOutput:
    """Destination of a stream.

    Attributes:
        path: final path, OUT.gsv.
        config: result of `stream_config`.
        fingerprint: data that must be equal for a second run to continue the groups of the first one (JSON-able).
        audio: audio track of the stream.
    """

    path: Path
    config: dict
    fingerprint: dict = field(default_factory=dict)
    audio: AudioTrack | None = None


def encode_groups(
    groups: Callable[[int, int], Iterable[ParametricGroup]],
    output: StreamOutput,
    settings: EncodeSettings,
    *,
    cameras: CamerasAt = lambda _: (),
    refine_by_pictures: RefineByPictures | None = None,
    on_group: Callable[[EncodeReport], None] | None = None,
    keep_part: bool = False,
) -> EncodeReport:
    """Writes a stream from the groups that `groups(done, frames)` yields: the groups after the `done` groups (`frames`
    frames) that an earlier run left in the file.

    Args:
        cameras: frame -> cameras of the capture for training; sensitivity is measured from them.
        refine_by_pictures: (group, first frame, quantizer) of a capture: the last stage of training, for groups that
            have a calibration.
        keep_part: also a complete stream keeps the files from which a later run continues; that run has nothing to do.

    Ctrl-C finishes the file with the groups done and returns with `interrupted` set; the next run continues.
    """
    writer = StreamWriter(output.path, output.config, output.fingerprint, output.audio)
    coder = GroupCoder(settings, float(output.config["fps"]), cameras, refine_by_pictures)
    report = EncodeReport(seconds={"input": 0.0, "code": 0.0})
    with completed(writer, report, keep_part=keep_part):
        _code_all(groups(writer.groups, writer.frames), coder, writer, report, on_group)
    return report


@contextmanager
def completed(writer: StreamWriter, report: EncodeReport, *, keep_part: bool = False) -> Iterator[None]:
    """Context of the loop that appends groups: finishes the file, also after Ctrl-C, and counts it in `report`."""
    try:
        yield
    except KeyboardInterrupt:
        report.interrupted = True
    except BaseException:
        writer.abandon()
        raise
    if writer.groups:
        writer.finish(keep_part=keep_part or report.interrupted)
    else:
        writer.abandon()
    report.frames, report.groups = writer.frames, writer.groups
    report.bytes = writer.out.stat().st_size if writer.groups else 0


def _code_all(groups: Iterable[ParametricGroup], coder: GroupCoder, writer: StreamWriter, report, on_group) -> None:
    """Codes and appends group after group, from the state in which an earlier run left the writer."""
    arrays = writer.state()
    state, quality = CoderState.from_arrays(arrays), coder.settings.quality
    quality = float(arrays["quality"]) if "quality" in arrays else quality
    clock = time.perf_counter
    mark = clock()
    for group in groups:
        report.seconds["input"] += clock() - mark
        mark, before = clock(), state
        if coder.settings.bitrate:
            start = QUALITY_DEFAULT if quality is None else quality
            coded, state, quality = code_at_rate(coder, state, group, (writer.frames, writer.bytes, start))
            report.quality = quality
        else:
            importance = coder.measure(group, writer.frames)
            if quality is None and coder.has_pictures(group):
                quality = choose_quality(coder, group, importance, writer.frames)
                report.chosen_quality = quality is not None
            report.quality = QUALITY_DEFAULT if quality is None else quality
            coded, state = coder.code(state, group, importance, report.quality, writer.frames)
        report.loss = coder.settings.loss
        report.seconds["code"] += clock() - mark
        _check(coded, before, writer)
        kept = {} if quality is None else {"quality": np.array(quality)}
        kept |= state.to_arrays() if state else {}
        writer.append(coded.payload, len(group), sync=coded.independent, state=kept)
        _account(report, writer, coded, group)
        if on_group:
            on_group(report)
        mark = clock()


def _check(coded: CodedGroup, before: CoderState | None, writer: StreamWriter) -> None:
    """Decodes a group as a decoder of the level of the stream does.

    Raises:
        LimitError: the group exceeds a cap of the level.
    """
    reference = None if coded.independent else before.decoded
    try:
        _native.DecodedGroup(coded.payload, writer.config["level"], reference=reference)
    except LimitError as e:
        raise LimitError(f"group {writer.groups}: {e}; use shorter groups (--gop) or a lower --quality") from None


def _account(report: EncodeReport, writer: StreamWriter, coded: CodedGroup, group: ParametricGroup) -> None:
    report.group_list.append(
        {
            "frame": writer.frames - len(group),
            "frames": len(group),
            "bytes": len(coded.payload),
            "predicted": not coded.independent,
            "ended": group.ended,
        }
    )
    report.frames, report.groups, report.bytes = writer.frames, writer.groups, writer.bytes
    report.gaussians = max(report.gaussians, coded.gaussians)
    report.predicted += not coded.independent
    for u in coded.units:
        name = u["type"] if not u.get("attribute") else f"{u['type']} {u['attribute']}"
        report.units[name] = report.units.get(name, 0) + u["bytes"]
