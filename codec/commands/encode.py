"""`gscodec encode`: capture -> train -> encode, or splats -> encode."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from ..errors import UsageError, require
from ..frame_range import frame_range
from ..model.camera import Camera
from ..model.gaussians import GOP, GaussianSequence, Group
from ..progress import Bar
from .inputs import open_frames
from .options import Frames, Gop, Preset, Quality, RandomAccess, SequencePath, StreamPath, stdout

if TYPE_CHECKING:
    from ..encode.encode import EncodeReport, EncodeSettings

AXES = ("x", "y", "z")


def encode(
    seq: SequencePath,
    out: StreamPath,
    quality: Quality = 50.0,
    bitrate: Annotated[
        str | None, typer.Option(metavar="RATE", help="Bits per second instead of a quality: 8M, 500k.")
    ] = None,
    preset: Preset = "medium",
    frames: Frames = None,
    gop: Gop = GOP,
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Keep Gaussians that nobody can see.")] = False,
    random_access: RandomAccess = 60,
    layers: Annotated[
        int | None,
        typer.Option(help="Layers of importance; the first ones alone are a coarser picture.", show_default="auto"),
    ] = None,
    refine: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Views to refine each group by.", show_default="4 times each picture of a capture"
        ),
    ] = None,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Train on this Ray cluster; its machines see SEQ too.")
    ] = None,
    report: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the report there.")] = None,
) -> None:
    """Capture or Gaussian sequence to a stream. A second run resumes; Ctrl-C leaves a playable file."""
    from ..encode.encode import EncodeSettings

    with Bar() as bar:
        settings = EncodeSettings(quality, _bits(bitrate), keep_all, random_access, layers, refine)
        result = encode_input(seq, out, settings, preset=preset, frames=frames, gop=gop, cluster=ray, bar=bar)
    if report:
        report.write_text(json.dumps(result.to_json(), indent=1))
    if result.groups == 0:
        raise UsageError("stopped before the first group was done; run the same command to go on")
    r = result.to_json()
    stdout.print(
        f"{out}: {r['frames']} frames, {r['gaussians']} Gaussians, {r['bytes']} bytes, "
        f"{r['kb_per_frame']:.2f} kB/frame, {r['bits_per_gaussian_frame']:.2f} bits per Gaussian and frame"
    )
    if result.interrupted:
        print("stopped early: the file holds the groups done, the same command goes on", file=sys.stderr)
        raise typer.Exit(130)


def _bits(rate: str | None) -> float | None:
    """Bits per second of "8M", "500k" or "250000"."""
    if rate is None:
        return None
    try:
        return float(rate.rstrip("kM")) * {"k": 1e3, "M": 1e6}.get(rate[-1:], 1.0)
    except ValueError:
        raise UsageError(f"--bitrate {rate}: expected bits per second, such as 8M, 500k or 250000") from None


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
    from ..splats import detect_input

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
    from ..encode.encode import REFINE, encode_groups, stream_config

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
    from ..splats import open_sequence

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
    from ..encode.encode import encode_groups, stream_config
    from ..train.settings import train_settings
    from ..train.train import Checkpoint, train_groups

    capture = open_frames(source, frames)
    recipe = train_settings(preset, gop=gop, quality=settings.quality)
    work = out.with_name(out.name + ".work")

    def groups(_, first_frame: int) -> Iterator[Group]:
        if cluster:
            from ..train.ray_jobs import cluster_groups

            opened = partial(open_frames, source.resolve(), frames)
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


def up_axis(cameras: list[Camera]) -> str:
    """The world axis that the cameras hold upwards, e.g. "z" or "-y"."""
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    i = int(np.abs(up).argmax())
    return ("-" if up[i] < 0 else "") + AXES[i]
