"""Stress test of training: each case of stress_scenes.py, trained as a sequence and with every frame alone.

bench/results/stress.json has one entry per case. Both trainings have the keyframe budget of the preset, and both are
coded at the same quality. PSNR is that of the subject on the test cameras, over the frames that show it. `lost` is the
PSNR of the frames alone minus that of the sequence, before coding. `verdict` is "fails" on
  - a crash, a value that is not finite, or more Gaussians than the budget allows,
  - `lost` above `ALLOWED_DB`,
  - more than `STATIC_SHARE` of the bytes of the frames alone in the case without motion.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gscodec.encode.settings import EncodeSettings
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import ParametricGroup

from . import train
from .machine import update_entries
from .procedural import Scene
from .stress_scenes import SCENES

PRESET = "fast"
QUALITY = 50.0
BUDGET = {"gaussians_max": 3750, "initial_points": 2000}  # for pictures of 128 x 128
BUDGETS = {  # case -> changes of the budget
    "200 frames": {
        "keyframe_steps": 250,
        "motion_steps": 20,
        "finetune_steps": 15,
        "gaussians_max": 1250,
        "initial_points": 700,
    }
}
ALONE_MOST = 12  # frames of a case that are trained alone
ALLOWED_DB = 1.0
STATIC_SHARE = 0.2


def measure(names: list[str], out: Path) -> Iterator[dict]:
    """Entries of the cases `names`, which also go into the result file `out` as they come."""
    return update_entries(out, (_entry(name, SCENES[name]) for name in names), lambda e: e["case"])


def _entry(name: str, scene: Scene) -> dict:
    head = {"case": name, "frames": scene.frames, "train_cameras": scene.train, "size": scene.size}
    try:
        found = compare(name, scene, **BUDGETS.get(name, {}))
    except Exception as e:  # a crash is a result
        at = traceback.extract_tb(e.__traceback__)[-1]
        return head | {"verdict": f"fails: {type(e).__name__} in {Path(at.filename).name}:{at.lineno}: {e}"}
    return head | found | {"verdict": _verdict(name, found)}


def _verdict(name: str, found: dict) -> str:
    if not found["finite"]:
        return "fails: values that are not finite"
    if found["gaussians_most"] > BUDGET["gaussians_max"]:
        return f"fails: {found['gaussians_most']} Gaussians"
    share = found["kb_per_frame"] / found["kb_per_frame_alone"]
    if name == "static" and share > STATIC_SHARE:
        return f"fails: {share:.0%} of the bytes of every frame alone, {STATIC_SHARE:.0%} allowed where nothing moves"
    if found["lost"] is not None and found["lost"] > ALLOWED_DB:
        return f"fails: {found['lost']:.2f} dB below every frame alone, {ALLOWED_DB:g} allowed"
    return "holds"


def compare(name: str, scene: Scene, **budget) -> dict:
    """Results of one case; `budget`: changes of the training settings."""
    from gscodec.train.settings import train_settings

    settings = train_settings(PRESET, QUALITY, **(BUDGET | budget))
    capture = scene.capture(name)
    for camera in range(len(capture.cameras)):  # traced and cached here, so that training is timed without it
        for t in range(capture.frame_count):
            capture.view(camera, t)
    groups, seconds = train.sequence(capture, settings)
    models = train.shown(groups)
    ours = train.evaluate(capture, models)
    size, decoded, *_ = train.coded(capture, groups, settings, EncodeSettings(QUALITY))
    chosen = range(0, capture.frame_count, -(-capture.frame_count // ALONE_MOST))
    alone, alone_seconds = train.every_frame_alone(capture, chosen, settings)
    part = train.part(capture, chosen)
    theirs = train.evaluate(part, alone)
    alone_size, *_ = train.coded(part, [ParametricGroup(1, g) for g in alone], settings, EncodeSettings(QUALITY))
    there = [t for t in range(capture.frame_count) if _subject(capture, t)]
    both = [(t, i) for i, t in enumerate(chosen) if t in there]
    loss = [theirs["per_frame"][i]["psnr_fg"] - ours["per_frame"][t]["psnr_fg"] for t, i in both]
    return {
        "psnr_fg": _psnr(ours, there),
        "psnr_fg_alone": _psnr(theirs, [i for _, i in both]),
        "psnr_fg_coded": _psnr(train.evaluate(capture, decoded), there),
        "lost": float(np.mean(loss)) if loss else None,
        "lost_most": max(loss, default=None),
        "lost_of_frame": [round(x, 2) for x in loss],
        "haze": ours.get("haze"),
        "haze_most": max(r["haze"] for r in ours["per_frame"]),
        "haze_alone": theirs.get("haze"),
        "flicker": ours["flicker"],
        "flicker_alone": theirs["flicker"] if chosen.step == 1 else None,
        "gaussians": ours["gaussians"],
        "gaussians_most": max(map(len, models)),
        "gaussians_alone": theirs["gaussians"],
        "kb_per_frame": size / 1000 / len(models),
        "kb_per_frame_alone": alone_size / 1000 / len(alone),
        "seconds_per_frame": seconds / len(models),
        "seconds_per_frame_alone": alone_seconds / len(alone),
        "groups": [len(g) for g in groups],
        "keyframes": sum(g.parents is None for g in groups),
        "finite": all(_finite(g) for g in models),
    }


def _subject(capture, t: int) -> bool:
    views = [capture.view(i, t) for i in capture.indices("test")]
    return any(v.alpha is None or v.alpha.any() for v in views)


def _psnr(result: dict, frames: list[int]) -> float | None:
    rows = [result["per_frame"][t] for t in frames]
    return float(np.mean([r["psnr_fg"] for r in rows])) if rows else None


def _finite(g: Gaussians) -> bool:
    return all(np.isfinite(a).all() for a in vars(g).values())
