"""File with sound -> audio track of a stream (spec 2.7): AAC and Opus are copied, other codecs become AAC by ffmpeg.

ffmpeg, from the imageio-ffmpeg wheel, repacks or encodes the file to a fragmented MP4, whose sample entry and samples
the stream takes over. The samples of a group are those that begin within its frames, so sound is cut to the video.
"""

from __future__ import annotations

import hashlib
import re
import subprocess
from bisect import bisect_left
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from .. import _native
from ..errors import BitstreamError, UsageError, require

TAKEN = ("aac", "opus")  # ffmpeg's names of the codecs that the track may hold
AAC = ("-af", "aresample=async=1:first_pts=0", "-c:a", "aac", "-b:a", "128k")  # gaps are filled with silence
MP4 = ("-f", "mp4", "-movflags", "delay_moov+default_base_moof", "-frag_duration", "1000000", "pipe:1")


@dataclass(frozen=True)
class AudioTrack:
    """The audio track of a stream.

    Attributes:
        config: timescale (units a second), media_start (media time of the first frame), entry (a whole box).
        samples: (size in bytes, duration in units) of each.
        data: their bytes, concatenated.
    """

    config: dict
    samples: list[tuple[int, int]]
    data: bytes
    _times: list[int] = field(init=False, repr=False)
    _offsets: list[int] = field(init=False, repr=False)

    def __post_init__(self):
        object.__setattr__(self, "_times", list(accumulate((d for _, d in self.samples), initial=0)))
        object.__setattr__(self, "_offsets", list(accumulate((s for s, _ in self.samples), initial=0)))

    @property
    def seconds(self) -> float:
        """Duration of the audible part."""
        return (self._times[-1] - self.config["media_start"]) / self.config["timescale"]

    @property
    def digest(self) -> str:
        """For fingerprints."""
        return hashlib.sha256(repr((self.config, self.samples)).encode() + self.data).hexdigest()[:16]

    def between(self, start: int, end: int, fps: tuple[int, int]) -> tuple[int, list[tuple[int, int]], bytes] | None:
        """Media time, samples and bytes of the samples that begin within the frames `start` to `end` - 1; None: there
        are none. Samples before the first frame, which only prepare the decoder, belong to it."""

        def first(frame: int) -> int:
            units = -(-frame * fps[1] * self.config["timescale"] // fps[0])
            return bisect_left(self._times, units + self.config["media_start"], hi=len(self.samples))

        a, b = first(start) if start else 0, first(end)
        return (self._times[a], self.samples[a:b], self.data[self._offsets[a] : self._offsets[b]]) if a < b else None


@dataclass(frozen=True)
class GroupSound:
    """Sound that is already split into samples of each group: as `AudioTrack`, without its times.

    Attributes:
        config: as in `AudioTrack`.
        runs: first frame of a group -> media time, (size, duration) of each sample, bytes.
    """

    config: dict
    runs: dict[int, tuple[int, list[tuple[int, int]], bytes]]

    @property
    def digest(self) -> str:
        return hashlib.sha256(repr((self.config, self.runs)).encode()).hexdigest()[:16]

    def between(self, start: int, end: int, fps: tuple[int, int]) -> tuple[int, list[tuple[int, int]], bytes] | None:
        return self.runs.get(start)


def read_audio(path: Path) -> AudioTrack:
    """The first audio track of a sound or video file.

    Raises:
        UsageError: there is no such file, ffmpeg cannot read it, it has no sound, or imageio-ffmpeg is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"--audio {path}: there is no such file")
    binary = require("imageio_ffmpeg", "--audio").get_ffmpeg_exe()
    source = [binary, "-nostdin", "-hide_banner", "-i", str(path.resolve())]
    told = subprocess.run(source, capture_output=True, check=False).stderr.decode(errors="replace")
    codec = re.search(r"Stream #\S+: Audio: (\w+)", told)
    if codec is None:
        reason = "it has no sound" if "Stream #" in told else "ffmpeg finds no sound or video in it"
        raise UsageError(f"--audio {path}: {reason}, expected a file with an audio track (.wav, .m4a, .opus, .mp4 ...)")
    if codec[1] in TAKEN:
        try:
            return _track(_mp4(path, source, ("-c:a", "copy")))
        except BitstreamError:
            pass  # e.g. the sound starts late: then it is encoded
    return _track(_mp4(path, source, AAC))


def _mp4(path: Path, source: list[str], how: tuple[str, ...]) -> bytes:
    plain = ("-map", "0:a:0", "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:a", "+bitexact")
    done = subprocess.run([*source, "-v", "error", *plain, *how, *MP4], capture_output=True, check=False)
    if done.returncode or not done.stdout:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no sound came out"]
        raise UsageError(f"--audio {path}: ffmpeg cannot read its sound: {lines[-1]}")
    return done.stdout


def _track(mp4: bytes) -> AudioTrack:
    """The track of a fragmented MP4 that has only sound.

    Raises:
        BitstreamError: the track does not have the form of spec 2.7.
    """
    facts = _native.read_audio(mp4)
    places = facts.pop("samples")
    if not places:
        raise BitstreamError("expected samples of sound, found none")
    samples = [(size, duration) for _, size, duration in places]
    if len(samples) > 1:  # ffmpeg shortens the last sample, but decoders return all of it
        samples[-1] = samples[-1][0], max(samples[-2][1], samples[-1][1])
    return AudioTrack(facts, samples, b"".join(mp4[at : at + size] for at, size, _ in places))
