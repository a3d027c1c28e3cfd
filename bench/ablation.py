"""What each loss and tool of the training is worth: two captures, trained without one of them at a time.

lumberjack is the bundled capture, a subject with masks; stage (of the data folder, at half its size) a full room while
a ball drops into it. One entry of bench/results/ablation.json per capture and variant, all from the same seed and
preset. `psnr` is of the model before coding, `psnr_coded` decoded from the stream, both on the test cameras, of the
subject where there are masks. A variant is a change of the training settings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from bench import train
from bench.machine import ROOT, update_entries
from gscodec.capture import Capture
from gscodec.errors import UsageError
from gscodec.train.settings import TrackingSettings, TrainSettings

WHOLE = "whole recipe"
LUMBERJACK, STAGE = "lumberjack", "stage"
FRAMES = {LUMBERJACK: (0, 10), STAGE: (7, 15)}  # the ball comes at 10


@dataclass(frozen=True)
class Variant:
    """A change of the settings, and the captures that use what it takes away."""

    change: Callable[[TrainSettings], TrainSettings]
    captures: tuple[str, ...] = (LUMBERJACK, STAGE)


def top(**values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of the whole run."""
    return lambda settings: replace(settings, **values)


def stage(name: str, **values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of stage `name`."""
    return lambda settings: replace(settings, **{name: replace(getattr(settings, name), **values)})


TRACKING = TrackingSettings()
VARIANTS = {
    WHOLE: Variant(top()),
    "no D-SSIM": Variant(top(ssim_lambda=0.0)),
    "no mask term": Variant(top(mask_lambda=0.0), (LUMBERJACK,)),
    "no rigidity": Variant(top(rigidity=0.0)),
    "no rate term": Variant(top(rate_lambda=0.0)),
    "no fine-tuning": Variant(top(finetune_steps=0)),
    "no cuts": Variant(top(cut_ratio=math.inf)),
    "cut ratio 1.5": Variant(top(cut_ratio=1.5)),
    "cut ratio 3": Variant(top(cut_ratio=3.0)),
    "colours held in tracking": Variant(stage("tracking", rates=replace(TRACKING.rates, sh0=0.0, shN=0.0))),
    "full-size pictures only": Variant(stage("tracking", small_scale=1.0)),
    "nothing held still": Variant(stage("change_detection", threshold=-1.0)),
    "no noise on canonical values": Variant(stage("finetune", canonical_noise=False)),
    "no births": Variant(stage("densification", max_share=0.0), (STAGE,)),
    "no plane sweep": Variant(stage("initialization", use_plane_sweep=False), (STAGE,)),
    "no shell of far points": Variant(stage("plane_sweep", shell_points=0), (STAGE,)),
    "no node graph": Variant(  # every Gaussian for itself, at the rate of a node
        stage(
            "tracking",
            node_rotation_rate=0.0,
            node_translation_rate=0.0,
            rates=replace(TRACKING.rates, means=TRACKING.node_translation_rate),
        )
    ),
}


def measure(
    capture: str, names: list[str] | None, preset: str, quality: float, data: Path | None, out: Path
) -> Iterator[dict]:
    """Entries of the variants `names` (None: all that `capture` uses), which also go into the result file `out`.

    Raises:
        UsageError: the capture is not in the data folder.
    """
    found = _open(capture, data)
    chosen = names or [n for n, v in VARIANTS.items() if capture in v.captures]
    entries = ({"capture": capture, **_entry(found, name, preset, quality)} for name in chosen)
    return update_entries(out, entries, lambda e: [e["capture"], e["variant"], e["preset"]])


def _open(capture: str, data: Path | None) -> Capture:
    from gscodec.capture import open_capture

    if capture == LUMBERJACK:
        return open_capture(ROOT / "examples" / "lumberjack").frames(*FRAMES[capture])
    if data is None:
        raise UsageError(f"--capture {capture} needs the data folder, expected --data or GSCODEC_DATA")
    return train.CASES[capture].open(data).frames(*FRAMES[capture]).scaled(0.5)


def _entry(capture: Capture, name: str, preset: str, quality: float) -> dict:
    from gscodec.train.settings import train_settings

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
