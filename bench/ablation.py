"""Ablation: two captures are trained without one loss or tool at a time, and with other cut ratios.

lumberjack is the bundled capture, a subject with masks; stage (in the data folder, at half its size) is a full room
into which a ball drops. bench/results/ablation.json has one entry per capture and variant, all from the same seed and
preset. `psnr` is that of the model before coding, `psnr_coded` that of the decoded stream; both are measured on the
test cameras, of the subject where there are masks. A variant is a change of the training settings, so that each entry
can be repeated by any caller of the training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from gscodec.capture import Capture
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import UsageError
from gscodec.train.settings import MOTIONS, TrackingSettings, TrainSettings, train_settings

from . import train
from .machine import ROOT, update_entries

WHOLE = "whole recipe"
LUMBERJACK, STAGE = "lumberjack", "stage"
FRAMES = {LUMBERJACK: (0, 10), STAGE: (7, 15)}  # the ball comes at 10


@dataclass(frozen=True)
class Variant:
    """A change of the settings, and the captures that use what it takes away."""

    change: Callable[[TrainSettings], TrainSettings]
    captures: tuple[str, ...] = (LUMBERJACK, STAGE)


def run_with(**values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of the whole run."""
    return lambda settings: replace(settings, **values)


def stage_with(stage: str, **values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of one stage."""
    return lambda settings: replace(settings, **{stage: replace(getattr(settings, stage), **values)})


TRACKING = TrackingSettings()
VARIANTS = {
    WHOLE: Variant(run_with()),
    "no D-SSIM": Variant(run_with(ssim_lambda=0.0)),
    "no mask term": Variant(run_with(mask_lambda=0.0), (LUMBERJACK,)),
    "no rigidity": Variant(run_with(rigidity=0.0)),
    "nodes alone": Variant(run_with(motion_field=MOTIONS["nodes"])),
    "field alone": Variant(  # the nodes have no variables of their own
        lambda s: stage_with("finetune", node_rotation_rate=0.0, node_translation_rate=0.0)(
            stage_with("tracking", node_rotation_rate=0.0, node_translation_rate=0.0)(s)
        )
    ),
    "no rate term": Variant(run_with(rate_lambda=0.0)),
    "no fine-tuning": Variant(run_with(finetune_steps=0)),
    "no cuts": Variant(lambda s: stage_with("group", drift_ratio=math.inf)(replace(s, cut_ratio=math.inf))),
    "cut ratio 3": Variant(run_with(cut_ratio=3.0)),
    "colours held in tracking": Variant(stage_with("tracking", rates=TRACKING.rates.but(sh0=0.0, shN=0.0))),
    "full-size pictures only": Variant(stage_with("tracking", small_scale=1.0)),
    "nothing held still": Variant(stage_with("change_detection", threshold=-1.0)),
    "no noise on canonical values": Variant(stage_with("finetune", canonical_noise=False)),
    "no births": Variant(stage_with("densification", max_share=0.0), (STAGE,)),
    "no matched features": Variant(stage_with("initialization", triangulate=False), (STAGE,)),
    "no plane sweep": Variant(stage_with("initialization", use_plane_sweep=False), (STAGE,)),
    "no shell of far points": Variant(stage_with("plane_sweep", shell_points=0), (STAGE,)),
    "no node graph": Variant(  # every Gaussian for itself, at the rate of a node
        stage_with(
            "tracking",
            node_rotation_rate=0.0,
            node_translation_rate=0.0,
            rates=TRACKING.rates.but(means=TRACKING.node_translation_rate),
        )
    ),
}


def run(
    captures: Iterable[str], names: list[str] | None, preset: str, quality: float, data: Path | None, out: Path
) -> Iterator[dict]:
    """Yields the entries of each capture and puts them into the result file `out` as they come.

    Args:
        names: variants; None: all that use the capture.

    Raises:
        UsageError: a capture is not in the data folder.
    """
    for capture in captures:
        opened = _open(capture, data)
        chosen = names or [n for n, v in VARIANTS.items() if capture in v.captures]
        entries = ({"capture": capture, **_entry(opened, name, preset, quality)} for name in chosen)
        yield from update_entries(out, entries, lambda e: [e["capture"], e["variant"], e["preset"]])


def _open(capture: str, data: Path | None) -> Capture:
    from gscodec.capture import open_capture

    if capture == LUMBERJACK:
        return open_capture(ROOT / "examples" / "lumberjack").frames(*FRAMES[capture])
    if data is None:
        raise UsageError(f"--capture {capture} needs the data folder, expected --data or GSCODEC_DATA")
    return train.CASES[capture].open(data).frames(*FRAMES[capture]).scaled(0.5)


def _entry(capture: Capture, name: str, preset: str, quality: float) -> dict:
    variant = VARIANTS[name]
    settings = variant.change(train_settings(preset, quality=quality))
    groups, seconds = train.sequence(capture, settings)
    models = train.shown(groups)
    size, decoded, *_ = train.coded(capture, groups, settings, EncodeSettings(quality))
    model, stream = (train.evaluate(capture, frames) for frames in (models, decoded))
    return {
        "variant": name,
        "preset": preset,
        "quality": quality,
        "frames": len(models),
        "psnr": model["psnr_fg"] or model["psnr"],
        "psnr_coded": stream["psnr_fg"] or stream["psnr"],
        "kb_per_frame": size / 1000 / len(models),
        "haze": stream["haze"],
        "flicker": stream["flicker"],
        "gaussians": model["gaussians"],
        "groups": [len(g) for g in groups],
        "seconds_per_frame": round(seconds / len(models), 2),
    }
