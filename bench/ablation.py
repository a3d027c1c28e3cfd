"""Ablation: captures are trained without one loss or tool at a time.

lumberjack is the bundled capture, a subject with masks; stage and basketball (in the data folder, at half their size)
are full rooms, and a ball drops into one of them; the others are stress cases, with their budget.
bench/results/ablation.json has one entry per capture and variant, all of the same preset and, if the variant names no
seed, of seed 0. Seeds show which differences are chance; there are more seeds where nodes alone come close. `psnr` is
that of the model before coding, `psnr_coded` that of the decoded stream; both are measured on the test cameras, of the
subject if there are masks. A variant is a change of the training settings, so any caller of the training can repeat an
entry. The exception is V3's recipe (`baselines/v3.py`), which has a hash grid for each frame and a packing of its own.
Motion models are compared at equal time and bytes: a variant that is faster or slower than the whole recipe is trained
again with more or fewer steps per frame, and coded at three qualities (`curve`). `psnr_at_bytes` is the PSNR of this
curve at the bytes of the whole recipe.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np

from gscodec.capture import Capture
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import UsageError
from gscodec.model.gaussians import Gaussians
from gscodec.train.settings import MOTIONS, TrackingSettings, TrainSettings, train_settings

from . import train
from .machine import ROOT, update_entries
from .stress import budget_of
from .stress_scenes import CASES as STRESS
from .stress_scenes import drawn

WHOLE = "whole recipe"
LUMBERJACK, STAGE, BASKETBALL, FAST, FEW = "lumberjack", "stage", "basketball", "fast motion", "4 cameras"
FRAMES = {LUMBERJACK: (0, 10), STAGE: (7, 15), BASKETBALL: (0, 8), FAST: (0, 12), FEW: (0, 30)}  # the ball comes at 10
EQUAL = 0.05  # largest relative difference of equal times
SEEDS = {
    1: tuple(FRAMES),
    2: (LUMBERJACK, FAST, FEW),
    **dict.fromkeys((3, 4, 5), (LUMBERJACK,)),
}  # seed -> captures, besides seed 0
RUNS = 3  # runs, at most, until times are equal; the run with the nearest time counts
CURVE = (-5.0, 5.0)  # further qualities, relative to the requested one


@dataclass(frozen=True)
class Trained:
    """A sequence that a recipe has trained.

    Attributes:
        models: Gaussians of each frame.
        groups: number of frames in each group.
        seconds: time of training.
        code: quality -> bytes of the stream, decoded frames.
    """

    models: list[Gaussians]
    groups: list[int]
    seconds: float
    code: Callable[[float], tuple[int, list[Gaussians]]]


def ours(capture: Capture, settings: TrainSettings) -> Trained:
    """gscodec's training and coding."""
    groups, seconds = train.sequence(capture, settings)
    code = lambda quality: train.coded(capture, groups, settings, EncodeSettings(quality))[:2]  # noqa: E731
    return Trained(train.shown(groups), [len(g) for g in groups], sum(seconds), code)


def v3(capture: Capture, settings: TrainSettings) -> Trained:
    """V3's training and coding, with the steps per frame of the settings."""
    from .baselines.v3 import train_v3

    steps, start = (settings.motion_steps, settings.finetune_steps), time.perf_counter()
    models = train_v3(capture, range(capture.frame_count), settings, steps)
    return Trained(models, [len(models)], time.perf_counter() - start, lambda _: train.v3_coded(models))


@dataclass(frozen=True)
class Variant:
    """A change of the settings.

    Attributes:
        captures: captures that use the removed loss or tool.
        equal: compared at equal time and bytes: the steps per frame are scaled until training takes as long as the
            whole recipe, and the stream is coded at `CURVE`, too.
        recipe: function that trains and codes.
    """

    change: Callable[[TrainSettings], TrainSettings]
    captures: tuple[str, ...] = (LUMBERJACK, STAGE)
    equal: bool = False
    recipe: Callable[[Capture, TrainSettings], Trained] = ours


