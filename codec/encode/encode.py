"""GaussianSequence -> .gsv: the loop over groups, with progress, interruption and resume.

Groups come one at a time from `groups` (a trainer yields them as they are done), are turned to integers, to bytes, and
appended. A run that stops goes on where it stopped, to the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..bitstream.levels import smallest_level
from ..capture import Capture
from ..errors import UsageError
from ..model.camera import Camera
from ..model.gaussians import Group
from .coder import CodedGroup, GroupCoder
from .rate_control import RateControl
from .writer import StreamWriter

LAYERS_MAX = 16  # spec 4
REFINE = 100  # views, of splats of one frame


@dataclass(frozen=True)
class EncodeSettings:
    """What the encoder is asked for.

    Attributes:
        quality: 0 (small) to 100 (fine); 50 is about 41 dB against the input.
        bitrate: bits per second that the whole file is to have, instead of one quality; None: `quality` it is.
        keep_all: also code Gaussians that are never visible.
        random_access: frames from one independent group to the next at most; the groups between are predicted from it
            where their parents are known and it is cheaper. 0 or 1: every group is independent.
        layers: layers of importance in each group, each with its own steps; any first few decode alone. None: what is
            smallest.
        refine: views by which each group is refined; 0: none is. None: each picture of the capture that it was
            trained on four times, at most 80 a frame; without one 10 drawn views a frame in groups of few Gaussians.
    """

    quality: float = 50.0
    bitrate: float | None = None
    keep_all: bool = False
    random_access: int = 60
    layers: int | None = None
    refine: int | None = None

    def __post_init__(self):
        if not 0 <= self.quality <= 100:
            raise UsageError(f"--quality {self.quality:g} is out of range, expected 0 (small) to 100 (fine)")
        if self.bitrate is not None and not self.bitrate > 0:
            raise UsageError(f"--bitrate {self.bitrate:g} is out of range, expected bits per second above 0")
        if self.random_access < 0:
            raise UsageError(f"--random-access {self.random_access} is out of range, expected 0 frames or more")
        if self.layers is not None and not 1 <= self.layers <= LAYERS_MAX:
            raise UsageError(f"--layers {self.layers} is out of range, expected 1 to {LAYERS_MAX}")
        if self.refine is not None and self.refine < 0:
            raise UsageError(f"--refine {self.refine} is out of range, expected 0 views or more")


@dataclass
class EncodeReport:
    """What came out: `bytes` of the file, `units` with their bytes, `seconds` in each stage."""

    frames: int = 0
    groups: int = 0
    predicted: int = 0  # of these, in this run
    bytes: int = 0
    gaussians: int = 0  # most in one group
    interrupted: bool = False
    seconds: dict = field(default_factory=dict)
    units: dict = field(default_factory=dict)

    def to_json(self) -> dict:
        """The report with the derived rates of DESIGN's measures."""
        frames = max(self.frames, 1)
        return {
            **self.__dict__,
            "kb_per_frame": self.bytes / frames / 1000,
            "bits_per_gaussian_frame": 8 * self.bytes / frames / max(self.gaussians, 1),
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
    """The config box: what a player must know before the first group.

    Args:
        gaussians, frames: about how many a group has; the level is the smallest with room for twice as many Gaussians.
    """
    return {
        "fps": fps,
        "level": smallest_level(gaussians=2 * gaussians, frames=frames),
        "metres_per_unit": 1.0,
        "up": up,
        "color_space": "srgb",
        "background": [float(b) for b in background],
        "sh_degree": sh_degree,
        "sh_frame": "world",
        "cameras": [
            {
                "name": c.name,
                "K": np.asarray(c.K, float).tolist(),
                "viewmat": np.asarray(c.viewmat, float).tolist(),
                "width": c.width,
                "height": c.height,
            }
            for c in cameras
        ],
    }


def encode_groups(
    groups: Callable[[int, int], Iterable[Group]],
    out: Path,
    config: dict,
    settings: EncodeSettings,
    *,
    fingerprint: dict,
    cameras: list[Camera] = (),
    capture: Capture | None = None,
    on_group: Callable[[EncodeReport], None] | None = None,
) -> EncodeReport:
    """Writes `out` from the groups that `groups(done, frames)` yields: those after the `done` groups, `frames` frames,
    that an earlier run left in the file.

    Args:
        cameras: of splats, if known; from those for training, too, it is measured what the Gaussians matter.
        capture: what the groups were trained on, frame by frame of the stream: its cameras count instead, and groups
            that have a calibration are refined by its pictures.

    Ctrl-C finishes the file with the groups done and returns with `interrupted` set; the next run goes on.
    """
    writer = StreamWriter(out, config, fingerprint)
    coder = GroupCoder(
        keep_all=settings.keep_all,
        layers=settings.layers,
        refine=settings.refine,
        random_access=settings.random_access,
        cameras=[c for c in (capture.cameras if capture else cameras) if c.split == "train"],
        capture=capture,
    )
    state = writer.state()
    coder.restore(state)
    quality = float(state.get("quality", settings.quality))
    rate = RateControl(settings.bitrate, config["fps"], quality) if settings.bitrate else None
    report = EncodeReport(seconds={"input": 0.0, "code": 0.0})
    clock = time.perf_counter
    try:
        mark = clock()
        for group in groups(writer.groups, writer.frames):
            report.seconds["input"] += clock() - mark
            mark = clock()
            if rate:
                coder, coded = rate.code(coder, group, writer.frames, writer.bytes)
            else:
                coded = coder.code(group, settings.quality, writer.frames)
            report.seconds["code"] += clock() - mark
            state = coder.state() | ({"quality": np.array(rate.quality)} if rate else {})
            writer.append(coded.payload, len(group), sync=coded.independent, state=state)
            _account(report, writer, coded)
            if on_group:
                on_group(report)
            mark = clock()
    except KeyboardInterrupt:
        report.interrupted = True
    except BaseException:
        writer.close()
        raise
    if writer.groups:
        writer.finish(keep_part=report.interrupted)
    report.frames, report.groups = writer.frames, writer.groups
    report.bytes = Path(out).stat().st_size if writer.groups else 0
    return report


def _account(report: EncodeReport, writer: StreamWriter, coded: CodedGroup) -> None:
    report.frames, report.groups, report.bytes = writer.frames, writer.groups, writer.bytes
    report.gaussians = max(report.gaussians, coded.gaussians)
    report.predicted += not coded.independent
    for u in coded.units:
        name = u["type"] if not u.get("attribute") else f"{u['type']} {u['attribute']}"
        report.units[name] = report.units.get(name, 0) + u["bytes"]
