"""What each loss and tool of the training is worth: two captures, trained without one of them at a time.

lumberjack is the bundled capture, a subject with masks; stage (of the data folder, at half its size) a full room while
a ball drops into it. One entry of bench/results/ablation.json per capture and variant, all from the same seed and
preset. `psnr` is of the model before coding, `psnr_coded` decoded from the stream, both on the test cameras, of the
subject where there are masks. What has no setting of its own is taken out of the module that has it, by name, so that
a variant whose tool is gone fails.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np

from gscodec.capture import Capture
from gscodec.errors import UsageError
from gscodec.train import change_detection as changes
from gscodec.train import finetune
from gscodec.train import tracking as motion
from gscodec.train import train as recipe

from . import train
from .machine import ROOT, update_entries

WHOLE = "whole recipe"
LUMBERJACK, STAGE = "lumberjack", "stage"
FRAMES = {LUMBERJACK: (0, 10), STAGE: (7, 15)}  # the ball comes at 10


@dataclass(frozen=True)
class Variant:
    """Changes to the settings, (object, name, value) of what has none, and the captures that use the tool."""

    settings: dict = field(default_factory=dict)
    patches: tuple[tuple[object, str, object], ...] = ()
    captures: tuple[str, ...] = (LUMBERJACK, STAGE)


def without(rates: dict[str, float], *names: str) -> dict[str, float]:
    """Learning rates of what is still learned."""
    return {n: r for n, r in rates.items() if n not in names}


NO_POINTS = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
VARIANTS = {
    WHOLE: Variant(),
    "no D-SSIM": Variant({"ssim_lambda": 0.0}),
    "no mask term": Variant({"mask_lambda": 0.0}, captures=(LUMBERJACK,)),
    "no rigidity": Variant({"rigidity": 0.0}),
    "no rate term": Variant({"rate_lambda": 0.0}),
    "no fine-tuning": Variant({"finetune_steps": 0}),
    "no cuts": Variant({"cut_ratio": math.inf}),
    "cut ratio 1.5": Variant({"cut_ratio": 1.5}),
    "cut ratio 3": Variant({"cut_ratio": 3.0}),
    "colours held in tracking": Variant(patches=((motion, "RATES", without(motion.RATES, "sh0", "shN")),)),
    "full-size pictures only": Variant(patches=((motion, "SMALL", 1.0),)),
    "nothing held still": Variant(patches=((changes, "THRESHOLD", -1.0),)),
    "no noise on canonical values": Variant(
        patches=((finetune.GroupModel, "_relaxed", lambda group, generator: group.key.params),)
    ),
    "no births": Variant(patches=((motion.Tracker, "bear", lambda *_: None),), captures=(STAGE,)),
    "no plane sweep": Variant(patches=((recipe, "sweep", lambda *_: NO_POINTS),), captures=(STAGE,)),
    "no shell of far points": Variant(patches=((recipe, "shell", lambda *_: NO_POINTS),), captures=(STAGE,)),
    "no node graph": Variant(  # every Gaussian for itself, at the rate of a node
        patches=((motion, "MOVE_RATE", 0.0), (motion, "TURN_RATE", 0.0), (motion, "MEANS_RATE", motion.MOVE_RATE))
    ),
}


def run(
    captures: Iterable[str], names: list[str] | None, preset: str, quality: float, data: Path | None, out: Path
) -> Iterator[dict]:
    """Yields what `measure` yields for each of `captures`."""
    for capture in captures:
        yield from measure(capture, names, preset, quality, data, out)


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
    settings = train_settings(preset, quality=quality, **variant.settings)
    with ExitStack() as stack:
        for where, attribute, value in variant.patches:
            stack.enter_context(patch.object(where, attribute, value))
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
