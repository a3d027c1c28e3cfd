"""Rigs: files, skin weights, prediction, and streams with a rig: smaller, exact, posed anew."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import training
from quantized_groups import assert_same, layered_group, moving_group, predicted_group
from scipy.spatial import cKDTree

from bench.articulated import JOINTS, PARENTS, figure, pose, skin, walk, wave, write_rig
from bench.rig import capture_of
from gscodec import _native
from gscodec.bitstream.quantized_group import QuantizedRig
from gscodec.decode import open_stream
from gscodec.decode.maps import write_maps
from gscodec.decode.parametric import parametric_group
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.from_maps import encode_maps
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import CaptureError, UsageError
from gscodec.fit import fit_groups
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.rig import Rig, RigMotion
from gscodec.model.rig_file import read_rig
from gscodec.model.rotations import quat_to_matrix, quat_to_rotvec, rotvec_to_quat
from gscodec.model.skin_weights import integer_weights, skin_weights
from gscodec.splats import write_sequence
from gscodec.splats.parametric_file import from_arrays, to_arrays
from gscodec.train.train import train_groups

LEVEL, FRAMES, GOP = 1, 12, 6


def run(*args):
    """Runs `gscodec ARGS` in its own process."""
    code = "import sys; from gscodec.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, *map(str, args)], capture_output=True, text=True)


@pytest.fixture(scope="module")
def walker():
    return figure(900, FRAMES, GOP, fps=8.0)


def encode(walker, path, rig, quality=45.0):
    """Encodes the figure as a stream; returns its bytes."""
    config = stream_config(fps=8, sh_degree=0, gaussians=900, frames=GOP)
    settings = EncodeSettings(quality, refine=0, random_access=FRAMES)

    def groups(done, _):
        return fit_groups(walker.sequence.groups, start=done, random_access=FRAMES, quality=quality, rig=rig)

    return encode_groups(groups, StreamOutput(path, config), settings).bytes


def error(stream, walker):
    """Mean distance of each coded Gaussian to the nearest input Gaussian."""
    near = [cKDTree(walker.sequence.frame(t).means).query(stream.frame(t).means)[0] for t in range(FRAMES)]
    return np.concatenate(near).mean()


@pytest.fixture(scope="module")
def streams(walker, tmp_path_factory):
    """Folder with the figure as splats, its rig, and the streams with and without the rig."""
    folder = tmp_path_factory.mktemp("rig")
    write_sequence(walker.sequence, folder / "plys")
    write_rig(walker.rig, folder / "rig.npz")
    write_rig(replace(walker.rig, poses=wave(FRAMES, 8.0)), folder / "wave.npz")
    encode(walker, folder / "plain.gsv", None)
    encode(walker, folder / "rig.gsv", walker.rig)
    return folder


def motion_bytes(path):
    """Bytes of all units of node motion."""
    stream = open_stream(path)
    units = [u for i in range(len(stream.groups)) for u in _native.units(stream.payload(i))]
    return sum(u["bytes"] for u in units if u["type"] in ("node_trajectories", "rig", "joint_poses"))


def test_a_rig_makes_motion_cheaper_and_better(streams, walker):
    plain, rigged = (streams / f"{name}.gsv" for name in ("plain", "rig"))
    assert motion_bytes(rigged) < 0.75 * motion_bytes(plain)
    assert error(open_stream(rigged), walker) < 0.9 * error(open_stream(plain), walker)


def test_prediction_is_linear_blend_skinning():
    rng = np.random.default_rng(1)
    poses = rng.normal(size=(3, len(JOINTS), 6)).astype(np.float32)
    bind = poses[1]
    shares = integer_weights(rng.random((7, len(JOINTS))))
    x = rng.normal(size=(7, 3))

    def joints(pose):
        out = []
        for j, p in enumerate(PARENTS):
            own, R = np.eye(4), quat_to_matrix(rotvec_to_quat(pose[j, :3].astype(float)))
            own[:3, :3], own[:3, 3] = R, JOINTS[j] + pose[j, 3:] - R @ JOINTS[j]
            out.append(own if p == j else out[p] @ own)
        return np.array(out)

    at, turned = RigMotion(JOINTS, PARENTS, bind, poses, shares).at(x)
    for t in range(3):
        moves = joints(poses[t]) @ np.linalg.inv(joints(bind))
        blended = np.einsum("mj,jab->mab", shares / 64, moves)
        expected = np.einsum("mab,mb->ma", blended, np.concatenate([x, np.ones((7, 1))], 1))[:, :3]
        np.testing.assert_allclose(at[t], expected, atol=2e-5)
    np.testing.assert_allclose(at[1], x, atol=1e-5)
    np.testing.assert_allclose(np.abs(turned[1][:, 0]), 1, atol=1e-5)


def test_residual_and_total_are_inverse():
    rng = np.random.default_rng(2)
    weights = integer_weights(rng.random((9, len(JOINTS))))
    weights[4] = 0
    motion = RigMotion(JOINTS, PARENTS, walk(9)[4], walk(9), weights)
    nodes = rng.normal(size=(9, 3)).astype(np.float32)
    turns, shifts = (0.3 * rng.normal(size=(2, 9, 9, 3))).astype(np.float32)
    back = motion.total(nodes, *motion.residual(nodes, turns, shifts))
    np.testing.assert_allclose(back[1], shifts, atol=1e-5)
    np.testing.assert_allclose(
        np.abs((rotvec_to_quat(back[0]) * rotvec_to_quat(turns)).sum(-1)), 1, atol=1e-5, err_msg="the same rotations"
    )
    np.testing.assert_allclose(motion.residual(nodes, turns, shifts)[1][:, 4], shifts[:, 4], atol=1e-6)


@pytest.mark.parametrize("skinned", [True, False], ids=["by its skin", "by its bones"])
def test_weights_say_which_joint_moves_a_place(skinned):
    g, weights = skin(2000)
    skin_of = (g.means, weights.astype(np.float32)) if skinned else (None, None)
    rig = Rig(JOINTS, PARENTS, walk(10), *skin_of)
    posed = rig.posed(7, g.means, integer_weights(weights))
    found = skin_weights(rig, 7, posed)
    assert (found.sum(1) == 64).all()
    clear = weights.max(1) > 0.9
    assert (found.argmax(1) == weights.argmax(1))[clear].mean() > (0.98 if skinned else 0.85)
    assert not skin_weights(rig, 7, posed + np.array([0, 0, 3])).any(), "far away"


def test_a_figure_without_a_skin_is_predicted_too(walker, streams, tmp_path):
    bones = replace(walker.rig, vertices=None, weights=None)
    encode(walker, tmp_path / "a.gsv", bones)
    assert motion_bytes(tmp_path / "a.gsv") < 0.8 * motion_bytes(streams / "plain.gsv")


def rigged_group(group):
    """The group with a rig of three joints."""
    rng = np.random.default_rng(3)
    m, frames = len(group.nodes.positions), group.frames
    rig = QuantizedRig(
        joints=rng.integers(-2000, 2000, (3, 3)).astype(np.int32),
        parents=np.array([0, 0, 1], np.uint8),
        bind=rng.integers(-90, 90, (3, 6)).astype(np.int32),
        weights=integer_weights(rng.random((m, 3)) * (rng.random((m, 3)) < 0.5)),
        poses=rng.integers(-40, 40, (frames, 6, 3)).astype(np.int32),
        rotation_step=0.0078125,
        translation_step=0.00390625,
    )
    return replace(group, nodes=replace(group.nodes, rig=rig))


@pytest.mark.parametrize("make", [moving_group, layered_group])
def test_integers_come_back(make):
    group = rigged_group(make(300))
    payload, _ = _native.encode_group(group)
    decoded = _native.DecodedGroup(payload, LEVEL)
    assert_same(group, decoded.quantized())
    reconstructed, first = _native.DecodedGroup.reconstruct(group), decoded.frame(2)
    np.testing.assert_array_equal(reconstructed.frame(2)["means"], first["means"])
    floats = parametric_group(decoded).frame(2)
    np.testing.assert_allclose(floats.means, first["means"], atol=1e-4 * np.abs(first["means"]).max())


def test_a_predicted_group_has_a_rig_of_its_own():
    known = rigged_group(layered_group(300))
    reference = _native.DecodedGroup(_native.encode_group(known)[0], LEVEL)
    group = predicted_group(reference.quantized())
    payload, _ = _native.encode_group(group, reference)
    assert_same(group, _native.DecodedGroup(payload, LEVEL, reference=reference).quantized())


def test_what_does_not_fit_is_refused():
    group = rigged_group(moving_group(100))

    def refused(words, **change):
        rig = replace(group.nodes.rig, **change)
        with pytest.raises(ValueError, match=words):
            _native.encode_group(replace(group, nodes=replace(group.nodes, rig=rig)))

    rig = group.nodes.rig
    refused("weights of 0 to 64", weights=np.full_like(rig.weights, 65))
    refused("parent of a joint before it", parents=np.array([1, 1, 1], np.uint8))
    refused(r"weights: expected shape \[30, J\]", weights=rig.weights[1:])
    refused(r"joints: expected shape \[J, 3\]", joints=rig.joints[:, :2])
    refused("trajectories of joints", poses=rig.poses[:, :5])
    with pytest.raises(ValueError, match="J, 6"):
        RigMotion(JOINTS, PARENTS, np.zeros((2, 6)), walk(2), np.zeros((1, 16))).at(np.zeros((1, 3)))


def test_maps_give_the_same_bytes(streams, tmp_path):
    stream = open_stream(streams / "rig.gsv")
    write_maps(stream, tmp_path)
    encode_maps(tmp_path, tmp_path / "again.gsv", None)
    assert (tmp_path / "again.gsv").read_bytes() == (streams / "rig.gsv").read_bytes()


def test_the_command_encodes_and_poses_anew(streams, walker, tmp_path):
    options = ("--gop", GOP, "--refine", 0, "--random-access", FRAMES, "--quality", 45)
    done = run("encode", streams / "plys", tmp_path / "a.gsv", "--rig", streams / "rig.npz", *options)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.gsv").stat().st_size == (streams / "rig.gsv").stat().st_size
    done = run("edit", tmp_path / "a.gsv", "-o", tmp_path / "b.gsv", "--pose", streams / "wave.npz")
    assert done.returncode == 0, done.stderr
    walked, waved = open_stream(tmp_path / "a.gsv"), open_stream(tmp_path / "b.gsv")
    for i in range(len(walked.groups)):
        parts = [_units(s.payload(i)) for s in (walked, waved)]
        assert [k for k in parts[0] if parts[0][k] != parts[1][k]] == ["group_header 0 0", "joint_poses 0 0"]
    g, weights = skin(900)
    truth = pose(g, weights, wave(FRAMES, 8.0), fps=8.0)
    posed = replace(walker, sequence=GaussianSequence(8.0, [DenseGroup(truth)]))
    assert error(waved, posed) < 2.2 * error(walked, walker)
    for t in (0, 3, FRAMES - 1):
        there, here = _gap(waved, posed, t), _gap(walked, walker, t)
        assert there < 1.5 * here, "no more holes than before"


def _gap(stream, given, t):
    """99th percentile of the distance from a given Gaussian to the nearest one of the stream."""
    return np.quantile(cKDTree(stream.frame(t).means).query(given.sequence.frame(t).means)[0], 0.99)


def _units(payload):
    return {
        f"{u['type']} {u['layer']} {u['index']}": payload[u["offset"] : u["offset"] + u["bytes"]]
        for u in _native.units(payload)
    }


def fails(done, *words):
    assert done.returncode == 1, done.stdout
    assert "Traceback" not in done.stderr
    assert all(w in done.stderr for w in words), done.stderr


def test_wrong_poses_are_refused(streams, tmp_path):
    out, rig = tmp_path / "b.gsv", streams / "rig.gsv"
    short, few = tmp_path / "short.npz", tmp_path / "few.npz"
    write_rig(Rig(JOINTS, PARENTS, walk(FRAMES - 1), *_no_skin()), short)
    write_rig(Rig(JOINTS[:3], PARENTS[:3], walk(FRAMES)[:, :3], *_no_skin(3)), few)
    fails(run("edit", rig, "-o", out, "--pose", short), "11 frames", "12")
    fails(run("edit", streams / "plain.gsv", "-o", out, "--pose", streams / "rig.npz"), "has no rig")
    fails(run("edit", rig, "-o", out, "--pose", few), "16 joints", "of 3")
    fails(run("encode", streams / "plys", out, "--rig", short), "11 frames", "12 frames")
    assert not out.exists()


def _no_skin(joints=16):
    return np.zeros((1, 3), np.float32), np.ones((1, joints), np.float32)


WRONG = {
    "has no joints_rest": {"joints_rest": None},
    "has no rotations, expected an array of shape [T, 16, 3]": {"rotations": None},
    "rotations has shape [12, 3, 3], expected [T, 16, 3]": {"rotations": np.zeros((12, 3, 3))},
    "translations has shape [5, 3], expected [12, 3]": {"translations": np.zeros((5, 3))},
    "must be finite": {"rotations": np.full((12, 16, 3), np.nan)},
    "must be finite numbers": {"joints_rest": np.full((16, 3), "a")},
    "0 joints": {"joints_rest": np.zeros((0, 3))},
    "parents must be -1 for a root": {"parents": np.full(16, 3)},
    "weights has shape [2, 3]": {"weights": np.zeros((2, 3))},
    "one of each vertex above 0": {"weights": np.zeros((225, 16))},
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_files_are_named(words, streams, tmp_path):
    arrays = {**np.load(streams / "rig.npz"), **WRONG[words]}
    np.savez(tmp_path / "wrong.npz", **{n: a for n, a in arrays.items() if a is not None})
    with pytest.raises(CaptureError) as e:
        read_rig(tmp_path / "wrong.npz")
    assert words in str(e.value)
    assert "wrong.npz" in str(e.value)


def test_what_is_no_npz_is_named(tmp_path):
    (tmp_path / "a.npz").write_text("no")
    for path in (tmp_path / "a.npz", tmp_path / "missing.npz"):
        with pytest.raises(CaptureError, match="expected a rig"):
            read_rig(path)


def test_translations_of_all_joints_or_none(streams, tmp_path):
    arrays = dict(np.load(streams / "rig.npz"))
    root = arrays.pop("translations")
    np.savez(tmp_path / "none.npz", **arrays)
    assert not read_rig(tmp_path / "none.npz").poses[..., 3:].any()
    every = np.zeros((FRAMES, 16, 3))
    every[:, 0] = root
    np.savez(tmp_path / "every.npz", **arrays, translations=every)
    np.testing.assert_array_equal(read_rig(tmp_path / "every.npz").poses, read_rig(streams / "rig.npz").poses)


def test_whole_turns_make_no_jump(tmp_path):
    poses = walk(FRAMES)
    poses[:, 0, 1] = np.linspace(0, 3 * np.pi, FRAMES)
    jumps = Rig(JOINTS, PARENTS, poses.copy(), *_no_skin())
    jumps.poses[:, 0, :3] = quat_to_rotvec(rotvec_to_quat(jumps.poses[:, 0, :3]))
    write_rig(jumps, tmp_path / "turns.npz")
    assert np.abs(np.diff(jumps.poses[:, 0, 1])).max() > 3
    np.testing.assert_allclose(read_rig(tmp_path / "turns.npz").poses, poses, atol=1e-4)


TINY = replace(training.TINY, motion_steps=40, gaussians_max=700, initial_points=500, sh_degree=0)


@pytest.fixture(scope="module")
def trained():
    """Trained groups of a fast walk, without and with its rig, the figure, and its capture."""
    walker = figure(1500, 5, 5, fps=6.0)
    capture = capture_of(walker)
    return [list(train_groups(capture, TINY, rig=rig)) for rig in (None, walker.rig)], walker, capture


def test_training_follows_the_rig(trained):
    (plain, rigged), walker, _ = trained
    assert all(g.nodes.rig is None for g in plain if g.nodes)
    first = rigged[0]
    assert len(first) == 3, "no group is cut"
    _, shifts = first.nodes.rig.residual(first.nodes.positions, first.nodes.rotations, first.nodes.translations)
    assert np.abs(shifts).mean() < 0.3 * np.abs(first.nodes.translations).mean(), "the residual is small"
    np.testing.assert_array_equal(first.nodes.rig.poses, walker.rig.poses[:3])


def test_the_folder_of_train_keeps_the_rig(trained):
    group = trained[0][1][0]
    again = from_arrays(to_arrays(group))
    for name in ("joints", "parents", "bind", "poses", "weights"):
        np.testing.assert_array_equal(getattr(again.nodes.rig, name), getattr(group.nodes.rig, name))


def test_training_goes_on_with_its_rig(trained, tmp_path):
    (_, rigged), walker, capture = trained
    assert len(rigged) > 1
    groups = train_groups(capture, TINY, rig=walker.rig, checkpoints=tmp_path)
    next(groups)
    groups.close()
    later = next(train_groups(capture, TINY, first_frame=len(rigged[0]), rig=walker.rig, checkpoints=tmp_path))
    np.testing.assert_array_equal(later.nodes.translations, rigged[1].nodes.translations)
    np.testing.assert_array_equal(later.nodes.rig.poses, rigged[1].nodes.rig.poses)


def test_a_stream_without_a_rig_cannot_be_posed(streams):
    from gscodec.encode.reposing import reposed

    with pytest.raises(UsageError, match="encode the stream with --rig"):
        reposed(open_stream(streams / "plain.gsv"), 0, read_rig(Path(streams / "rig.npz")).frames(range(GOP)))
