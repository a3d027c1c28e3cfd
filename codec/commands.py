"""What the studio's commands do: the joints between stages, one function a command, no arithmetic.

encode: capture -> train -> encode, or splats -> encode        train: capture -> train -> .ply folder
eval:   stream + capture or splats -> metrics                       bench:  scenes -> figures
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from .atomic_write import part_file
from .encode.encode import REFINE, EncodeReport, EncodeSettings, encode_groups, stream_config
from .errors import UsageError, require
from .frame_range import frame_range
from .model.camera import Camera
from .model.gaussians import GaussianSequence, Group
from .progress import Bar

AXES = ("x", "y", "z")


def limit_torch_threads() -> None:
    """One thread for torch in this process: it handles small tensors, and would compete with the native kernels."""
    import torch

    torch.set_num_threads(1)


def encode_input(
    source: Path,
    out: Path,
    settings: EncodeSettings,
    *,
    preset: str,
    frames: str | None,
    gop: int,
    cluster: str | None = None,
    bar: Bar,
) -> EncodeReport:
    """Encodes a capture or splats at `source` into the file `out`. `cluster`: address of the Ray cluster that trains.

    Raises:
        UsageError, CaptureError: see the message.
    """
    from .splats import detect_input

    if gop < 1:
        raise UsageError(f"--gop {gop} is out of range, expected at least 1 frame in a group")
    out = Path(out)
    if out.suffix != ".gsv":
        raise UsageError(f"{out}: the output must be named *.gsv")
    kind = detect_input(source)
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "splats":
        if cluster:
            raise UsageError(f"--ray {cluster}: {source} holds splats, which need no training; leave --ray away")
        return _encode_splats(source, out, settings, frames, gop, bar)
    return _encode_capture(source, out, settings, preset, frames, gop, cluster, bar)


def _encode_splats(source, out, settings, frames, gop, bar) -> EncodeReport:
    require("scipy", "encoding")
    sequence = _restrict(_open_splats(source, gop, bar), frames)
    total = sequence.frame_count
    if settings.refine is None and total == 1:
        settings = replace(settings, refine=REFINE)
    cameras = sequence.cameras
    first = sequence.frame(0)
    longest = max(len(g) for g in sequence.groups)
    degree = max(g.frames[0].sh_degree for g in sequence.groups)
    config = stream_config(
        fps=sequence.fps,
        sh_degree=degree,
        gaussians=len(first),
        frames=longest,
        cameras=cameras,
        up=up_axis(cameras) if cameras else "-y",  # what 3DGS trainers leave when nothing is known
    )
    return encode_groups(
        lambda done, _: (sequence.groups[i] for i in range(done, len(sequence.groups))),
        out,
        config,
        settings,
        cameras=cameras,
        fingerprint={"input": str(source.resolve()), "frames": frames, "gop": gop, **asdict(settings)},
        on_group=lambda r: bar.update("encode", r.frames, total),
    )


def _open_splats(source: Path, gop: int, bar: Bar) -> GaussianSequence:
    from .splats import open_sequence

    sequence = open_sequence(source, gop=gop)
    words = {
        "tracked": "index i is the same Gaussian in every frame",
        "matched": "Gaussians were matched from frame to frame",
        "independent": "frames do not match each other, each is coded alone",
    }
    if sequence.frame_count > 1:
        bar.say(f"{source}: {sequence.mode} ({words.get(sequence.mode, 'as sequence.json says')})")
    return sequence


def _restrict(sequence: GaussianSequence, frames: str | None) -> GaussianSequence:
    """Frames A:B; groups that the range cuts become shorter."""
    chosen = frame_range(frames, sequence.frame_count)
    if len(chosen) == sequence.frame_count:
        return sequence
    groups, start = [], 0
    for g in sequence.groups:
        a, b = max(chosen[0] - start, 0), min(chosen[-1] + 1 - start, len(g))
        if a < b:
            life = g.lifetimes
            if life is not None:
                life = np.clip(life - a, 0, b - a)
            groups.append(Group(g.frames[a:b], life, parents=g.parents if groups else None))
        start += len(g)
    return sequence.with_groups(groups)


def _encode_capture(source, out, settings, preset, frames, gop, cluster, bar) -> EncodeReport:
    require("torch", "training a capture")
    limit_torch_threads()
    from .train.checkpoint import Checkpoint
    from .train.settings import train_settings
    from .train.train import train_groups

    capture = _open_capture(source, frames)
    recipe = train_settings(preset, gop=gop, quality=settings.quality)
    work = out.with_name(out.name + ".work")

    def groups(_, first_frame: int) -> Iterator[Group]:
        if cluster:
            from .train.ray_jobs import cluster_groups

            opened = partial(_open_capture, source.resolve(), frames)
            yield from cluster_groups(
                cluster,
                opened,
                recipe,
                settings.random_access,
                first_frame=first_frame,
                on_progress=lambda done: bar.update("train on the cluster", done, capture.frame_count),
            )
            return
        steps, start = [0, 1], first_frame

        def on_progress(p) -> None:
            steps[:] = p.done, p.total
            bar.update(p.stage, *steps)

        for group in train_groups(
            capture,
            recipe,
            first_frame=first_frame,
            random_access=settings.random_access,
            checkpoints=work,
            on_progress=on_progress,
        ):
            bar.update(f"code {start}-{start + len(group) - 1}", *steps)
            start += len(group)
            yield group

    config = stream_config(
        fps=capture.fps,
        sh_degree=recipe.sh_degree,
        gaussians=recipe.gaussians_max,
        frames=gop,
        cameras=capture.cameras,
        up=up_axis(capture.cameras),
    )
    report = encode_groups(
        groups,
        out,
        config,
        settings,
        capture=capture,
        fingerprint={"input": str(source.resolve()), "frames": frames, **asdict(recipe), **asdict(settings)},
    )
    if not report.interrupted:
        Checkpoint(work).clear()
    return report


def _open_capture(source: Path, frames: str | None):
    from .capture import open_capture

    capture = open_capture(source)
    if frames is None:
        return capture
    chosen = frame_range(frames, capture.frame_count)
    return capture.frames(chosen.start, chosen.stop)


def up_axis(cameras: list[Camera]) -> str:
    """The world axis that the cameras hold upwards, e.g. "z" or "-y"."""
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    i = int(np.abs(up).argmax())
    return ("-" if up[i] < 0 else "") + AXES[i]


def train_to_folder(
    source: Path,
    folder: Path,
    *,
    preset: str,
    frames: str | None,
    gop: int,
    random_access: int,
    quality: float,
    bar: Bar,
) -> int:
    """Trains a capture and writes one .ply per frame and sequence.json; returns the number of frames.

    What an earlier run with the same settings left unfinished goes on where it stopped.
    """
    require("torch", "training a capture")
    limit_torch_threads()
    from .splats import SequenceWriter
    from .train.checkpoint import Checkpoint
    from .train.settings import train_settings
    from .train.train import train_groups

    capture = _open_capture(source, frames)
    recipe = train_settings(preset, gop=gop, quality=quality)
    work, unfinished = folder / "work", folder / "unfinished.json"
    facts = {"input": str(source.resolve()), "frames": frames, "random_access": random_access}
    made_by = json.dumps(facts | asdict(recipe))
    same = unfinished.is_file() and unfinished.read_text() == made_by
    writer = SequenceWriter(folder, capture.fps, capture.cameras, resume=same)
    with part_file(unfinished) as part:
        part.write_text(made_by)
    groups = train_groups(
        capture,
        recipe,
        first_frame=writer.frame_count,
        random_access=random_access,
        checkpoints=work,
        on_progress=lambda p: bar.update(p.stage, p.done, p.total),
    )
    for group in groups:
        writer.add(group)
    unfinished.unlink()
    Checkpoint(work).clear()
    return writer.frame_count


def evaluate_stream(stream_path: Path, source: Path, *, split: str, frames: str | None, bar: Bar) -> dict:
    """Measures a .gsv file against the capture or the splats it came from (keys: README, "Measures").

    `prefixes` has the figures of its first layers.
    """
    from .decode import open_stream
    from .decode.report import describe
    from .metrics.evaluate import evaluate_capture, evaluate_splats
    from .splats import detect_input, open_sequence

    whole = open_stream(stream_path)
    on_progress = lambda done, total: bar.update("eval", done, total)  # noqa: E731
    splats = detect_input(source) == "splats"
    reference = open_sequence(source) if splats else _open_capture(source, None)
    chosen = frame_range(frames, min(whole.frame_count, reference.frame_count))

    def measure(stream, size: int) -> dict:
        options = {"size": size, "progress": on_progress}
        if splats:
            return evaluate_splats(stream.frame, reference, frames=chosen, **options)
        return evaluate_capture(stream.frame, reference.frames(chosen.start, chosen.stop), split=split, **options)

    result = measure(whole, whole.byte_count)
    later = [layer["bytes"] for layer in describe(whole)["layers"]][1:]
    if later:
        result["prefixes"] = []
    for k in range(len(later)):
        found = measure(open_stream(stream_path, layers=k + 1), whole.byte_count - sum(later[k:]))
        keys = ("bytes", "kb_per_frame", "gaussians", "psnr", "psnr_fg", "codec_psnr", "codec_psnr_fg")
        result["prefixes"].append({"layers": k + 1} | {name: found[name] for name in keys})
    return result


def bench_raster(
    scenes: str | None,
    simd: str | None,
    threads: str | None,
    *,
    repeats: int,
    data: Path | None,
    work: Path,
    out: Path | None,
) -> Iterator[dict]:
    """Yields what bench.raster measures (the lists are comma-separated, None: the usual ones), then writes it to `out`.

    Raises:
        UsageError: an unknown scene or instruction set, a number that is none, or torch is missing.
    """
    require("torch", "measuring training steps")
    limit_torch_threads()
    from bench.machine import write_result
    from bench.raster import SCENES, run

    from .render.workspace import simd_levels

    chosen = {
        "scenes": _names("--scenes", scenes, SCENES) or list(SCENES),
        "simd": _names("--simd", simd, simd_levels()),
        "threads": _names("--threads", threads, [str(n) for n in range(1, 257)]),
        "repeats": repeats,
    }
    chosen["threads"] = [int(n) for n in chosen["threads"]] if chosen["threads"] else None
    entries = []
    for entry in run(**chosen, data=data, work=work, say=lambda text: print(text, file=sys.stderr)):
        entries.append(entry)
        yield entry
    if out:
        settings = {**chosen, "simd": chosen["simd"] or simd_levels()}
        write_result(out, {"settings": settings, "entries": entries})


def bench_rd(codecs: str | None, sequences: str | None, *, data: Path | None, work: Path, out: Path) -> Iterator[dict]:
    """Yields what bench.rd measures (the lists are comma-separated, None: all), and puts it into `out` as it comes.

    Raises:
        UsageError: an unknown codec or sequence, or no data folder.
    """
    require("torch", "making sequences")
    limit_torch_threads()
    from bench.rd import CODECS, measure, update
    from bench.sequences import SEQUENCES

    if data is None:
        raise UsageError("bench rd needs the data folder, set --data or GSCODEC_DATA")
    for sequence in _names("--sequence", sequences, SEQUENCES) or SEQUENCES:
        for codec in _names("--codec", codecs, CODECS) or CODECS:
            try:
                yield from update(out, measure(sequence, codec, data, work))
            except UsageError as e:
                print(f"{sequence}, {codec}: left out, {e}", file=sys.stderr)


def bench_train(
    captures: str | None, recipes: str | None, *, preset: str, frames: str | None, quality: float, data, out: Path
) -> Iterator[dict]:
    """Yields what bench.train measures (the lists are comma-separated, None: all), and puts it into `out` as it comes.

    Raises:
        UsageError: an unknown capture or recipe, or no data folder.
    """
    require("torch", "measuring training")
    limit_torch_threads()
    from bench.train import CASES, RECIPES, measure, update

    if data is None:
        raise UsageError("bench train needs the data folder, set --data or GSCODEC_DATA")
    for capture in _names("--capture", captures, CASES) or CASES:
        for recipe in _names("--recipe", recipes, RECIPES) or RECIPES:
            yield from update(out, measure(capture, recipe, preset, frames, data, quality))


def bench_ablation(
    capture: str, variants: str | None, *, preset: str, quality: float, data: Path | None, out: Path
) -> Iterator[dict]:
    """Yields what bench.ablation measures on `capture` (comma-separated variants, None: all that it uses), and puts it
    into `out` as it comes.

    Raises:
        UsageError: an unknown capture or variant, or the capture is not in the data folder.
    """
    require("torch", "measuring training")
    limit_torch_threads()
    from bench.ablation import FRAMES, VARIANTS, measure

    names = _names("--variant", variants, VARIANTS)
    for name in _names("--capture", capture, FRAMES):
        yield from measure(name, names, preset, quality, data, out)


def bench_stress(cases: str | None, *, out: Path) -> Iterator[dict]:
    """Yields what bench.stress measures (comma-separated cases, None: all), and puts it into `out` as it comes.

    Raises:
        UsageError: an unknown case.
    """
    require("torch", "measuring training")
    limit_torch_threads()
    from bench.stress import measure
    from bench.stress_scenes import SCENES

    yield from measure(_names("--case", cases, SCENES) or list(SCENES), out)


def _names(option: str, text: str | None, known) -> list[str] | None:
    """ "a,b" -> ["a", "b"], all of them known; None stays None."""
    names = text.split(",") if text else None
    for name in names or []:
        if name not in known:
            raise UsageError(f"{option} {name} is not known here, expected some of {', '.join(known)}")
    return names
