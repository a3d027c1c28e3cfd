"""Runs stopped at any moment: the partial file plays, and the resumed run gives the result of an undisturbed run."""

import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from interrupting import gscodec, write_capture
from sounding import write_tone

from gscodec.decode import open_stream
from gscodec.fingerprint import inputs, program, sentence

ENCODE = ("--preset", "fast", "--gop", "2")
MOMENTS = [
    ("keyframe", 20),
    ("track", 5),
    ("state", 2),
    ("fine-tune", 5),
    ("fragment", 1),
    ("checkpoint", 2),
    ("fragment", 2),
    ("index", 1),
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Folder of the capture, with the stream and the .ply folder of undisturbed runs."""
    folder = tmp_path_factory.mktemp("walking")
    write_capture(folder)
    assert gscodec("encode", folder, folder / "whole.gsv", *ENCODE) == 0
    return folder


def same(folder, stream):
    assert stream.read_bytes() == (folder / "whole.gsv").read_bytes()
    left = [p.name for p in stream.parent.iterdir()]
    assert left == [stream.name], "nothing is left over"


def test_groups_are_predicted(capture):
    """Precondition of the other tests here: a run keeps state from group to group."""
    assert [g["sync"] for g in open_stream(capture / "whole.gsv").groups][:3] == [True, False, False]


def test_killed_again_and_again(capture, tmp_path):
    out, frames = tmp_path / "a.gsv", 0
    for at in MOMENTS:
        assert gscodec("encode", capture, out, *ENCODE, at=at) == -signal.SIGKILL, at
        assert not out.exists()
        part = open_stream(tmp_path / "a.gsv.part")
        assert part.frame_count >= frames, "nothing that was done is lost"
        frames = part.frame_count
        if frames:
            assert len(part.frame(frames - 1)) > 50
    assert frames == 7
    assert gscodec("encode", capture, out, *ENCODE) == 0
    same(capture, out)


def test_ctrl_c_leaves_a_file_that_plays(capture, tmp_path):
    out = tmp_path / "a.gsv"
    assert gscodec("encode", capture, out, *ENCODE, at=("fragment", 2), by=signal.SIGINT) == 130
    stream = open_stream(out)
    assert stream.complete
    assert 0 < stream.frame_count < 7
    np.testing.assert_array_equal(stream.frame(0).means, open_stream(capture / "whole.gsv").frame(0).means)
    assert gscodec("encode", capture, out, *ENCODE) == 0
    same(capture, out)


def test_ctrl_c_before_the_first_group_leaves_nothing(capture, tmp_path):
    out = tmp_path / "new" / "a.gsv"
    assert gscodec("encode", capture, out, *ENCODE, at=("fragment", 1), by=signal.SIGINT) == 130
    assert not list(out.parent.iterdir())
    assert gscodec("encode", capture, out, *ENCODE) == 0
    same(capture, out)


def test_sound_goes_on_too(capture, tmp_path):
    write_tone(tmp_path / "tone.wav", 0.2)
    out, whole, options = tmp_path / "a.gsv", tmp_path / "b.gsv", (*ENCODE, "--audio", tmp_path / "tone.wav")
    for at in (("fragment", 2), ("index", 1)):
        assert gscodec("encode", capture, out, *options, at=at) == -signal.SIGKILL
    assert gscodec("encode", capture, out, *options) == 0
    assert gscodec("encode", capture, whole, *options) == 0
    assert out.read_bytes() == whole.read_bytes()
    plain, sounding = open_stream(capture / "whole.gsv"), open_stream(out)
    assert [sounding.payload(i) for i in range(4)] == [plain.payload(i) for i in range(4)]
    assert sum("audio" in g for g in sounding.groups) >= 2


def test_other_settings_start_anew_beside_old_checkpoints(capture, tmp_path):
    out = tmp_path / "a.gsv"
    assert gscodec("encode", capture, out, *ENCODE, "--quality", "80", at=("fragment", 3)) == -signal.SIGKILL
    assert gscodec("encode", capture, out, *ENCODE) == 0
    same(capture, out)


def test_train_goes_on(capture, tmp_path):
    whole, folder = tmp_path / "whole", tmp_path / "plys"
    assert gscodec("train", capture, whole, *ENCODE) == 0
    for at in (("sequence", 4), ("checkpoint", 2)):
        assert gscodec("train", capture, folder, *ENCODE, at=at) == -signal.SIGKILL, at
    assert gscodec("train", capture, folder, *ENCODE) == 0
    files = sorted(p.name for p in whole.iterdir())
    assert sorted(p.name for p in folder.iterdir()) == files
    for name in files:
        if name.endswith(".npz"):
            with np.load(whole / name) as a, np.load(folder / name) as b:
                assert all(np.array_equal(a[k], b[k]) for k in a)
        else:
            assert (whole / name).read_bytes() == (folder / name).read_bytes(), name
    assert "sequence.json" in files


def test_train_and_then_encode_is_encode(tmp_path):
    """On the bundled capture, with equal bytes; without the capture, the streams differ."""
    example = tmp_path / "lumberjack"
    shutil.copytree(Path(__file__).parent.parent / "examples" / "lumberjack", example)
    options = ("--preset", "fast", "--gop", "2", "--frames", "0:3")
    assert gscodec("encode", example, tmp_path / "whole.gsv", *options) == 0
    assert gscodec("train", example, tmp_path / "plys", *options) == 0
    assert gscodec("encode", tmp_path / "plys", tmp_path / "halves.gsv") == 0
    assert (tmp_path / "halves.gsv").read_bytes() == (tmp_path / "whole.gsv").read_bytes()
    example.rename(tmp_path / "moved")
    assert gscodec("encode", tmp_path / "plys", tmp_path / "gone.gsv") == 0
    assert (tmp_path / "gone.gsv").read_bytes() != (tmp_path / "whole.gsv").read_bytes()


def test_a_changed_picture_is_named(tmp_path):
    write_capture(tmp_path, frames=2)
    before = {"program": program(), "input": inputs(tmp_path), "settings": {"quality": 50}}
    picture = next(tmp_path.rglob("*.png"))
    picture.write_bytes(picture.read_bytes() + b" ")
    after = before | {"input": inputs(tmp_path)}
    assert sentence(before, after) == f"{picture.relative_to(tmp_path)} has changed"
    assert sentence(before, before) == ""
    inside = tmp_path / "out.gsv"
    for made in (inside, inside.with_name("out.gsv.part.json")):
        made.write_bytes(b"of an earlier run")
    assert inputs(tmp_path, inside) == after["input"]
