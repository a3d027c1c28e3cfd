"""A capture into tracks: the static room is coded once, the subject has groups of its own, and both together are
the scene."""

import dataclasses

import cv2
import numpy as np
import pytest
from interrupting import gscodec
from synthetic import blob, encode_sequence, moved
from test_tracks import fails, payloads, run

from bench.procedural import Scene, placed, write_transforms
from gscodec.capture import open_capture
from gscodec.capture.parts import split_capture
from gscodec.decode import open_scene, open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.settings import EncodeSettings
from gscodec.encode.split import split_stream
from gscodec.encode.subjects import find_subjects
from gscodec.errors import CaptureError
from gscodec.metrics.image import psnr
from gscodec.model.camera import Camera, look_at
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians, concatenate
from gscodec.render.image import render_image

FRAMES = 6
FAST = ("--preset", "fast", "--gop", "3")


def room(t):
    """A floor and a column."""
    floor = placed(False, (1.2, 1.2, 0.05), (0, 0, -0.8), (0.5, 0.5, 0.4))
    return [floor, placed(False, (0.15, 0.15, 0.5), (-0.6, 0.5, -0.3), (0.3, 0.6, 0.3))]


def ball(t):
    """A ball that rises through the room, so that it covers no place in most frames of any camera."""
    return [placed(True, (0.2,) * 3, (-0.5 + 0.2 * t, -0.2, -0.5 + 0.22 * t), (0.9, 0.4, 0.2))]


def drift(t):
    """A ball that moves slowly, in front of the column."""
    return [placed(True, (0.3,) * 3, (0.1 + 0.04 * t, -0.3, -0.2 + 0.03 * t), (0.9, 0.4, 0.2))]


