"""Stress test: each case of stress_scenes.py, trained as a sequence and with frames alone, both coded and decoded.

bench/results/stress.json has one entry per case. PSNR is that of the subject on the test cameras, over the frames that
show it, of decoded streams; these are coded as by `gscodec encode` without a quality. The frames alone have the
Gaussians of the preset, and enough steps that twice as many gain less than `CONVERGED_DB`. `lost` is their PSNR minus
that of the sequence. `verdict` is "fails" on
  - a crash, a value that is not finite, or more Gaussians than the budget allows,
  - a mean PSNR below the floor of the case, or a frame more than `FRAME_DB` below the floor,
  - `lost` above `ALLOWED_DB` in the mean, or above `ALLOWED_FRAME_DB` in a frame,
  - more than `STATIC_SHARE` of the bytes of the frames alone where nothing moves.
If every frame is a keyframe, the sequence equals frames alone: the verdict then says "equal by identity".
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.capture import Capture
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import UsageError
from gscodec.model.gaussians import Gaussians
from gscodec.train.settings import coding_loss, train_settings

from . import train
from .machine import update_entries
from .stress_scenes import CASES, Stress, drawn

PRESET = "fast"
BUDGET = {"gaussians_max": 3750, "initial_points": 2000}  # for pictures of 128 x 128
BUDGETS = {  # case -> changes of the budget
    "300 frames": {
        "keyframe_steps": 250,
        "motion_steps": 20,
        "finetune_steps": 15,
        "gaussians_max": 1250,
        "initial_points": 700,
    },
    "real room": {"gaussians_max": 20_000, "initial_points": 10_000},
}
ALONE_MOST = 12  # frames of a case, at most, that are trained alone: all frames of a short case
FACTORS = (1, 2, 4, 8)  # on the steps of a frame alone, until it has converged
CONVERGED_DB = 0.1
ALLOWED_DB, ALLOWED_FRAME_DB = 1.0, 2.5
FRAME_DB = 3.0
STATIC_SHARE = 0.2


def measure(names: list[str], out: Path, frames: int | None = None) -> Iterator[dict]:
    """Entries of the cases `names`, which also go into the result file `out` as they come.

    Args:
        frames: largest number of frames of each case; None: all.
    """
    return update_entries(out, (_entry(name, CASES[name], frames) for name in names), lambda e: e["case"])


def budget_of(case: str) -> dict:
    """Changes of the training settings with which a case is trained."""
    return BUDGET | BUDGETS.get(case, {})


def _entry(name: str, case: Stress, frames: int | None) -> dict:
    head = {"case": name, "frames": min(case.frames, frames or case.frames), "floor": case.floor, "why": case.why}
    try:
        capture = case.capture(head["frames"])
        found = compare(capture, **budget_of(name))
    except UsageError:
        raise  # the data is not there
    except Exception as e:  # a crash is a result
        at = traceback.extract_tb(e.__traceback__)[-1]
        return head | {"verdict": f"fails: {type(e).__name__} in {Path(at.filename).name}:{at.lineno}: {e}"}
    return head | found | {"verdict": verdict(found, case)}


def verdict(found: dict, case: Stress) -> str:
    """ "holds", or "fails: " with the first reason, of the results of `compare`."""
    if not found["finite"]:
        return "fails: values that are not finite"
    if found["gaussians_most"] > found["gaussians_allowed"]:
        return f"fails: {found['gaussians_most']} Gaussians"
    mean, worst = found["psnr_fg"], found["psnr_fg_worst"]
    if mean is not None and mean < case.floor:
        return f"fails: {mean:.2f} dB, at least {case.floor:g} expected"
    if worst is not None and worst < case.floor - FRAME_DB:
        return f"fails: {worst:.2f} dB in a frame, at least {case.floor - FRAME_DB:g} expected"
    share = found["kb_per_frame"] / found["kb_per_frame_alone"]
    if case.still and share > STATIC_SHARE:
        return f"fails: {share:.0%} of the bytes of every frame alone, {STATIC_SHARE:.0%} allowed where nothing moves"
    if found["lost"] is not None and found["lost"] > ALLOWED_DB:
        return f"fails: {found['lost']:.2f} dB below every frame alone, {ALLOWED_DB:g} allowed"
    if found["lost_most"] is not None and found["lost_most"] > ALLOWED_FRAME_DB:
        return f"fails: {found['lost_most']:.2f} dB below a frame alone, {ALLOWED_FRAME_DB:g} allowed"
    return "holds, equal by identity: every frame is a keyframe" if found["identity"] else "holds"


def compare(capture: Capture, **budget) -> dict:
    """Results of one capture; `budget`: changes of the training settings."""
    settings, encoding = train_settings(PRESET, **budget), EncodeSettings(loss=coding_loss(PRESET, capture))
    groups, seconds = train.sequence(drawn(capture), settings)
    models = train.shown(groups)
    size, decoded, _, report = train.coded(capture, groups, settings, encoding)
    ours, trained = train.evaluate(capture, decoded), train.evaluate(capture, models)
    there = [t for t in range(capture.frame_count) if _subject(capture, t)]
    keyframes = sum(g.parents is None for g in groups)
    return {
        "psnr_fg": _mean(ours, there),
        "psnr_fg_worst": min((ours["per_frame"][t]["psnr_fg"] for t in there), default=None),
        "psnr_fg_uncoded": _mean(trained, there),
        "quality": report.quality,
        **_alone(capture, ours, there, settings, encoding),
        "haze": ours.get("haze"),
        "haze_most": max(r["haze"] for r in ours["per_frame"]),
        "flicker": ours["flicker"],
        "gaussians": ours["gaussians"],
        "gaussians_most": max(map(len, models)),
        "gaussians_allowed": settings.gaussians_max,
        "kb_per_frame": size / 1000 / len(models),
        "seconds_per_frame": sum(seconds) / len(models),
        "groups": [len(g) for g in groups],
        "keyframes": keyframes,
        "identity": keyframes == len(models),
        "finite": all(_finite(g) for g in models),
        "train_cameras": len(capture.indices("train")),
        "size": [capture.cameras[0].width, capture.cameras[0].height],
    }


def _alone(capture: Capture, ours: dict, there: list[int], settings, encoding: EncodeSettings) -> dict:
    """Results of frames alone, coded, and PSNR that the sequence (`ours`) has lost against them in frames `there`."""
    chosen = range(0, capture.frame_count, -(-capture.frame_count // ALONE_MOST))
    settings = _converged(capture, next((t for t in chosen if t in there), chosen[0]), settings)
    alone, seconds = train.every_frame_alone(capture, chosen, settings)
    part = train.part(capture, chosen)
    size, decoded, *_ = train.coded(part, alone, settings, encoding)
    theirs = train.evaluate(part, decoded)
    both = [(t, i) for i, t in enumerate(chosen) if t in there]
    lost = [theirs["per_frame"][i]["psnr_fg"] - ours["per_frame"][t]["psnr_fg"] for t, i in both]
    return {
        "psnr_fg_alone": _mean(theirs, [i for _, i in both]),
        "lost": float(np.mean(lost)) if lost else None,
        "lost_most": max(lost, default=None),
        "lost_of_frame": [round(x, 2) for x in lost],
        "haze_alone": theirs.get("haze"),
        "gaussians_alone": theirs["gaussians"],
        "steps_alone": settings.keyframe_steps,
        "kb_per_frame_alone": size / 1000 / len(alone),
        "seconds_per_frame_alone": seconds / len(alone),
    }


def _converged(capture: Capture, frame: int, settings):
    """The settings with the steps of a keyframe at which `frame` has converged on its training views."""
    from gscodec.metrics.evaluate import evaluate_capture

    part, best = train.part(capture, range(frame, frame + 1)), None
    settings = replace(settings, budget=replace(settings.budget, small_pixels=0.0))  # FACTORS alone sets the steps
    for factor in FACTORS:
        longer = replace(settings, keyframe_steps=factor * settings.keyframe_steps)
        (alone,), _ = train.every_frame_alone(capture, [frame], longer)
        reached = evaluate_capture(lambda _, g=alone.canonical: g, part, "train", with_vmaf=False)["psnr_fg"]
        if best is not None and (reached is None or reached < best[0] + CONVERGED_DB):
            break
        best = reached, longer
    return best[1]


def _subject(capture, t: int) -> bool:
    views = [capture.view(i, t) for i in capture.indices("test")]
    return any(v.alpha is None or v.alpha.any() for v in views)


def _mean(result: dict, frames: list[int]) -> float | None:
    rows = [result["per_frame"][t] for t in frames]
    return float(np.mean([r["psnr_fg"] for r in rows])) if rows else None


def _finite(g: Gaussians) -> bool:
    return all(np.isfinite(a).all() for a in vars(g).values())
