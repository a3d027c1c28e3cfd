"""`gscodec encode`: capture -> train -> encode, or splats -> encode."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..fingerprint import inputs, program
from ..model.gaussians import GOP, RANDOM_ACCESS
from ..progress import Bar
from .options import (
    PRESET,
    Frames,
    Gop,
    Motion,
    Preset,
    Quality,
    RandomAccess,
    RigPath,
    SequencePath,
    StreamPath,
    stdout,
)

if TYPE_CHECKING:
    from ..encode.encode import EncodeReport
    from ..encode.settings import EncodeSettings
    from .encode_tracks import TracksReport
    from .sources import Source, TrainOptions

ENDED = {  # ParametricGroup.ended
    "cut": "it cannot be tracked",
    "drift": "tracking had come too far from the keyframe",
    "more": "much comes into the pictures that the keyframe did not show",
    "change": "much that stood still begins to change",
    "jump": "what moves is suddenly elsewhere",
    "empty": "nothing was seen until then",
}


def encode(
    ctx: typer.Context,
    seq: SequencePath,
    out: StreamPath,
    quality: Quality = None,
    bitrate: Annotated[
        str | None, typer.Option(metavar="RATE", help="Bits per second instead of a quality: 8M, 500k.")
    ] = None,
    preset: Preset = PRESET,
    motion: Motion = "field",
    frames: Frames = None,
    gop: Gop = GOP,
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Keep Gaussians that nobody can see.")] = False,
    random_access: RandomAccess = RANDOM_ACCESS,
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
    tracks: Annotated[
        str | None,
        typer.Option(
            metavar="masks|motion",
            help="A still room, coded once, and subjects in it as tracks, by masks or by motion.",
            show_default="one track",
        ),
    ] = None,
    reuse_geometry: Annotated[
        Path | None,
        typer.Option("--reuse-geometry", metavar="OLD.gsv", help="Take all but colours from OLD.gsv; SEQ has others."),
    ] = None,
    rig: RigPath = None,
    from_maps: Annotated[
        bool, typer.Option("--from-maps", help="SEQ is a folder of attribute maps, of decode --maps.")
    ] = False,
    audio: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Sound: AAC and Opus are taken as they are, all else as AAC.")
    ] = None,
    report: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the report there.")] = None,
) -> None:
    """Capture or Gaussian sequence to a stream. A second run resumes; Ctrl-C leaves a playable file."""
    if report and not report.parent.is_dir():
        raise UsageError(f"--json {report}: there is no folder {report.parent}, make it first")
    if from_maps:
        _check_maps(ctx)
        _from_maps(seq, out, audio)
        return
    from ..encode.reuse_geometry import color_bytes
    from ..encode.settings import EncodeSettings
    from .sources import TrainOptions

    with Bar() as bar:
        settings = EncodeSettings(quality, _bits(bitrate), keep_all, random_access, layers, refine)
        options = TrainOptions(preset, frames, gop, motion, ray, rig)
        result = encode_input(seq, out, settings, options, bar, audio, tracks, reuse_geometry)
    if report:
        report.write_text(json.dumps(result.to_json(), indent=1))
    if tracks:
        _print_tracks(out, result)
        return
    if result.groups == 0:
        print("stopped before the first group was done; nothing is left behind", file=sys.stderr)
        raise typer.Exit(130)
    _print_stream(out, result)
    if reuse_geometry:
        stdout.print(f"{color_bytes(result)} bytes of colours are new, geometry and motion are of {reuse_geometry}")
    if result.interrupted:
        print("stopped early: the file holds the groups done, the same command goes on", file=sys.stderr)
        raise typer.Exit(130)


def _print_stream(out: Path | str, result: EncodeReport) -> None:
    r = result.to_json()
    per_gaussian = r["bits_per_gaussian_frame"]
    stdout.print(
        f"{out}: {r['frames']} frames, {r['gaussians']} Gaussians, {r['bytes']} bytes, {r['kb_per_frame']:.2f} kB/frame"
        + ("" if per_gaussian is None else f", {per_gaussian:.2f} bits per Gaussian and frame")
    )
    first, later = result.group_rates()
    if first and later:
        stdout.print(f"{result.groups} groups: {first:.2f} kB/frame in the first, {later:.2f} in the others")
    for group in result.group_list:
        if group["ended"]:
            end = group["frame"] + group["frames"]
            stdout.print(f"the group from frame {group['frame']} ends before frame {end}: {ENDED[group['ended']]}")
    if result.chosen_quality:
        stdout.print(
            f"quality {result.quality:.1f}, at which coding costs about {result.loss} dB against very fine steps"
        )


def _print_tracks(out: Path, result: TracksReport) -> None:
    for name, report in result.tracks.items():
        if report.groups:
            _print_stream(name, report)
    if not result.bytes:
        print("stopped before the first group of the subject was done; the same command goes on", file=sys.stderr)
        raise typer.Exit(130)
    r, sizes = result.to_json(), ", ".join(f"{name} {size}" for name, size in result.sizes.items())
    stdout.print(f"{out}: {r['frames']} frames, {r['bytes']} bytes ({sizes}), {r['kb_per_frame']:.2f} kB/frame")
    if result.interrupted:
        print("stopped early: the file holds the groups done, the same command goes on", file=sys.stderr)
        raise typer.Exit(130)


def _check_maps(ctx: typer.Context) -> None:
    """Raises a UsageError for an option that `--from-maps` does not use."""
    for p in ctx.command.params:
        source = ctx.get_parameter_source(p.name)
        if source and source.name == "COMMANDLINE" and p.name not in ("seq", "out", "from_maps", "audio"):
            raise UsageError(f"--from-maps takes all but the sound (--audio) from the maps; leave {p.opts[0]} away")


def _from_maps(folder: Path, out: Path, audio: Path | None) -> None:
    from ..encode.audio import read_audio
    from ..encode.from_maps import encode_maps

    if out.suffix != ".gsv":
        raise UsageError(f"{out}: the output must be named *.gsv")
    out.parent.mkdir(parents=True, exist_ok=True)
    frames, size = encode_maps(folder, out, read_audio(audio) if audio else None)
    stdout.print(f"{out}: {frames} frames, {size} bytes")


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
    options: TrainOptions,
    bar: Bar,
    audio: Path | None = None,
    tracks: str | None = None,
    reuse_geometry: Path | None = None,
) -> EncodeReport | TracksReport:
    """Encodes a capture or splats at `source`, and the sound of the file `audio`, into the file `out`.

    Args:
        tracks: how a capture is split into tracks (`split_capture`); None: it is not.
        reuse_geometry: a stream of which all but the colours is taken.

    Raises:
        UsageError, CaptureError: see the message.
    """
    from ..encode.audio import read_audio
    from ..encode.encode import StreamOutput, encode_groups
    from ..splats import detect_input
    from .encode_tracks import encode_tracks
    from .reuse_geometry import encode_reusing
    from .sources import capture_source, say_lengths, splat_source

    out, kind = Path(out), detect_input(source)
    _check(source, out, kind, settings, options, tracks, reuse_geometry)
    sound = read_audio(audio) if audio else None
    out.parent.mkdir(parents=True, exist_ok=True)

    def made_by(opened: Source) -> dict:
        return {
            "program": program(),
            "input": inputs(source, out),
            "settings": asdict(opened.settings) | opened.made_of,
        }

    if reuse_geometry:
        return encode_reusing(source, kind, reuse_geometry, out, settings, options, bar, sound)
    if tracks:
        both = (audio, sound) if sound else None
        return encode_tracks(source, out, settings, options, tracks, bar, made_by=made_by, audio=both)
    if kind == "splats":
        opened = splat_source(source, settings, options, bar)
        on_group = lambda r: bar.update("encode", r.frames, opened.frames)  # noqa: E731
    else:
        opened, on_group = capture_source(source, out, settings, options, bar), None
    if sound:
        say_lengths(audio, sound, opened.frames / opened.config["fps"], bar)
    report = encode_groups(
        opened.groups,
        StreamOutput(out, opened.config, made_by(opened), sound),
        opened.settings,
        cameras=opened.cameras,
        refine_by_pictures=opened.refine_by_pictures,
        on_group=on_group,
    )
    if not report.interrupted or not report.groups:  # without a group there is nothing to go on from
        opened.finish()
    return report


def _check(
    source: Path,
    out: Path,
    kind: str,
    settings: EncodeSettings,
    options: TrainOptions,
    tracks: str | None,
    reuse_geometry: Path | None,
) -> None:
    """Raises a UsageError where the options of `encode_input` contradict each other, or what `source` holds."""
    from ..train.settings import train_settings

    train_settings(options.preset, settings.quality, motion=options.motion, gop=options.gop)  # checks them, for splats
    if settings.quality is not None and settings.bitrate is not None:
        raise UsageError("--quality and --bitrate exclude each other: leave one of them away")
    if out.suffix != ".gsv":
        raise UsageError(f"{out}: the output must be named *.gsv")
    if kind == "splats" and options.cluster:
        raise UsageError(f"--ray {options.cluster}: {source} holds splats, which need no training; leave --ray away")
    if kind == "splats" and tracks:
        raise UsageError(f"--tracks {tracks}: {source} holds splats, expected a capture; gscodec mux joins streams")
    if tracks and reuse_geometry:
        raise UsageError("--tracks and --reuse-geometry exclude each other: recolour the tracks one by one")
