"""Sound of a stream: ffmpeg, a decoder without knowledge of gsv, gets each sound at its time; errors are named."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from sounding import read_tone, told_time, tone_stream, write_tone
from synthetic import turning
from test_cli import fails, run

from gscodec import _native
from gscodec.decode import open_stream
from gscodec.encode.audio import read_audio
from gscodec.errors import BitstreamError, UsageError
from gscodec.splats import write_sequence

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")


def ffmpeg(*args) -> None:
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, args)], capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Folder with a rising tone of 3 s as .wav, AAC and Opus, and 10 frames of splats."""
    path = tmp_path_factory.mktemp("sound")
    write_tone(path / "tone.wav", 3)
    ffmpeg("-i", path / "tone.wav", "-c:a", "aac", path / "tone.m4a")
    ffmpeg("-i", path / "tone.wav", "-c:a", "libopus", path / "tone.opus")
    write_sequence(turning(60, frames=10), path / "plys")
    return path


def check_times(wav: Path, seconds: float, *, start: float = 0.0, within: float = 0.001) -> None:
    samples, rate = read_tone(wav)
    assert abs(len(samples) / rate - seconds) < 0.05
    for t in np.linspace(0.1, seconds - 0.1, 5):
        middle = int(t * rate)
        assert abs(told_time(samples[middle - 2000 : middle + 2000], rate) - start - t) < within


@pytest.mark.parametrize("name", ["tone.wav", "tone.m4a", "tone.opus"])
def test_ffmpeg_finds_the_sound_at_its_time(folder, tmp_path, name):
    """2 s of 3 s, with audio frames across group boundaries, read by ffmpeg."""
    tone_stream(tmp_path / "a.gsv", folder / name)
    ffmpeg("-i", tmp_path / "a.gsv", "-map", "0:a:0", tmp_path / "out.wav")
    check_times(tmp_path / "out.wav", 2)


@pytest.mark.parametrize("name", ["tone.m4a", "tone.opus"])
def test_aac_and_opus_are_taken_as_they_are(folder, tmp_path, name):
    tone_stream(tmp_path / "a.gsv", folder / name)
    ffmpeg("-i", folder / name, "-c:a", "copy", "-f", "data", "-map", "0:a", tmp_path / "before")
    ffmpeg("-i", tmp_path / "a.gsv", "-c:a", "copy", "-f", "data", "-map", "0:a", tmp_path / "after")
    before, after = (tmp_path / "before").read_bytes(), (tmp_path / "after").read_bytes()
    assert len(after) > 10_000
    assert before.startswith(after)


def test_groups_are_the_same_with_sound_and_without(folder, tmp_path):
    tone_stream(tmp_path / "a.gsv", folder / "tone.wav", groups=2, layers=2)
    tone_stream(tmp_path / "b.gsv", None, groups=2, layers=2)
    a, b = open_stream(tmp_path / "a.gsv"), open_stream(tmp_path / "b.gsv")
    assert [a.payload(i) for i in range(2)] == [b.payload(i) for i in range(2)]
    assert "audio" not in b.config
    for g in a.groups:
        offset, _, samples = g["audio"]
        assert offset + sum(size for size, _ in samples) == g["offset"]


def test_command_line(folder, tmp_path):
    """encode, info and render; a part of the frames has the sound of that part."""
    out = tmp_path / "a.gsv"
    done = run("encode", folder / "plys", out, "--refine", 0, "--audio", folder / "tone.m4a")
    assert done.returncode == 0, done.stderr
    fps = open_stream(out).fps
    assert f"3.02 s of sound, cut to the {10 / fps:.2f} s of the video" in done.stderr
    sound = json.loads(run("info", out, "--json").stdout)["sound"]
    assert (sound["codec"], sound["rate"], sound["channels"]) == ("AAC", 44100, 1)
    assert abs(sound["seconds"] - 10 / fps) < 0.03
    assert "sound: AAC, 44100 Hz, 1 channels" in run("info", out).stdout
    assert run("render", out, tmp_path / "a.mp4", "--size", "32x32", "--frames", "4:10").returncode == 0
    ffmpeg("-i", tmp_path / "a.mp4", "-map", "0:a:0", tmp_path / "out.wav")
    samples, rate = read_tone(tmp_path / "out.wav")
    assert abs(told_time(samples[1000:5000], rate) - 3000 / rate - 4 / fps) < 0.01
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gsv", "a.mp4", "out.wav"]


def test_a_short_sound_is_followed_by_silence(folder, tmp_path):
    write_tone(tmp_path / "short.wav", 0.1)
    done = run("encode", folder / "plys", tmp_path / "a.gsv", "--refine", 0, "--audio", tmp_path / "short.wav")
    assert done.returncode == 0
    assert "s of the video is silent" in done.stderr


def test_what_has_no_sound_is_refused(folder, tmp_path):
    still = tmp_path / "still.mp4"
    ffmpeg("-f", "lavfi", "-i", "color=s=16x16:d=0.2", still)
    (tmp_path / "text.wav").write_text("no sound at all")
    encode = ("encode", folder / "plys", tmp_path / "a.gsv", "--audio")
    fails(run(*encode, still), f"--audio {still}: it has no sound, expected")
    fails(run(*encode, tmp_path / "none.wav"), "there is no such file")
    fails(run(*encode, tmp_path / "text.wav"), "finds no sound or video in it, expected")
    assert not (tmp_path / "a.gsv").exists()
    with pytest.raises(UsageError, match="no such file"):
        read_audio(tmp_path)


def test_sound_that_starts_late_is_filled_up(folder, tmp_path):
    """AAC that starts after the video in its container: encoded again, with silence in front."""
    late = tmp_path / "late.mp4"
    inputs = ("-f", "lavfi", "-i", "color=s=16x16:d=2", "-itsoffset", "0.5", "-i", folder / "tone.m4a")
    ffmpeg(*inputs, "-c:a", "copy", "-t", "2", late)
    tone_stream(tmp_path / "a.gsv", late, groups=3)
    ffmpeg("-i", tmp_path / "a.gsv", "-map", "0:a:0", tmp_path / "out.wav")
    samples, rate = read_tone(tmp_path / "out.wav")
    assert np.abs(samples[: int(0.4 * rate)]).max() < 0.05
    middle = int(1.2 * rate)
    assert abs(told_time(samples[middle - 2000 : middle + 2000], rate) - 0.7) < 0.03


def test_maps_keep_the_sound(folder, tmp_path):
    tone_stream(tmp_path / "a.gsv", folder / "tone.m4a", groups=3)
    done = run("decode", "--maps", tmp_path / "a.gsv", tmp_path / "maps")
    assert done.returncode == 0, done.stderr
    done = run("encode", "--from-maps", tmp_path / "maps", tmp_path / "b.gsv")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "b.gsv").read_bytes() == (tmp_path / "a.gsv").read_bytes()
    sound = tmp_path / "maps" / "sound.bin"
    sound.write_bytes(sound.read_bytes()[:-1])
    fails(run("encode", "--from-maps", tmp_path / "maps", tmp_path / "c.gsv"), "sound.bin has")


def test_a_file_of_another_codec_is_no_track():
    with pytest.raises(BitstreamError, match="AAC or Opus"):
        _native.read_audio(b"\0\0\0\x08moov")
