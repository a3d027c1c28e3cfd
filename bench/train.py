"""Quality against time and size of training: our presets, and every frame trained alone.

One entry of bench/results/train.json per (capture, recipe, preset): capture, recipe, preset, seconds_per_frame, psnr,
psnr_fg, ssim, gaussians, kb_per_frame, flicker, all on the test cameras. What gscodec trains is measured twice: before
coding ("model", no size) and decoded from the stream ("gscodec"). "alone" trains a keyframe for every frame it is asked
for, with the keyframe budget of the preset: what tracking is to be compared with. "v3" is V3's recipe at about the time
that our preset medium takes (baselines/v3.py). Both have no size of their own.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from gscodec.bench.machine import write_result
from gscodec.errors import UsageError

CAPTURES = ("lumberjack", "stage")
RECIPES = ("gscodec", "alone", "v3")
KEYS = ("psnr", "psnr_fg", "ssim", "gaussians", "kb_per_frame", "flicker")


def measure(capture_name: str, recipe: str, preset: str, frames: str | None, data: Path, quality: float) -> Iterator:
    """Entries of one recipe on one capture.

    Args:
        frames: "A:B" or "A:B:STEP", None: all.

    Raises:
        UsageError: the capture is not in the data folder.
    """
    from gscodec.capture import open_capture

    folder = Path(data) / capture_name
    if not folder.is_dir():
        raise UsageError(f"{folder} does not exist")
    capture = open_capture(folder)
    chosen = range(capture.frame_count)[slice(*(int(x) if x else None for x in (frames or ":").split(":")))]
    run = {"gscodec": _ours, "alone": _alone, "v3": _v3}[recipe]
    for name, seconds, size, result in run(capture, chosen, preset, quality):
        yield {
            "capture": capture_name,
            "recipe": name,
            "preset": preset,
            "quality": quality if name == "gscodec" else None,
            "frames": [chosen.start, chosen.stop, chosen.step],
            "seconds_per_frame": round(seconds / len(chosen), 2),
            **{k: result[k] for k in KEYS},
            "psnr_of_frame": [round(r["psnr_fg"], 2) for r in result["per_frame"]],
        } | {"kb_per_frame": size / 1000 / len(chosen) if size else None}


def _ours(capture, frames: range, preset: str, quality: float):
    import tempfile

    from gscodec.decode import open_stream
    from gscodec.encode.encode import EncodeSettings, encode_groups, stream_config
    from gscodec.train.settings import train_settings
    from gscodec.train.train import train_groups

    if frames.step != 1:
        raise UsageError("gscodec follows what moves: it needs every frame, expected a range without a step")
    part = _part(capture, frames)
    settings = train_settings(preset, quality=quality)
    kept, start = [], time.perf_counter()
    for group in train_groups(part, settings):
        kept.append(group)
    trained = time.perf_counter() - start
    yield "model", trained, None, _evaluate(part, [g for group in kept for g in group.frames])
    config = stream_config(fps=part.fps, sh_degree=0, gaussians=settings.gaussians_max, frames=settings.gop)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.gsv"
        start = time.perf_counter()
        cameras = [c for c in part.cameras if c.split == "train"]
        encode_groups(lambda *_: iter(kept), out, config, EncodeSettings(quality), fingerprint={}, cameras=cameras)
        coded = time.perf_counter() - start
        stream = open_stream(out)
        decoded = [stream.frame(t) for t in range(len(frames))]
        yield "gscodec", trained + coded, out.stat().st_size, _evaluate(part, decoded)


def _alone(capture, frames: range, preset: str, quality: float):
    import torch

    from gscodec.bitstream.quantization import subject_radius
    from gscodec.train.keyframe import train_keyframe
    from gscodec.train.settings import train_settings
    from gscodec.train.train import initial_model
    from gscodec.train.views import Views

    torch.set_num_threads(1)
    settings, models, start = train_settings(preset), [], time.perf_counter()
    for frame in frames:
        model = initial_model(capture, frame, settings)
        radius = subject_radius(model.params["means"].numpy())
        train_keyframe(model, Views(capture, 0), frame, settings, steps=settings.keyframe_steps, radius=radius)
        models.append(model.gaussians())
    yield "alone", time.perf_counter() - start, None, _evaluate(_part(capture, frames), models)


def _v3(capture, frames: range, preset: str, quality: float):
    from gscodec.bench.baselines.v3 import train_v3
    from gscodec.train.settings import train_settings

    part, start = _part(capture, frames), time.perf_counter()
    models = train_v3(part, range(len(frames)), train_settings(preset))
    yield "v3", time.perf_counter() - start, None, _evaluate(part, models)


def _part(capture, frames: range):
    """The capture with only these frames."""
    return replace(
        capture,
        first_frame=0,
        frame_count=len(frames),
        fps=capture.fps / frames.step,
        read=lambda camera, t: capture.read(camera, capture.first_frame + frames[t]),
    )


def _evaluate(capture, frames: list) -> dict:
    from gscodec.metrics.evaluate import evaluate_capture

    result = evaluate_capture(lambda t: frames[t], capture, "test", with_vmaf=False)
    return result | {"gaussians": int(np.mean([len(g) for g in frames]))}


def update(out: Path, entries: Iterator[dict]) -> Iterator[dict]:
    """Puts entries into the result file, in place of older ones of the same run, as they come."""
    key = lambda e: (e["capture"], e["recipe"], e["preset"], e["quality"], e["frames"])  # noqa: E731
    for entry in entries:
        old = json.loads(out.read_text())["entries"] if out.exists() else []
        write_result(out, {"entries": [e for e in old if key(e) != key(entry)] + [entry]})
        yield entry