def run_with(**values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of the whole run."""
    return lambda settings: replace(settings, **values)


def stage_with(stage: str, **values) -> Callable[[TrainSettings], TrainSettings]:
    """Other values of the settings of one stage."""
    return lambda settings: replace(settings, **{stage: replace(getattr(settings, stage), **values)})


def all_of(*changes: Callable[[TrainSettings], TrainSettings]) -> Callable[[TrainSettings], TrainSettings]:
    """Several changes, one after the other."""
    return lambda settings: reduce(lambda s, change: change(s), changes, settings)


def by_seeds(name: str, **values) -> dict[str, Variant]:
    """A variant for each of `SEEDS`, with other values of the settings of the whole run."""
    return {
        f"{name}seed {seed}": Variant(run_with(seed=seed, **values), captures, equal=True)
        for seed, captures in SEEDS.items()
    }


TRACKING, FIELD = TrackingSettings(), MOTIONS["field"]
VARIANTS = {
    WHOLE: Variant(run_with(), tuple(FRAMES)),
    **by_seeds(""),
    "no D-SSIM": Variant(run_with(ssim_lambda=0.0)),
    "no mask term": Variant(run_with(mask_lambda=0.0), (LUMBERJACK,)),
    "no rigidity": Variant(run_with(rigidity=0.0)),
    "nodes alone": Variant(run_with(motion_field=MOTIONS["nodes"]), tuple(FRAMES), equal=True),
    **by_seeds("nodes alone ", motion_field=MOTIONS["nodes"]),
    "field alone": Variant(  # nodes have no variables of their own; the field learns as fast as after a search
        all_of(
            stage_with("finetune", node_rotation_rate=0.0, node_translation_rate=0.0),
            stage_with("tracking", node_rotation_rate=0.0, node_translation_rate=0.0),
            run_with(motion_field=FIELD.faster(FIELD.searched_rates)),
        ),
        tuple(FRAMES),
        equal=True,
    ),
    "V3's grid": Variant(  # steps of motion and of fine-tuning in the proportion of its public code
        run_with(motion_steps=100, finetune_steps=250), tuple(FRAMES), equal=True, recipe=v3
    ),
    "harmonics stay in the world": Variant(run_with(turned_harmonics=False), tuple(FRAMES)),
    "no rate term": Variant(run_with(rate_lambda=0.0)),
    "no fine-tuning": Variant(run_with(finetune_steps=0)),
    "no cuts": Variant(all_of(run_with(cut_ratio=math.inf), stage_with("group", drift_ratio=math.inf)), (FAST,)),
    "no search": Variant(stage_with("motion_search", ratio=math.inf, jump_ratio=math.inf), (FAST,)),
    "first rounds not stiff": Variant(stage_with("tracking", stiff_rigidity=1.0), (FAST,)),
    "colours held in tracking": Variant(stage_with("tracking", rates=TRACKING.rates.but(sh0=0.0, shN=0.0))),
    "full-size pictures only": Variant(stage_with("tracking", small_scale=1.0)),
    "nothing held still": Variant(stage_with("change_detection", threshold=-1.0)),
    "no noise on canonical values": Variant(stage_with("finetune", canonical_noise=False)),
    "no births": Variant(stage_with("densification", max_share=0.0), (STAGE,)),
    "no matched features": Variant(stage_with("initialization", triangulate=False), (STAGE,)),
    "no plane sweep": Variant(stage_with("initialization", use_plane_sweep=False), (STAGE,)),
    "no shell of far points": Variant(stage_with("far_shell", points=0), (STAGE,)),
    "no node graph": Variant(  # every Gaussian moves on its own, at the learning rate of a node
        stage_with(
            "tracking",
            node_rotation_rate=0.0,
            node_translation_rate=0.0,
            rates=TRACKING.rates.but(means=TRACKING.node_translation_rate),
        )
    ),
}


def run(
    captures: Iterable[str], names: Sequence[str] | None, preset: str, quality: float, data: Path | None, out: Path
) -> Iterator[dict]:
    """Yields the entries of each capture and puts them into the result file `out` as they come.

    Args:
        names: variants; None: all that use the capture. The whole recipe is measured first, if one is compared at equal
            time and bytes.

    Raises:
        UsageError: a capture is not in the data folder.
    """
    for capture in captures:
        opened = _open(capture, data)
        chosen = names or [n for n, v in VARIANTS.items() if capture in v.captures]
        settings = train_settings(preset, quality=quality, **(budget_of(capture) if capture in STRESS else {}))
        entries = ({"capture": capture, "preset": preset, **entry} for entry in _entries(opened, chosen, settings))
        yield from update_entries(out, entries, lambda e: [e["capture"], e["variant"], e["preset"]])


def _open(capture: str, data: Path | None) -> Capture:
    from gscodec.capture import open_capture

    first, end = FRAMES[capture]
    if capture == LUMBERJACK:
        return open_capture(ROOT / "examples" / "lumberjack").frames(first, end)
    if capture in STRESS:
        return drawn(STRESS[capture].capture(end))
    if data is None:
        raise UsageError(f"--capture {capture} needs the data folder, expected --data or GSCODEC_DATA")
    return train.CASES[capture].open(data).frames(first, end).scaled(0.5)


def _entries(capture: Capture, names: Sequence[str], settings: TrainSettings) -> Iterator[dict]:
    whole, kb = None, None  # seconds and bytes of the whole recipe
    if any(VARIANTS[name].equal for name in names):
        names = [WHOLE, *(name for name in names if name != WHOLE)]
    for name in names:
        variant = VARIANTS[name]
        changed, trained = _trained(capture, variant, variant.change(settings), whole if variant.equal else None)
        entry = {"variant": name, **_measured(capture, trained, changed, settings.quality)}
        if name == WHOLE:
            whole, kb = trained.seconds, entry["kb_per_frame"]
        elif variant.equal and variant.recipe is ours:
            entry |= _at_bytes(capture, trained, settings.quality, entry, kb)
        yield entry


def _trained(
    capture: Capture, variant: Variant, settings: TrainSettings, seconds: float | None
) -> tuple[TrainSettings, Trained]:
    """Trains with the settings; of several runs with more or fewer steps per frame, returns the one that takes about
    `seconds`. The keyframe's time does not depend on these steps: from the second run on, the last two runs give the
    time per step and of the keyframe."""
    runs, factor, before, earlier = [], 1.0, 0.0, 0.0
    while len(runs) < RUNS:
        scaled = _with_steps(settings, factor)
        trained = variant.recipe(capture, scaled)
        took = trained.seconds
        if seconds is None or abs(took / seconds - 1) <= EQUAL:
            return scaled, trained
        runs.append((scaled, trained))
        slope = (took - earlier) / (factor - before)
        wanted = factor + (seconds - took) / (slope if slope > 0 else took / factor)
        before, earlier, factor = factor, took, min(max(wanted, factor / 4), 4 * factor)
    return min(runs, key=lambda run: abs(run[1].seconds - seconds))


def _with_steps(settings: TrainSettings, factor: float) -> TrainSettings:
    """The settings with `factor` times the steps per frame."""
    steps = {name: round(factor * getattr(settings, name)) for name in ("motion_steps", "finetune_steps")}
    return replace(settings, **steps)


def _measured(capture: Capture, trained: Trained, settings: TrainSettings, quality: float) -> dict:
    size, decoded = trained.code(quality)
    model, stream = (train.evaluate(capture, frames) for frames in (trained.models, decoded))
    return {
        "quality": quality,
        "frames": len(decoded),
        "psnr": _psnr(model),
        "psnr_coded": _psnr(stream),
        "kb_per_frame": size / 1000 / len(decoded),
        "haze": stream["haze"],
        "flicker": stream["flicker"],
        "gaussians": model["gaussians"],
        "groups": trained.groups,
        "steps": [settings.motion_steps, settings.finetune_steps],
        "seconds_per_frame": round(trained.seconds / len(decoded), 2),
    }


def _at_bytes(capture: Capture, trained: Trained, quality: float, entry: dict, kb: float) -> dict:
    """kB/frame and PSNR of `entry` and at the qualities of `CURVE`, and the PSNR at `kb`: linear in the logarithm of
    bytes, also beyond the ends."""
    curve = [(entry["kb_per_frame"], entry["psnr_coded"])]
    for step in CURVE:
        size, decoded = trained.code(quality + step)
        curve.append((size / 1000 / len(decoded), _psnr(train.evaluate(capture, decoded))))
    curve.sort()
    rates, psnr = np.log([r for r, _ in curve]), [p for _, p in curve]
    i = int(np.clip(np.searchsorted(rates, math.log(kb)) - 1, 0, len(rates) - 2))
    slope = (psnr[i + 1] - psnr[i]) / (rates[i + 1] - rates[i])
    return {"curve": curve, "psnr_at_bytes": psnr[i] + slope * (math.log(kb) - rates[i])}


def _psnr(result: dict) -> float:
    return result["psnr_fg"] or result["psnr"]
