"""What each loss and tool of the training is worth: the bundled capture, trained without one of them at a time.

One entry of bench/results/ablation.json per variant, all from the same seed and preset. `psnr_fg` is of the model
before coding, `psnr_fg_coded` decoded from the stream, both on the test cameras. What has no setting of its own is
taken out of the module that has it, by name, so that a variant whose tool is gone fails.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

from gscodec.bench import train
from gscodec.bench.machine import ROOT, update_entries
from gscodec.train import changes, finetune, motion

WHOLE = "whole recipe"
FRAMES = 10


@dataclass(frozen=True)
class Variant:
    """Changes to the settings, and (object, name, value) of what has none."""

    settings: dict = field(default_factory=dict)
    patches: tuple[tuple[object, str, object], ...] = ()


def without(rates: dict[str, float], *names: str) -> dict[str, float]:
    """Learning rates of what is still learned."""
    return {n: r for n, r in rates.items() if n not in names}


VARIANTS = {
    WHOLE: Variant(),
    "no D-SSIM": Variant({"ssim_lambda": 0.0}),
    "no mask term": Variant({"mask_lambda": 0.0}),
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
    "no node graph": Variant(  # every Gaussian for itself, at the rate of a node
        patches=((motion, "MOVE_RATE", 0.0), (motion, "TURN_RATE", 0.0), (motion, "MEANS_RATE", motion.MOVE_RATE))
    ),
}


def measure(names: list[str], preset: str, quality: float, out: Path) -> Iterator[dict]:
    """Entries of the variants `names`, which also go into the result file `out` as they come."""
    return update_entries(out, (_entry(name, preset, quality) for name in names), lambda e: [e["variant"], e["preset"]])


def _entry(name: str, preset: str, quality: float) -> dict:
    from gscodec.capture import open_capture
    from gscodec.train.settings import train_settings

    variant = VARIANTS[name]
    capture = open_capture(ROOT / "examples" / "lumberjack").frames(0, FRAMES)
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
        "frames": FRAMES,
        "psnr_fg": model["psnr_fg"],
        "psnr_fg_coded": stream["psnr_fg"],
        "kb_per_frame": size / 1000 / FRAMES,
        "haze": stream["haze"],
        "flicker": stream["flicker"],
        "gaussians": model["gaussians"],
        "groups": [len(g) for g in groups],
        "seconds_per_frame": round(seconds / FRAMES, 2),
    }