def rig(shapes, masks, size=48):
    return Scene(shapes, frames=FRAMES, train=6, test=1, size=size, masks=masks).capture("room")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with pictures of the room and the ball, and masks of the ball."""
    path = tmp_path_factory.mktemp("capture")
    whole, empty = rig(lambda t: room(t) + drift(t), False), rig(room, False)
    write_transforms(whole, path)
    (path / "masks").mkdir()
    for i, camera in enumerate(whole.cameras):
        for t in range(FRAMES):
            differs = np.abs(whole.view(i, t).rgb.astype(int) - empty.view(i, t).rgb).max(-1) > 8
            cv2.imwrite(str(path / "masks" / f"{camera.name}_{t}.png"), (255 * differs).astype(np.uint8))
    return path


@pytest.fixture(scope="module")
def scene(folder, tmp_path_factory):
    path = tmp_path_factory.mktemp("out") / "scene.gsv"
    assert gscodec("encode", folder, path, "--tracks", "masks", *FAST) == 0
    assert [p.name for p in path.parent.iterdir()] == [path.name], "nothing is left over"
    return path


@pytest.mark.parametrize("by", ["masks", "motion"])
def test_the_still_part_is_what_the_ball_hides_as_well(by):
    size = 96
    whole = pictures = rig(lambda t: room(t) + ball(t), False, size)
    subject, empty = rig(ball, True, size), rig(room, False, size)
    if by == "masks":
        read = lambda i, t: dataclasses.replace(pictures.view(i, t), alpha=subject.view(i, t).alpha)  # noqa: E731
        whole = dataclasses.replace(pictures, has_alpha=True, read=read)
    parts = split_capture(whole, by)
    assert (parts.room.frame_count, parts.room.has_alpha) == (1, False)
    assert (parts.subject.frame_count, parts.subject.has_alpha) == (FRAMES, True)
    for i in range(len(whole.cameras)):
        assert psnr(parts.room.view(i, 0).rgb, empty.view(i, 0).rgb) > 35
        for t in (0, 3, 5):
            true = np.abs(pictures.view(i, t).rgb.astype(int) - empty.view(i, t).rgb).max(-1) > 15
            assert (true & (parts.subject.view(i, t).alpha > 127)).sum() > 0.75 * true.sum()


def test_the_room_is_coded_once_and_the_tracks_are_the_scene(folder, scene):
    opened, whole = open_scene(scene), open_capture(folder)
    subject, still = opened.tracks
    assert [t.placement.name for t in opened.tracks] == ["subject", "room"]
    assert (still.stream.frame_count, still.placement.repeats, len(still.stream.groups)) == (1, 0, 1)
    assert len(subject.stream.groups) == 2
    assert opened.frame_count == FRAMES
    assert len(opened.cameras) == len(whole.cameras)
    assert not still.stream.cameras, "they are written once"
    alone = scene.with_name("room.gsv")
    run("edit", scene, "-o", alone, "--drop", "subject")
    assert [c.name for c in open_scene(alone).cameras] == [c.name for c in whole.cameras]
    alone.unlink()
    for t in (0, FRAMES - 1):
        assert len(opened.frame(t)) == len(subject.stream.frame(t)) + len(still.stream.frame(0))
    i = whole.indices("test")[0]
    for t in range(FRAMES):
        ball = whole.view(i, t).alpha > 127
        seen, both, alone = (
            a[ball]
            for a in (
                whole.view(i, t).rgb,
                render_image(opened.frame(t), whole.cameras[i]),
                render_image(still.stream.frame(0), whole.cameras[i]),
            )
        )
        assert psnr(seen, both) > psnr(seen, alone) + 3, "the ball is there"


def test_a_stopped_run_goes_on_to_the_same_bytes(folder, scene, tmp_path):
    path = tmp_path / "scene.gsv"
    for at in (("keyframe", 20), ("fragment", 1), ("fragment", 1), ("fragment", 2)):
        assert gscodec("encode", folder, path, "--tracks", "masks", *FAST, at=at) < 0
    assert gscodec("encode", folder, path, "--tracks", "masks", *FAST) == 0
    assert path.read_bytes() == scene.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_damaged_subject_leaves_the_room(scene, tmp_path):
    data = bytearray(scene.read_bytes())
    opened = open_scene(scene)
    group = opened.tracks[0].stream.groups[0]
    data[group["offset"] + group["size"] // 2] ^= 255
    path = tmp_path / "damaged.gsv"
    path.write_bytes(data)
    with pytest.warns(UserWarning, match="a track is left out where it is damaged"):
        assert len(open_scene(path).frame(0)) == len(opened.tracks[1].stream.frame(0))
    assert payloads(open_scene(path).tracks[1].stream) == payloads(opened.tracks[1].stream)


def pair(apart):
    """12 frames of a static blob and one that moves away, `apart` at first; groups are predicted from each other."""
    still, other = blob(200, 1), blob(100, 2)
    frames = [concatenate([still, moved(other, [0, 0.1 * t, 0], [apart + 0.2 * t, 0, 0])]) for t in range(12)]
    same = np.arange(len(frames[0]))
    return GaussianSequence(30.0, [DenseGroup(frames[k : k + 4], None, same if k else None) for k in (0, 4, 8)])


@pytest.mark.parametrize("apart", [4.0, 2.1], ids=["apart", "touching at first"])
def test_subjects_that_part_are_told_apart_and_split_without_loss(apart, tmp_path):
    whole = tmp_path / "whole.gsv"
    config = stream_config(fps=30, sh_degree=0, gaussians=300, frames=4)
    encode_sequence(pair(apart), whole, config, EncodeSettings(quality=60, refine=0))
    stream = open_stream(whole)
    assert [stream.group(i).reference for i in range(3)] == [0, 1, 2]
    labels = find_subjects(stream)
    assert [np.bincount(own).tolist() for own in labels] == [[200, 100]] * 3
    outs = [tmp_path / "0.gsv", tmp_path / "1.gsv"]
    split_stream(stream, labels, outs)
    parts = [open_stream(path) for path in outs]
    assert sum(g["size"] for p in parts for g in p.groups) < 1.25 * sum(g["size"] for g in stream.groups)
    for t in (0, 5, 11):
        a, b = stream.frame(t), concatenate([p.frame(t) for p in parts])
        own = labels[t // 4]
        a = a.take(np.concatenate([np.flatnonzero(own == k) for k in range(2)]))
        for name in ("means", "log_scales", "logit_opacities", "sh0"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert psnr(render_image(a, side()), render_image(b, side())) > 40


def test_subjects_are_found_beside_empty_groups_and_later_births(tmp_path):
    """Segments: nothing; both; nothing; one subject, and in a later group both."""
    none, both = DenseGroup([Gaussians.none()]), pair(4.0).groups
    one = replaced(both[0], lambda g: g.take(np.arange(200)))
    born = np.r_[np.arange(200), np.full(100, -1)]
    path = tmp_path / "a.gsv"
    config = stream_config(fps=30, sh_degree=0, gaussians=300, frames=4)
    groups = [none, both[0], none, one, DenseGroup(both[1].frames, None, born)]
    encode_sequence(GaussianSequence(30.0, groups), path, config, EncodeSettings(quality=60, refine=0, random_access=8))
    stream = open_stream(path)
    assert stream.group(4).reference == 1
    labels = find_subjects(stream)
    assert [np.bincount(own).tolist() for own in labels] == [[], [200, 100], [], [200], [200, 100]]


def replaced(group, change):
    return DenseGroup([change(g) for g in group.frames])


def side():
    K = np.array([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]])
    return Camera("c", K, look_at(np.array([2.0, 0.5, -7]), np.array([2.0, 0, 0]), np.array([0, 1.0, 0])), 96, 64)


def test_one_subject_stays_one(tmp_path):
    path = tmp_path / "a.gsv"
    sequence = GaussianSequence(30.0, [DenseGroup([moved(blob(200), [0, 0, 0], [0.1 * t, 0, 0]) for t in range(4)])])
    config = stream_config(fps=30, sh_degree=0, gaussians=200, frames=4)
    encode_sequence(sequence, path, config, EncodeSettings(quality=60, refine=0))
    assert not find_subjects(open_stream(path))[0].any()


def test_what_cannot_be_split_is_said(folder, tmp_path):
    plain = tmp_path / "plain"
    plain.mkdir()
    write_transforms(Scene(ball, frames=4, train=3, test=0, size=24, masks=False, noise=0.02).capture("noise"), plain)
    out = tmp_path / "a.gsv"
    assert "there are no masks" in fails("encode", plain, out, "--tracks", "masks")
    assert "expected masks or motion" in fails("encode", plain, out, "--tracks", "people")
    assert "2 frames, expected 3 or more" in fails("encode", plain, out, "--tracks", "motion", "--frames", "0:2")
    assert "say --quality" in fails("encode", folder, out, "--tracks", "masks", "--bitrate", "1M")
    alpha = tmp_path / "alpha"
    alpha.mkdir()
    write_transforms(rig(ball, True, 24), alpha)
    assert "nothing is known of the room" in fails("encode", alpha, out, "--tracks", "masks")
    moving = Scene(ball, frames=4, train=3, test=0, size=24, masks=True, orbit=3.0).capture("orbit")
    with pytest.raises(CaptureError, match="its cameras move"):
        split_capture(moving, "masks")
    assert not list(tmp_path.glob("a.gsv*"))
