"""Sequences of splats: tracked frames are recognised, stored sequences read back the same, damage is named."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from synthetic import gaussians

from gscodec.errors import CaptureError, UsageError
from gscodec.model.camera import Calibration, Camera
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import NodeMotion, ParametricGroup
from gscodec.splats import SequenceWriter, detect_input, open_sequence, read_splat, write_sequence, write_splat
from gscodec.splats.parametric_file import to_arrays
from gscodec.splats.tracking import match, relate

FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


def moved(g, t):
    """Rigid motion: turned about z by 0.02 rad a frame."""
    c, s = np.cos(0.02 * t), np.sin(0.02 * t)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Gaussians(g.means @ turn.T, *(getattr(g, f) for f in FIELDS[1:]))


def save_frames(folder, frames):
    folder.mkdir(exist_ok=True)
    for t, g in enumerate(frames):
        write_splat(folder / f"f{t}.ply", g)
    return folder


def test_tracked_folder(tmp_path):
    g = gaussians(500)
    save_frames(tmp_path / "s", [moved(g, t) for t in range(12)])
    (tmp_path / "s" / "._f0.ply").write_bytes(b"\0\5\x16\7")  # macOS adds such files
    s = open_sequence(tmp_path / "s", gop=5, fps=24)
    assert (s.mode, s.fps, [len(x) for x in s.groups]) == ("tracked", 24, [5, 5, 2])
    assert s.names[10] == "f10.ply"  # natural order: f2 before f10
    np.testing.assert_allclose(s.frame(11).means, moved(g, 11).means, atol=1e-6)


def test_shuffled_folder_is_matched(tmp_path):
    g, rng = gaussians(500), np.random.default_rng(1)
    frames = [moved(g, 0.2 * t) for t in range(4)]
    frames = [frames[0]] + [f.take(rng.permutation(500)) for f in frames[1:3]] + [frames[3]]
    s = open_sequence(save_frames(tmp_path / "s", frames))
    assert (s.mode, len(s.groups)) == ("matched", 1)
    for t in range(4):
        np.testing.assert_allclose(s.frame(t).means, moved(g, 0.2 * t).means, atol=1e-5)
        np.testing.assert_allclose(s.frame(t).sh0, g.sh0, atol=1e-6)


def test_locally_swapped_indices_are_not_called_tracked():
    """Like frames sorted along a curve: index i stays near, but a third of the Gaussians swap with neighbours."""
    a = gaussians(2000).means
    b = a + np.float32(0.001)
    swap = np.arange(2000)
    by_x = np.argsort(a[:, 0])
    pairs = by_x[: 2 * 330].reshape(-1, 2)
    swap[pairs[:, 0]], swap[pairs[:, 1]] = pairs[:, 1].copy(), pairs[:, 0].copy()
    order = relate(a, b[swap])
    assert order is not True
    np.testing.assert_allclose(b[swap][order], b, atol=1e-7)


def test_jitter_is_still_tracked():
    a = gaussians(2000).means
    noise = np.random.default_rng(2).normal(size=a.shape) * 0.02
    assert relate(a, a + noise.astype(np.float32)) is True


def test_unrelated_frames_are_independent(tmp_path):
    frames = [gaussians(200, seed=1), gaussians(200, seed=2), gaussians(150, seed=3)]
    s = open_sequence(save_frames(tmp_path / "s", frames))
    assert (s.mode, [len(g) for g in s.groups]) == ("independent", [1, 1, 1])


def test_a_cut_starts_a_group(tmp_path):
    a, b = gaussians(200, seed=1), gaussians(220, seed=2)
    s = open_sequence(save_frames(tmp_path / "s", [a, moved(a, 1), b, moved(b, 1), moved(b, 2)]))
    assert (s.mode, [len(g) for g in s.groups]) == ("tracked", [2, 3])
    assert (len(s.frame(1)), len(s.frame(2))) == (200, 220)


def test_match_leaves_the_rest_to_an_assignment():
    a = np.random.default_rng(0).uniform(size=(300, 3))
    b = a.copy()
    b[7], b[9] = a[9] + 0.3, a[9] + 0.4  # no point has either as its nearest
    order = match(a, b)
    assert sorted(order) == list(range(300))
    assert match(a, b + 5) is None


def test_single_files_and_tiny_frames(tmp_path):
    write_splat(tmp_path / "a.ply", gaussians(3))
    write_splat(tmp_path / "b.ply", gaussians(3))
    assert open_sequence(tmp_path / "a.ply").frame_count == 1
    assert open_sequence(tmp_path).mode == "tracked"
    write_splat(tmp_path / "b.ply", gaussians(3, seed=4))
    assert open_sequence(tmp_path).mode == "independent"


def stored_sequence():
    g = gaussians(50, 3)
    lifetimes = np.stack([np.zeros(50), np.full(50, 4)], 1).astype(np.int32)
    lifetimes[:5] = (1, 3)
    camera = Camera("a", np.diag([9.0, 9, 1]), np.eye(4), 32, 24, split="test")
    groups = [DenseGroup([moved(g, t) for t in range(4)], lifetimes), DenseGroup([gaussians(40, 3, 9)])]
    return GaussianSequence(25, groups, [camera])


def parametric_group():
    """A group with all parts of a trained group."""
    random = np.random.default_rng(0)

    def values(*shape):
        return random.normal(size=shape).astype(np.float32)

    weights = random.uniform(size=(50, 4)).astype(np.float32)
    neighbors = random.integers(0, 6, (50, 4)).astype(np.int32)
    nodes = NodeMotion(values(6, 3), values(4, 6, 3), values(4, 6, 3), neighbors, weights / weights.sum(1)[:, None])
    trajectories = {"means": values(3, 3, 50), "sh0": values(2, 3, 50)}
    lifetimes = np.tile(np.array([0, 4], np.int32), (50, 1))
    lifetimes[:5] = (1, 3)
    told = Calibration(random.normal(size=(2, 4, 4)), values(4, 2, 3), values(4, 2, 3))
    return ParametricGroup(4, gaussians(50, 3), nodes, trajectories, lifetimes, None, told, rate_optimized=True)


def test_a_parametric_group_survives_a_folder_exactly(tmp_path):
    group = parametric_group()
    write_sequence(GaussianSequence(25, [group]), tmp_path)
    (again,) = open_sequence(tmp_path).groups
    assert isinstance(again, ParametricGroup)
    a, b = to_arrays(group), to_arrays(again)
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    shown = read_splat(tmp_path / "000002.ply")
    np.testing.assert_array_equal(shown.means, group.frame(2).means, "other tools see the same")


def test_edited_frames_are_taken_as_they_are(tmp_path):
    write_sequence(GaussianSequence(25, [parametric_group()]), tmp_path)
    g = read_splat(tmp_path / "000001.ply")
    write_splat(tmp_path / "000001.ply", replace(g, sh0=g.sh0 + 1))
    with pytest.warns(UserWarning, match="frames 0 to 3 were changed"):
        (group,) = open_sequence(tmp_path).groups
    assert isinstance(group, DenseGroup)
    np.testing.assert_allclose(group.frame(1).sh0, g.sh0 + 1, atol=1e-6)


def test_sequence_round_trip(tmp_path):
    source = stored_sequence()
    seen = []
    write_sequence(source, tmp_path / "s", seen.append)
    assert seen == [1, 2, 3, 4, 5]
    s = open_sequence(tmp_path / "s")
    assert (s.mode, s.fps, s.frame_count, s.cameras[0].split) == ("stored", 25, 5, "test")
    for ours, theirs in zip(s.groups, source.groups, strict=True):
        for a, b in zip(ours.frames, theirs.frames, strict=True):
            for name in FIELDS:
                np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-6)
    np.testing.assert_array_equal(s.groups[0].lifetimes, source.groups[0].lifetimes)
    assert (len(s.frame(0)), len(s.frame(1))) == (45, 50)
    assert (read_splat(tmp_path / "s/000000.ply").logit_opacities[:5] == -30).all()  # hidden from other tools


def test_files_of_another_format_are_no_frames_of_a_stored_sequence(tmp_path):
    write_sequence(GaussianSequence(25, [parametric_group()]), tmp_path)
    write_splat(tmp_path / "000000.spz", gaussians(3))
    s = open_sequence(tmp_path)
    assert s.names == [f"{t:06}.ply" for t in range(4)]
    assert isinstance(s.groups[0], ParametricGroup), "no frame was changed"


def test_writer_goes_on_after_a_stop(tmp_path):
    groups = stored_sequence().groups
    SequenceWriter(tmp_path, 25).add(groups[0])
    assert open_sequence(tmp_path).frame_count == 4
    writer = SequenceWriter(tmp_path, 25, resume=True)
    assert (writer.frame_count, len(writer.groups)) == (4, 1)
    writer.add(groups[1])
    assert open_sequence(tmp_path).frame_count == 5


def test_frames_are_lazy_and_thread_safe(tmp_path):
    g = gaussians(100)
    s = open_sequence(save_frames(tmp_path / "s", [moved(g, t) for t in range(8)]))
    wrong = []

    def check():
        for t in range(8):
            if not np.allclose(s.groups[0].frames[t].means, moved(g, t).means, atol=1e-6):
                wrong.append(t)

    threads = [threading.Thread(target=check) for _ in range(3)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert not wrong
    (tmp_path / "s/f7.ply").unlink()
    assert len(s.groups[0].frames[2:][1]) == 100
    with pytest.raises(IndexError):
        s.groups[0].frames[8]


def edit(folder, change):
    data = json.loads((folder / "sequence.json").read_text())
    change(data)
    (folder / "sequence.json").write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("fps"), "not valid .KeyError: 'fps'"),
        (lambda d: d.update(fps=-1), "at -1.0 frames a second"),
        (lambda d: d.update(groups=[]), "0 groups at"),
        (lambda d: d["groups"][1].update(start=3), "group 1 is 1 frames from 3, expected to start at 4"),
        (lambda d: d["groups"][1].update(frames=9), "group 1 is 9 frames from 4, .* within the 5 splats"),
        (lambda d: d["groups"][0].update(extra="none.npz"), "none.npz: missing or damaged"),
    ],
)
def test_bad_sequence_json(tmp_path, change, message):
    write_sequence(stored_sequence(), tmp_path)
    edit(tmp_path, change)
    with pytest.raises(CaptureError, match=message):
        open_sequence(tmp_path)


@pytest.mark.parametrize("size", [0, 500])
def test_a_cut_file_of_a_group(tmp_path, size):
    write_sequence(stored_sequence(), tmp_path)
    npz = tmp_path / "group_0000.npz"
    npz.write_bytes(npz.read_bytes()[:size])
    with pytest.raises(CaptureError, match=r"group_0000.npz: missing or damaged"):
        open_sequence(tmp_path)


def test_lifetimes_that_do_not_fit(tmp_path):
    write_sequence(stored_sequence(), tmp_path)
    write_splat(tmp_path / "000000.ply", gaussians(20, 3))
    with pytest.raises(CaptureError, match=r"000000.ply: 20 Gaussians, sequence.json has lifetimes of 50"):
        open_sequence(tmp_path).frame(0)


def test_sequence_arguments(tmp_path):
    with pytest.raises(CaptureError, match="no splats, expected one file per frame"):
        open_sequence(tmp_path)
    with pytest.raises(UsageError, match="gop 0 and fps None must be positive"):
        open_sequence(tmp_path, gop=0)


def test_detect_input(tmp_path):
    with pytest.raises(
        CaptureError, match=r"neither a capture nor splats; looked for transforms.json.*Qualisys.*splats"
    ):
        detect_input(tmp_path)
    with pytest.raises(CaptureError, match="no such file or folder"):
        detect_input(tmp_path / "gone")
    (tmp_path / "a.jpg").touch()
    with pytest.raises(CaptureError, match="1 images, but no calibration"):
        detect_input(tmp_path)
    write_splat(tmp_path / "a.ply", gaussians(2))
    assert detect_input(tmp_path) == detect_input(tmp_path / "a.ply") == "splats"
    (tmp_path / "transforms.json").write_text("{}")
    assert detect_input(tmp_path) == "capture"  # an initial point cloud may lie beside it
