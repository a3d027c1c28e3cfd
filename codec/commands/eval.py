"""`gscodec eval`: stream + the capture or the splats that it came from -> quality, as lines or JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from ..frame_range import frame_range
from ..progress import Bar
from .inputs import open_frames, open_stream_of_frames
from .options import Frames, Json, SequencePath, StreamPath, stdout
from .tracks import Tracks


def evaluate(
    stream: StreamPath,
    seq: SequencePath,
    split: Annotated[str, typer.Option(help="Cameras of a capture: test or train.")] = "test",
    frames: Frames = None,
    track: Tracks = None,
    as_json: Json = False,
) -> None:
    """PSNR, SSIM, VMAF and temporal stability against a capture or the splats that were encoded."""
    with Bar() as bar:
        result = evaluate_stream(stream, seq, split=split, frames=frames, tracks=track, bar=bar)
    if as_json:
        print(json.dumps(result, indent=1))
        return
    for key, value in result.items():
        if isinstance(value, float):
            stdout.print(f"{key:<26}{value:.4f}")
        elif isinstance(value, int | str):
            stdout.print(f"{key:<26}{value}")
    for p in result.get("prefixes", ()):
        psnr = p["codec_psnr"] if p["psnr"] is None else p["psnr"]
        stdout.print(f"first {p['layers']} layers: {p['kb_per_frame']:.2f} kB/frame, {psnr:.2f} dB")


def evaluate_stream(
    stream_path: Path, source: Path, *, split: str, frames: str | None, bar: Bar, tracks: list[str] | None = None
) -> dict:
    """Measures a .gsv file against the capture or the splats that were encoded (keys: docs/figures.md, "Measures").

    A stream with layers also has `prefixes`, the same measures of its first layer, its first two layers and so on.
    """
    from ..decode import Scene, open_stream
    from ..decode.report import describe
    from ..metrics.evaluate import evaluate_capture, evaluate_splats
    from ..model.camera import low_pass_of
    from ..splats import detect_input, open_sequence

    whole = open_stream_of_frames(stream_path, tracks)
    on_progress = lambda done, total: bar.update("eval", done, total)  # noqa: E731
    splats = detect_input(source) == "splats"
    reference = open_sequence(source) if splats else open_frames(source, None)
    if whole.frame_count != reference.frame_count:
        counts = f"{whole.name} has {whole.frame_count} frames, {source} {reference.frame_count}"
        print(f"warning: {counts}; those that both have are compared", file=sys.stderr)
    chosen = frame_range(frames, min(whole.frame_count, reference.frame_count))

    def measure(stream, size: int) -> dict:
        options = {"size": size, "stream_frames": whole.frame_count, "progress": on_progress}
        if splats:
            return evaluate_splats(stream.frame, reference, frames=chosen, **options)
        capture = reference.frames(chosen.start, chosen.stop).with_low_pass(low_pass_of(whole.cameras))
        found = evaluate_capture(lambda t: stream.frame(chosen.start + t), capture, split=split, **options)
        for row in found["per_frame"]:
            row["frame"] += chosen.start
        return found

    result = measure(whole, whole.byte_count)
    if isinstance(whole, Scene):  # its tracks have layers of their own
        return result
    later = [layer["bytes"] for layer in describe(whole)["layers"]][1:]
    if later:
        result["prefixes"] = []
    for k in range(len(later)):
        found = measure(open_stream(stream_path, layers=k + 1), whole.byte_count - sum(later[k:]))
        keys = ("bytes", "kb_per_frame", "gaussians", "psnr", "psnr_fg", "codec_psnr", "codec_psnr_fg")
        result["prefixes"].append({"layers": k + 1} | {name: found[name] for name in keys})
    return result
