"""New streams from the groups of another stream: its head and its sound, for new payloads."""

from __future__ import annotations

from pathlib import Path

from ..decode.stream import Stream
from .audio import AudioTrack, GroupSound
from .writer import StreamWriter


def sound_of(stream: Stream) -> GroupSound | None:
    """The sound of a stream, group by group; None: it has none."""
    if "audio" not in stream.config:
        return None
    runs = {}
    for i, g in enumerate(stream.groups):
        if "audio" in g:
            _, media_time, samples = g["audio"]
            runs[g["start_frame"]] = media_time, samples, stream.sound(i)
    return GroupSound(stream.config["audio"], runs)


def writer_like(stream: Stream, out: Path, made_by: dict, audio: AudioTrack | GroupSound | None) -> StreamWriter:
    """A writer of the file `out` with the head and the placement of `stream`, and with other sound."""
    config = {k: v for k, v in stream.config.items() if k not in ("track", "audio")}
    return StreamWriter(out, config, made_by, audio)
