"""GaussianSequence -> .gsv: the loop over groups, with progress, interruption and resume.

Groups come one at a time from `groups` (a trainer yields them as they are done), are turned to integers, to bytes, and
appended. Nothing of an earlier group is needed, so a run that stops goes on where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gscodec import _native
from gscodec.bitstream.levels import smallest_level
from gscodec.camera import Camera
from gscodec.encode.group import group_integers
from gscodec.encode.writer import StreamWriter
from gscodec.errors import UsageError
from gscodec.gaussians import Group


@dataclass(frozen=True)
class EncodeSettings:
    """What the encoder is asked for.

    Attributes:
        quality: 0 (small) to 100 (fine); 50 is about 41 dB against the input.
        keep_all: also code Gaussians that are never visible.
    """

    quality: float = 50.0
    keep_all: bool = False

    def __post_init__(self):
        if not 0 <= self.quality <= 100:
            raise UsageError(f"--quality {self.quality:g} is out of range, expected 0 (small) to 100 (fine)")


@dataclass
class EncodeReport:
    """What came out: `bytes` of the file, `units` with their bytes, `seconds` in each stage."""

    frames: int = 0
    groups: int = 0
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
    on_group: Callable[[EncodeReport], None] | None = None,
) -> EncodeReport:
    """Writes `out` from the groups that `groups(done, frames)` yields: those after the `done` groups, `frames` frames,
    that an earlier run left in the file.

    Ctrl-C finishes the file with the groups done and returns with `interrupted` set; the next run goes on.
    """
    writer = StreamWriter(out, config, fingerprint)
    report = EncodeReport(seconds={"input": 0.0, "quantize": 0.0, "entropy": 0.0})
    cameras = [
        Camera(c["name"], np.array(c["K"]), np.array(c["viewmat"]), c["width"], c["height"]) for c in config["cameras"]
    ]
    clock = time.perf_counter
    try:
        mark = clock()
        for group in groups(writer.groups, writer.frames):
            report.seconds["input"] += clock() - mark
            mark = clock()
            integers = group_integers(group, settings.quality, keep_all=settings.keep_all, cameras=cameras)
            report.seconds["quantize"] += clock() - mark
            mark = clock()
            payload, units = _native.encode_group(integers)
            report.seconds["entropy"] += clock() - mark
            writer.append(payload, len(group))
            _account(report, writer, len(integers["positions"]), units)
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


def _account(report: EncodeReport, writer: StreamWriter, count: int, units: list[dict]) -> None:
    report.frames, report.groups, report.bytes = writer.frames, writer.groups, writer.bytes
    report.gaussians = max(report.gaussians, count)
    for u in units:
        name = u["type"] if not u.get("attribute") else f"{u['type']} {u['attribute']}"
        report.units[name] = report.units.get(name, 0) + u["bytes"]
