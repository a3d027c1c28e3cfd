"""Scenes of several tracks: mux, edit, placement; damage to one track leaves the others unchanged."""

import json
import re
import subprocess
import sys
import warnings
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from sounding import tone_stream, write_tone
from synthetic import blob, encode_sequence, moved

from gscodec import _native
from gscodec.decode import open_scene, open_stream
from gscodec.decode.report import describe_scene
from gscodec.decode.scene import read_scene
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import GscodecError
from gscodec.metrics.image import psnr
from gscodec.model.camera import Camera, look_at
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.rotations import quat_to_matrix
from gscodec.render.image import render_image
from gscodec.splats import read_splat

LENGTH = 4  # frames of a group
COMMAND = "from gscodec.cli import main; main()"
VECTORS = Path(__file__).resolve().parents[1] / "spec" / "vectors" / "valid"


def run(*arguments) -> str:
    done = subprocess.run([sys.executable, "-c", COMMAND, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def fails(*arguments) -> str:
    done = subprocess.run([sys.executable, "-c", COMMAND, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stderr


def write_stream(path, seed, groups=3, sh_count=0, fps=30.0, **settings):
    still = blob(80, seed, sh_count)
    frames = [moved(still, [0, 0.1 * t, 0], [0.02 * t, 0, 0]) for t in range(groups * LENGTH)]
    sequence = GaussianSequence(fps, [DenseGroup(frames[k * LENGTH :][:LENGTH]) for k in range(groups)])
    degree = {0: 0, 3: 1, 15: 3}[sh_count]
    config = stream_config(fps=fps, sh_degree=degree, gaussians=80, frames=LENGTH)
    encode_sequence(sequence, path, config, EncodeSettings(quality=50, refine=0, **settings))


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Folder with man.gsv (predicted groups) and ball.gsv (SH of degree 3, independent groups)."""
    folder = tmp_path_factory.mktemp("parts")
    write_stream(folder / "man.gsv", 1)
    write_stream(folder / "ball.gsv", 2, sh_count=15, random_access=0)
    return folder


@pytest.fixture(scope="module")
def scene(parts):
    """A file with both tracks; the ball is beside the man, turned and half as large."""
    path = parts / "scene.gsv"
    placed = "ball:move=4,0,0:turn=0,90,0:scale=0.5"
    run("mux", parts / "man.gsv", parts / "ball.gsv", "-o", path, "--track", placed)
    return path


def payloads(stream):
    return [stream.payload(i) for i in range(len(stream.groups))]


def same(a: Gaussians, b: Gaussians) -> None:
    for f in fields(Gaussians):
        np.testing.assert_array_equal(getattr(a, f.name), getattr(b, f.name), err_msg=f.name)


def picture(g: Gaussians, at: float) -> np.ndarray:
    K = np.array([[90.0, 0, 32], [0, 90, 32], [0, 0, 1]])
    camera = Camera("c", K, look_at(np.array([at, 0.5, -5]), np.array([at, 0, 0]), np.array([0, 1.0, 0])), 64, 64)
    return render_image(g, camera, background=(0.2, 0.2, 0.2))


def test_a_scene_is_its_parts(parts, scene):
    opened = open_scene(scene)
    man, ball = (open_stream(parts / f"{name}.gsv") for name in ("man", "ball"))
    assert [t.placement.name for t in opened.tracks] == ["man", "ball"]
    assert opened.frame_count == 12
    for t in (0, 5, 11):
        whole, own, other = opened.frame(t), man.frame(t), ball.frame(t)
        n = len(own)
        same(whole.take(slice(0, n)), Gaussians(*[*[getattr(own, f.name) for f in fields(own)][:5], whole.shN[:n]]))
        assert not whole.shN[:n].any()
        back = whole.take(slice(n, None))
        turned = moved(other, [0, np.pi / 2, 0], [0, 0, 0])
        np.testing.assert_allclose(back.means, 0.5 * turned.means + [4, 0, 0], atol=1e-5)
        np.testing.assert_allclose(back.log_scales, other.log_scales + np.log(0.5), atol=1e-5)
        assert np.abs((back.quats * turned.quats).sum(1)).min() > 0.99999
        # where the tracks do not overlap, a picture of the scene is that of the part
        assert psnr(picture(own, 0.0), picture(whole, 0.0)) > 45
        # a view that turns with the ball sees the same picture, so the harmonics have turned, too
        assert psnr(picture(back, 4.0), picture(whole, 4.0)) > 45


def test_harmonics_turn_with_the_track(parts):
    ball = open_stream(parts / "ball.gsv")
    turn = [0.3, -1.1, 0.6]
    angle = np.linalg.norm(turn)
    rotation = (np.cos(angle / 2), *(np.sin(angle / 2) * np.array(turn) / angle).tolist())
    placed = ball.frame(3, (rotation, (0.0, 0.0, 0.0), 1.0))
    camera = look_at(np.array([0.5, 1.0, -5]), np.zeros(3), np.array([0, 1.0, 0]))
    K = np.array([[90.0, 0, 32], [0, 90, 32], [0, 0, 1]])
    view = np.eye(4)
    view[:3, :3] = quat_to_matrix(np.array(rotation)).T  # sees the turned track as `camera` the unturned one
    straight = render_image(ball.frame(3), Camera("a", K, camera, 64, 64))
    turned = render_image(placed, Camera("b", K, camera @ view, 64, 64))
    assert psnr(straight, turned) > 45
    plain = Gaussians(*[*[getattr(placed, f.name) for f in fields(placed)][:5], ball.frame(3).shN])
    assert psnr(straight, render_image(plain, Camera("b", K, camera @ view, 64, 64))) < 40


def test_units_stay_as_they_are(parts, scene, tmp_path):
    opened = open_scene(scene)
    for t, name in zip(opened.tracks, ("man", "ball"), strict=True):
        assert payloads(t.stream) == payloads(open_stream(parts / f"{name}.gsv"))
    run("edit", scene, "-o", tmp_path / "man.gsv", "--drop", "ball", "--track", "man:name=he")
    again = open_scene(tmp_path / "man.gsv")
    assert [t.placement.name for t in again.tracks] == ["he"]
    assert payloads(again.tracks[0].stream) == payloads(open_stream(parts / "man.gsv"))


def test_one_track_that_is_not_placed_is_the_file_it_was(parts, tmp_path):
    run("edit", parts / "man.gsv", "-o", tmp_path / "same.gsv")
    assert (tmp_path / "same.gsv").read_bytes() == (parts / "man.gsv").read_bytes()


def test_moving_a_track_changes_a_few_bytes(scene, tmp_path):
    run(
        "edit",
        scene,
        "-o",
        tmp_path / "moved.gsv",
        "--track",
        "ball:move=1,2,3:turn=0,0,10:offset=0.5",
        "--track",
        "man:hide",
    )
    before, after = scene.read_bytes(), (tmp_path / "moved.gsv").read_bytes()
    moov = lambda data: slice(data.index(b"moov") - 4, data.index(b"sidx") - 4)  # noqa: E731
    assert before[moov(before).stop :] == after[moov(after).stop :]
    changed = len(after) - len(before) + sum(a != b for a, b in zip(before[::-1], after[::-1], strict=False))
    assert len(after[moov(after)]) - len(before[moov(before)]) < 300
    assert changed < len(after[moov(after)])
    assert open_scene(tmp_path / "moved.gsv").tracks[1].placement.offset == 15


def test_trim_join_and_reorder(parts, tmp_path):
    ball = payloads(open_stream(parts / "ball.gsv"))
    run("edit", parts / "ball.gsv", "-o", tmp_path / "a.gsv", "--frames", "8:12", "--frames", "0:4")
    turned = open_stream(tmp_path / "a.gsv")
    assert payloads(turned) == [ball[2], ball[0]]
    assert [(g["start_frame"], g["frames"]) for g in turned.groups] == [(0, 4), (4, 4)]
    run("edit", tmp_path / "a.gsv", parts / "ball.gsv", "-o", tmp_path / "b.gsv")
    joined = open_stream(tmp_path / "b.gsv")
    assert payloads(joined) == [ball[2], ball[0], *ball]
    same(joined.frame(9), open_stream(parts / "ball.gsv").frame(1))
    assert "begin at frames 0, 4, 8" in fails("edit", parts / "ball.gsv", "-o", tmp_path / "c.gsv", "--frames", "2:8")
    lonely = fails("edit", VECTORS / "predicted.gsv", "-o", tmp_path / "c.gsv", "--frames", "4:10")
    assert "predicted from that of frame 0" in lonely
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.gsv", "b.gsv"]


def test_time_of_a_track(parts, tmp_path):
    """A ball at half the rate starts late and plays without end; the man plays twice."""
    write_stream(tmp_path / "slow.gsv", 5, groups=1, fps=15.0)
    tracks = ["--track", "man:repeat=2", "--track", "ball:offset=0.2:repeat=forever"]
    run("mux", parts / "man.gsv", f"ball={tmp_path / 'slow.gsv'}", "-o", tmp_path / "s.gsv", *tracks)
    s = open_scene(tmp_path / "s.gsv")
    man, slow = open_stream(parts / "man.gsv"), open_stream(tmp_path / "slow.gsv")
    assert s.frame_count == 24
    assert len(s.frame(5)) == len(man.frame(5))
    for t, own in ((6, 0), (7, 0), (8, 1), (14, 0), (23, 0)):
        same(s.frame(t).take(slice(0, 80)), man.frame(t % 12))
        same(s.frame(t).take(slice(80, None)), slow.frame(own))
    told = run("info", tmp_path / "s.gsv")
    assert "ball: 4 frames at 15 fps from 0.2 s, without end" in told
    assert "man: 12 frames at 30 fps from 0 s, 2 times" in told


def test_keys_from_a_file(scene, parts, tmp_path):
    half = [{"time": 0, "scale": 2}, {"time": 0.2, "translation": [0, 6, 0], "rotation": [1, 0, 0, 1]}]
    (tmp_path / "path.json").write_text(json.dumps(half))
    run(
        "decode", scene, tmp_path / "ply", "--frames", "3:4", "--track", f"ball:only:transform={tmp_path / 'path.json'}"
    )
    got, own = read_splat(tmp_path / "ply" / "000003.ply"), open_stream(parts / "ball.gsv").frame(3)
    turned = moved(own, [0, 0, np.pi / 4], [0, 0, 0])
    np.testing.assert_allclose(got.means, 1.5 * turned.means + [0, 3, 0], atol=1e-4)


def test_wrong_words_are_told(scene, parts, tmp_path):
    out = tmp_path / "o.gsv"
    for option, message in {
        "dog:hide": "no track 'dog', expected one of: 1 man, 2 ball",
        "ball": "expected NAME:CHANGE",
        "ball:move=1,2": "expected 3 finite numbers",
        "ball:scale=0": "above 0",
        "ball:scale=nan": "finite",
        "ball:repeat=0": "from 1 on, or forever",
        "ball:jump": "no change of a track",
        "ball:hide=1": "no change of a track",
        "ball:name=": "1 to 255 bytes",
        "ball:offset=1e12": "offset",
        "ball:transform=none.json": "expected a JSON list",
    }.items():
        assert message in re.sub(r"\s+", " ", fails("edit", scene, "-o", out, "--track", option)), option
    assert "two tracks are named 'man'" in fails("mux", parts / "man.gsv", parts / "man.gsv", "-o", out)
    assert "two tracks are named 'man'" in fails("mux", scene, "-o", out, "--track", "ball:name=man")
    assert "the file has 2 tracks, expected one for the name 'n'" in fails("mux", f"n={scene}", "-o", out)
    hidden = ("--track", "man:hide", "--track", "ball:hide")
    assert "shows no frame: its tracks are hidden" in fails("render", scene, out.with_suffix(".mp4"), *hidden)
    assert "no track is left" in fails("edit", parts / "man.gsv", "-o", out, "--drop", "1")
    assert "shows 2; add --track NAME:only" in fails("decode", scene, tmp_path / "maps", "--maps")
    run("decode", scene, tmp_path / "maps", "--maps", "--track", "man:only")
    moved = ("--track", "man:only", "--track", "man:move=1,0,0")
    assert "transform of a track; add --track man:transform=none" in fails(
        "decode", scene, tmp_path / "a.splatv", *moved
    )
    assert not out.exists()


def test_damage_in_one_track_leaves_the_others(scene, parts):
    """Any wrong byte in the boxes and groups of one track: the other track plays on."""
    data = scene.read_bytes()
    opened = open_scene(scene)
    spans = [[(g["offset"], g["size"]) for g in t.stream.groups] for t in opened.tracks]
    wanted = [[t.stream.frame(n, t.placement.pose(n)).means for n in range(12)] for t in opened.tracks]
    for hurt, kept in ((1, 0), (0, 1)):
        offset, size = spans[hurt][1]
        for at in [*range(offset - 100, offset + 40, 7), offset + size - 1]:
            bad = bytearray(data)
            bad[at] ^= 0xFF
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                broken = read_scene(bytes(bad))
                means = broken.frame(5).means
            part = means[: len(wanted[0][5])] if kept == 0 else means[-len(wanted[1][5]) :]
            np.testing.assert_array_equal(part, wanted[kept][5], err_msg=f"byte {at}")


def test_a_late_track_does_not_stop_the_others(scene):
    """A file that ends anywhere in the second track shows the first track, and the complete groups of the second."""
    data, opened = scene.read_bytes(), open_scene(scene)
    second = opened.tracks[1].stream.groups
    for end, groups in ((second[0]["offset"] - 20, 0), (second[1]["offset"] + 5, 1)):
        cut = read_scene(data[:end])
        assert not cut.complete
        assert len(cut.tracks[1].stream.groups) == groups
        assert len(cut.frame(5)) == len(opened.tracks[0].stream.frame(5))


def test_hostile_placements_are_named():
    """Any wrong byte of gsvT: no crash, and an error names its place."""
    data = (VECTORS / "tracks.gsv").read_bytes()
    at = data.rindex(b"gsvT")
    (size,) = np.frombuffer(data[at - 4 : at], ">u4")
    told = []
    for i in range(at + 4, at + int(size) - 4):
        for value in (0, 0x7F, 0x80, 0xFF):
            try:
                _native.demux(data[:i] + bytes([value]) + data[i + 1 :], True, 1)
            except GscodecError as e:
                told.append(str(e))
    places = [re.match(r"byte (\d+), gsvT box: expected ", message) for message in told]
    assert len(told) > 20
    assert all(place and at <= int(place[1]) <= at + size for place in places), told


def test_a_track_without_groups_is_described():
    shares = [
        [u["share"] for u in t["units"].values()]
        for t in describe_scene(open_scene(VECTORS / "tracks_hidden.gsv"))["tracks"]
    ]
    assert [0] in shares


def test_sound_of_a_scene(parts, tmp_path):
    """The sound is that of the first track, and stays with its groups."""
    write_tone(tmp_path / "tone.wav", 1.0)
    tone_stream(tmp_path / "loud.gsv", tmp_path / "tone.wav", groups=2)
    run("mux", tmp_path / "loud.gsv", parts / "man.gsv", "-o", tmp_path / "a.gsv")
    before, after = open_stream(tmp_path / "loud.gsv"), open_scene(tmp_path / "a.gsv").tracks[0].stream
    for a, b in zip(before.groups, after.groups, strict=True):
        assert a["audio"][1:] == b["audio"][1:]
        assert before.bytes_at(a["audio"][0], 50) == after.bytes_at(b["audio"][0], 50)
    assert "that of loud is left out" in run("mux", parts / "man.gsv", tmp_path / "loud.gsv", "-o", tmp_path / "b.gsv")
    assert "which is dropped" in run("edit", tmp_path / "a.gsv", "-o", tmp_path / "b.gsv", "--drop", "loud")
    silent = run("edit", tmp_path / "loud.gsv", parts / "man.gsv", "-o", tmp_path / "b.gsv")
    assert f"there is no sound in {parts / 'man.gsv'}, so the file has none" in silent
    assert "audio" not in open_stream(tmp_path / "b.gsv").config
    run("edit", tmp_path / "a.gsv", "-o", tmp_path / "c.gsv", "--frames", "loud=15:30", "--frames", "man=0:4")
    (cut,) = open_scene(tmp_path / "c.gsv").tracks[0].stream.groups
    rate = after.config["audio"]["timescale"]
    assert abs(cut["audio"][1] - (after.groups[1]["audio"][1] - 0.5 * rate)) <= 1
