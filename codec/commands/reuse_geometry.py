"""`gscodec encode --reuse-geometry OLD.gsv`: splats with other colours, or a capture in other light -> a stream whose
geometry and motion units are those of OLD.gsv."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..decode.stream import Stream
from ..encode.audio import AudioTrack
from ..encode.encode import EncodeReport
from ..encode.reuse_geometry import Colors, encode_recolored
from ..encode.rewriting import sound_of, writer_like
from ..encode.settings import EncodeSettings
from ..errors import CaptureError, UsageError, require
from ..fingerprint import inputs, program
from ..frame_range import frame_range
from ..model.camera import Calibration, Camera
from ..model.gaussians import GOP, RANDOM_ACCESS
from ..model.parametric_group import ParametricGroup
from ..progress import Bar
from .inputs import open_frames, open_tracks
from .options import PRESET
from .sources import TrainOptions

if TYPE_CHECKING:
    from ..capture import Capture


def encode_reusing(
    source: Path,
    kind: str,
    old: Path,
    out: Path,
    settings: EncodeSettings,
    options: TrainOptions,
    bar: Bar,
    audio: AudioTrack | None = None,
) -> EncodeReport:
    """Encodes the colours of `source`, a "capture" or "splats" (`kind`), over the geometry of the stream `old`.

    Raises:
        UsageError, CaptureError, BitstreamError: see the message.
    """
    _check(kind, settings, options)
    stream = _only_track(old)
    if out.exists() and out.samefile(old):
        raise UsageError(f"{out}: the output is the stream whose geometry is reused; name another file")
    made_by = {"program": program(), "input": inputs(source, out), "settings": asdict(settings)}
    made_by["settings"] |= {"frames": options.frames, "reuse_geometry": inputs(old)}
    more = {"cameras": lambda _: stream.cameras}
    if kind == "splats":
        colors = _of_splats(source, options.frames, stream)
    else:
        capture = open_frames(source, options.frames)
        _check_capture(capture, stream, source)
        colors, refinement = _of_pictures(capture, settings)
        trained = capture.indices("train")
        more = {"cameras": lambda t: [capture.camera(i, t) for i in trained], "refine_by_pictures": refinement}
    on_group = lambda r: bar.update("encode", r.frames, stream.frame_count)  # noqa: E731
    writer = writer_like(stream, out, made_by, audio or sound_of(stream))
    return encode_recolored(stream, colors, writer, settings, on_group=on_group, **more)


def _check(kind: str, settings: EncodeSettings, options: TrainOptions) -> None:
    """Raises UsageError for options that would change the geometry, or refine the colours of splats."""
    if kind == "splats" and settings.refine:
        raise UsageError(f"--refine {settings.refine}: colours are refined by the pictures of a capture; leave it away")
    usual = TrainOptions(PRESET, None, GOP)
    given = {
        "--quality": settings.quality is not None,
        "--bitrate": settings.bitrate is not None,
        "--layers": settings.layers is not None,
        "--keep-all": settings.keep_all,
        "--random-access": settings.random_access != RANDOM_ACCESS,
        "--ray": options.cluster is not None,
        "--rig": options.rig is not None,
        **{f"--{n}": getattr(options, n) != getattr(usual, n) for n in ("preset", "gop", "motion")},
    }
    if wrong := [name for name, there in given.items() if there]:
        raise UsageError(
            f"--reuse-geometry takes groups, motion, layers and steps from the stream; leave {wrong[0]} away"
        )


def _only_track(path: Path) -> Stream:
    scene = open_tracks(path)
    if len(scene.tracks) > 1:
        names = ", ".join(t.placement.name for t in scene.tracks)
        raise UsageError(
            f"--reuse-geometry {path}: {len(scene.tracks)} tracks ({names}), expected one; gscodec edit --drop takes "
            f"the others out"
        )
    stream = scene.tracks[0].stream
    if not stream.frame_count:
        raise UsageError(f"--reuse-geometry {path}: it has no whole frame")
    return stream


def _check_length(name: Path, frames: int, stream: Stream) -> None:
    if frames != stream.frame_count:
        raise UsageError(
            f"{name}: {frames} frames, {stream.name} has {stream.frame_count}; expected as many (--frames A:B)"
        )


def _of_splats(source: Path, frames: str | None, stream: Stream) -> Colors:
    """Colours of a folder of splats, one file a frame."""
    from ..splats.files import read_splat
    from ..splats.recolored import with_colors
    from ..splats.sequence import splat_paths

    paths = splat_paths(source)
    chosen = frame_range(frames, len(paths)) if paths else range(0)
    paths = [paths[i] for i in chosen]
    _check_length(source, len(paths), stream)

    def colors(group: ParametricGroup, first: int) -> ParametricGroup:
        own = paths[first : first + len(group)]
        return with_colors(group, [partial(read_splat, p) for p in own], [str(p) for p in own])

    return colors


def _check_capture(capture: Capture, stream: Stream, source: Path) -> None:
    """Raises CaptureError unless the capture has the cameras and the frames of the stream."""
    from ..capture.capture import differs, extent

    _check_length(source, capture.frame_count, stream)
    known = {c.name: c for c in stream.cameras}
    scale = extent(capture.cameras)
    for camera in capture.cameras:
        there = known.get(camera.name)
        if there is None:
            raise CaptureError(
                f"{source}: camera {camera.name} is none of {stream.name} ({', '.join(known) or 'none'})"
            )
        if differs(*map(_rounded, (camera, there.resized(camera.width, camera.height))), scale):
            raise CaptureError(
                f"{source}: camera {camera.name} is not where {stream.name} has it; its geometry fits the cameras that "
                f"it was made with"
            )


def _rounded(camera: Camera) -> Camera:
    """As a stream holds it, f32; without the lens, which a capture has undone."""
    f32 = lambda a: np.asarray(a, np.float32).astype(float)  # noqa: E731
    return replace(camera, K=f32(camera.K), viewmat=f32(camera.viewmat))


def _of_pictures(capture: Capture, settings: EncodeSettings):
    """Colours that are fitted to the pictures of a capture, and what refines them as integers."""
    require("torch", "fitting colours to pictures")
    from ..train.recolor import fit_colors, picture_count
    from ..train.refinement import PictureRefinement
    from ..train.settings import RecolorSettings

    refinement, recipe = PictureRefinement(capture, views=settings.refine), RecolorSettings()
    cameras = len(capture.indices("train"))

    def colors(group: ParametricGroup, first: int) -> ParametricGroup:
        group = replace(group, calibration=Calibration.plain(len(capture.cameras), len(group)))
        count = picture_count(cameras, len(group), recipe)
        few = refinement.pictures(group, first, recipe.map_pictures, seed=1)
        return fit_colors(group, few, refinement.pictures(group, first, count, seed=2), count, recipe)

    return colors, refinement
