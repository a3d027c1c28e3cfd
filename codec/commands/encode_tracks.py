"""`gscodec encode --tracks`: a capture -> one file in which the still room and the subject are tracks.

capture/parts.py splits the capture, each part is trained and coded as a stream of its own in OUT.gsv.tracks/. Subjects
that never touch become tracks of their own (encode/subjects.py), and the streams are joined as `mux` does it. The room
is one frame that repeats forever. The first track is a subject: it has the clock of the scene and its sound.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..encode.audio import AudioTrack
from ..encode.encode import EncodeReport, StreamOutput, encode_groups
from ..encode.settings import EncodeSettings
from ..encode.tracks import TrackPlan, write_tracks
from ..errors import UsageError, require
from ..model.placement import Placement
from ..progress import Bar
from .inputs import open_frames
from .sources import Source, TrainOptions, say_few_cameras, say_lengths, trained_source

if TYPE_CHECKING:
    from ..capture import Capture

ROOM_LONGER = 2.0  # times the steps of a keyframe: no group is fine-tuned after it, and it is shown in all frames
FOREVER = 0  # Placement.repeats
SUBJECT = {"masks": "subject", "motion": "moving"}  # name of its track


@dataclass(frozen=True)
class TracksReport:
    """What came out.

    Attributes:
        tracks: name -> report of what was trained and coded; the bytes are those of its own stream.
        sizes: name of each track of the file -> bytes of its groups.
        frames: of the scene. bytes: of the file; 0: nothing is written.
    """

    tracks: dict[str, EncodeReport]
    sizes: dict[str, int]
    frames: int
    bytes: int

    @property
    def interrupted(self) -> bool:
        """Whether a track has groups to come."""
        return any(r.interrupted for r in self.tracks.values())

    def to_json(self) -> dict:
        """The report with its rate."""
        own = {"frames": self.frames, "bytes": self.bytes, "kb_per_frame": self.bytes / max(self.frames, 1) / 1000}
        own |= {"sizes": self.sizes}
        return own | {"tracks": {name: r.to_json() for name, r in self.tracks.items()}}


def encode_tracks(
    source: Path,
    out: Path,
    settings: EncodeSettings,
    options: TrainOptions,
    by: str,
    bar: Bar,
    *,
    made_by: Callable[[Source], dict],
    audio: tuple[Path, AudioTrack] | None = None,
) -> TracksReport:
    """Encodes the capture at `source` into a file of several tracks.

    Args:
        by: as of `split_capture`.
        made_by: a part as it is encoded -> its fingerprint, by which a second run goes on.
        audio: sound, and the file that it was read from.

    Raises:
        UsageError, CaptureError: see the message.
    """
    require("torch", "training a capture")
    from ..capture.parts import split_capture

    _check(settings, options)
    capture = open_frames(source, options.frames)
    say_few_cameras(capture, source, bar)
    parts = split_capture(capture, by)
    if audio:
        say_lengths(*audio, capture.frame_count / capture.fps, bar)
    work, name = out.with_name(out.name + ".tracks"), SUBJECT[by]
    work.mkdir(exist_ok=True)

    def coded(part: Capture, track: str, own: TrainOptions, sound: AudioTrack | None) -> EncodeReport:
        bar.say(f"track {track}: {part.frame_count} frame{'s' * (part.frame_count > 1)}")
        path = work / f"{track}.gsv"
        opened = trained_source(part, path, settings, own, bar, longer=ROOM_LONGER if track == "room" else 1)
        opened = replace(opened, made_of=opened.made_of | {"tracks": by, "track": track})
        return encode_groups(
            opened.groups,
            StreamOutput(path, opened.config, made_by(opened), sound),
            opened.settings,
            cameras=opened.cameras,
            refine_by_pictures=opened.refine_by_pictures,
            keep_part=True,
        )

    reports = {"room": coded(parts.room, "room", replace(options, gop=1), None)}
    if not reports["room"].interrupted:
        reports = {name: coded(parts.subject, name, options, audio and audio[1])} | reports
    report = _joined(work, out, reports, name)
    if not report.interrupted:
        shutil.rmtree(work)
    return report


def _check(settings: EncodeSettings, options: TrainOptions) -> None:
    """Raises UsageError for what several tracks cannot have."""
    if settings.bitrate:
        raise UsageError("--bitrate shares bits out among the groups of one track; with --tracks say --quality")
    if options.rig:
        raise UsageError(
            f"--rig {options.rig}: it is of one subject, and --tracks may find several; encode each by itself and join "
            f"them with gscodec mux"
        )
    if options.cluster:
        raise UsageError(
            f"--ray {options.cluster}: the tracks of a capture are trained on this machine; leave one away"
        )


def _joined(work: Path, out: Path, reports: dict[str, EncodeReport], subject: str) -> TracksReport:
    """Writes the scene of what is there of each part; nothing without the track `subject`."""
    from ..decode import open_stream
    from ..decode.scene import Track

    first = reports.get(subject)
    if not (first and first.groups):
        return TracksReport(reports, {}, 0, 0)
    paths = {subject: work / f"{subject}.gsv"} if first.interrupted else _subjects(work, subject)
    paths["room"] = work / "room.gsv"
    streams = {name: open_stream(path) for name, path in paths.items()}
    placements = {name: Placement(name, repeats=FOREVER if name == "room" else 1) for name in paths}
    size = write_tracks(out, [TrackPlan.of(Track(s, placements[name])) for name, s in streams.items()])
    sizes = {name: sum(g["size"] for g in s.groups) for name, s in streams.items()}
    return TracksReport(reports, sizes, first.frames, size)


def _subjects(work: Path, name: str) -> dict[str, Path]:
    """Name and stream of each subject of the stream `name`: of itself if there is one."""
    from ..decode import open_stream
    from ..encode.split import can_split, split_stream
    from ..encode.subjects import find_subjects

    path = work / f"{name}.gsv"
    stream = open_stream(path)
    labels = find_subjects(stream) if can_split(stream) else []
    count = max((int(own.max(initial=0)) for own in labels), default=0) + 1
    if count == 1:
        return {name: path}
    parts = {f"{name}{k + 1}": work / f"{name}{k + 1}.gsv" for k in range(count)}
    split_stream(stream, labels, list(parts.values()))
    return parts
