"""Ablation: two captures are trained without one loss or tool at a time.

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
from gscodec.errors import UsageError
from gscodec.train.settings import TrainSettings, train_settings

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


VARIANTS = {
    WHOLE: Variant(lambda s: s),
    "no D-SSIM": Variant(lambda s: replace(s, ssim_lambda=0.0)),
    "no mask term": Variant(lambda s: replace(s, mask_lambda=0.0), captures=(LUMBERJACK,)),
    "no rigidity": Variant(lambda s: replace(s, rigidity=0.0)),
    "no rate term": Variant(lambda s: replace(s, rate_lambda=0.0)),
    "no fine-tuning": Variant(lambda s: replace(s, finetune_steps=0)),
    "no cuts": Variant(lambda s: replace(s, cut_ratio=math.inf)),
    "cut ratio 1.5": Variant(lambda s: replace(s, cut_ratio=1.5)),
    "cut ratio 3": Variant(lambda s: replace(s, cut_ratio=3.0)),
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
    size, decoded, _ = train.coded(capture, groups, settings)
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
