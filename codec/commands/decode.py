"""`gscodec decode`: stream -> one splat per frame (.ply, .spz, .glb, Draco points), one .splatv, or attribute maps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..frame_range import frame_range
from .inputs import open_stream_of_frames
from .options import Frames, StreamPath, stdout
from .tracks import Tracks

if TYPE_CHECKING:
    from ..decode import Scene, Stream

FORMATS = ("ply", "spz", "glb", "drc")
SPLATV_LEAST = 30.0  # dB to the stream, below which a .splatv does not show the same scene
COMPARED = 4  # frames


def decode(
    stream: StreamPath,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the frames, or one NAME.splatv for all.")],
    form: Annotated[str, typer.Option("--format", help="Of each frame: ply, spz, glb or drc (points alone).")] = "ply",
    frames: Frames = None,
    maps: Annotated[bool, typer.Option("--maps", help="The attribute maps as 16-bit images, and maps.json.")] = False,
    track: Tracks = None,
) -> None:
    """Stream to one standard 3DGS .ply (.spz, .glb) per frame, to one .splatv, or to attribute maps."""
    from ..splats import write_sequence, write_splat

    form = form.lower().lstrip(".")
    if form not in FORMATS:
        raise UsageError(f"--format {form}: expected {', '.join(FORMATS)}; a .splatv is named as the output instead")
    if maps and (frames or form != "ply" or folder.suffix.lower() == ".splatv"):
        raise UsageError("--maps writes the whole stream as images into a folder; leave --format and --frames away")
    if form != "ply" and folder.suffix.lower() == ".splatv":
        raise UsageError(f"--format {form}: {folder} is one .splatv, expected a folder for {form} frames")
    s = open_stream_of_frames(stream, track)
    if maps:
        from ..decode.maps import write_maps

        s = _one_track(s, "--maps")
        stdout.print(f"{folder}: {write_maps(s, folder)} images of {len(s.groups)} groups, maps.json")
        return
    chosen = frame_range(frames, s.frame_count)
    if folder.suffix.lower() == ".splatv":
        stdout.print(_to_splatv(_one_track(s, f"{folder}"), folder, chosen))
        return
    if form == "ply" and len(chosen) == s.frame_count:
        write_sequence(s.sequence(), folder)
    else:
        folder.mkdir(parents=True, exist_ok=True)
        if form == "ply":
            (folder / "sequence.json").unlink(missing_ok=True)  # some of its frames will be overwritten
        for t in chosen:
            write_splat(folder / f"{t:06d}.{form}", s.frame(t), s.config["up"])
    stdout.print(f"{folder}: {len(chosen)} frames")


def _one_track(s: Stream | Scene, purpose: str) -> Stream:
    """The stream of the only visible track, which has no transform."""
    if not hasattr(s, "alone"):
        return s
    stream, track = s.alone(purpose), next(t for t in s.tracks if not t.placement.hidden)
    if track.placement.keys:
        which = track.placement.name or s.tracks.index(track) + 1
        raise UsageError(f"{purpose} cannot hold the transform of a track; add --track {which}:transform=none")
    return stream


def _to_splatv(s: Stream, path: Path, chosen: range) -> str:
    """Writes the whole stream as one .splatv; what to say of it."""
    from ..metrics.evaluate import evaluate_splats
    from ..splats.spacetime_fit import fit_spacetime
    from ..splats.splatv import write_splatv

    if len(chosen) < s.frame_count:
        raise UsageError("--frames: a .splatv is made of the whole stream; encode fewer frames instead")
    sequence = s.sequence()
    scene = fit_spacetime(sequence, s.identities())
    some = sorted({round(i * (s.frame_count - 1) / (COMPARED - 1)) for i in range(COMPARED)})
    shown = lambda t: scene.at(t / s.frame_count).take(scene.shown(t / s.frame_count))  # noqa: E731
    psnr = evaluate_splats(shown, sequence, frames=some)["codec_psnr"]
    if psnr < SPLATV_LEAST:
        raise UsageError(
            f"{path}: the motion is no .splatv, whose Gaussians have cubic paths, one colour and one fade: it would "
            f"show the stream at {psnr:.1f} dB, expected {SPLATV_LEAST:g} or more; decode to .ply"
        )
    write_splatv(path, scene, s.frame_count, s.fps, s.cameras)
    return f"{path}: {len(scene)} Gaussians over {s.frame_count} frames, {psnr:.1f} dB to the stream"
