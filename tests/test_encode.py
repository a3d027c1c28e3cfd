"""Encoder: integers keep the content, motion is found, and a file can grow, stop and be resumed."""

import itertools
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from synthetic import assert_close, blob, coded, covariances, encode_sequence, turning

from gscodec import _native
from gscodec.atomic_write import read_arrays, write_arrays
from gscodec.bitstream.color import correlate, decorrelate
from gscodec.bitstream.quantization import steps_for, subject_radius
from gscodec.commands.eval import evaluate_stream
from gscodec.decode import Stream, open_stream
from gscodec.decode.maps import write_maps
from gscodec.encode.axis_order import sorted_axes
from gscodec.encode.coded_form import appearance
from gscodec.encode.coder import CoderState, GroupCoder
from gscodec.encode.encode import StreamOutput, encode_groups, stream_config
from gscodec.encode.measure import measure_group
from gscodec.encode.rdo import coded_layers
from gscodec.encode.rotation_residuals import EXPONENT_UNIT, fit_scale_exponents, quantize_rotations, step_factors
from gscodec.encode.settings import EncodeSettings, PlanSettings, RdoSettings, ScaleExponentSettings
from gscodec.encode.writer import StreamWriter
from gscodec.errors import BitstreamError, CaptureError, LimitError, UsageError
from gscodec.fit import fit_groups
from gscodec.model.camera import Camera, look_at
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import SH_C0, Gaussians, concatenate
from gscodec.model.parametric_group import NodeMotion, ParametricGroup
from gscodec.model.rotations import quat_conjugate, quat_multiply
from gscodec.model.temporal_transform import dct_basis
from gscodec.progress import Bar
from gscodec.render.movie import camera_path


def write(sequence, out, quality=50.0, **settings):
    config = stream_config(fps=sequence.fps, sh_degree=sequence.frame(0).sh_degree, gaussians=400, frames=8)
    return encode_sequence(sequence, out, config, EncodeSettings(quality=quality, **settings), fingerprint={"v": 1})


def nearest(a: Gaussians, b: Gaussians) -> np.ndarray:
    """Index of the Gaussian of `b` nearest to each of `a`."""
    return ((a.means[:, None] - b.means[None]) ** 2).sum(2).argmin(1)


def test_canonical_form_keeps_the_covariance_and_sorts_the_axes():
    g = blob(500)
    order, rotation = sorted_axes(g.log_scales)
    q = quat_multiply(g.quats.astype(float), rotation)
    scales = np.take_along_axis(g.log_scales, order, 1)
    assert (np.diff(scales, axis=1) <= 0).all()
    same = Gaussians(g.means, q.astype(np.float32), scales, g.logit_opacities, g.sh0, g.shN)
    np.testing.assert_allclose(covariances(same), covariances(g), atol=1e-7)


def test_rotations_come_back_and_errors_do_not_add_up():
    g, step = blob(3000), np.array([2e-3, 1e-3, 3e-3], np.float32)
    grid = np.rint(1000 * (g.means + 2)).astype(np.uint32)
    order = _native.morton_order(grid)
    quats, grid = g.quats[order], grid[order]
    layers = coded_layers(grid, [1000, 2000], [1000, 2000])
    plain = np.zeros((3000, 3)), 1.0, RdoSettings(floor=0.0)  # bits cost nothing
    integers, forms = quantize_rotations(
        quats, np.tile(step, (3000, 1)), grid, layers, np.full((3000, 3), 1e9), *plain[1:]
    )
    _, q = coded(DenseGroup([g]), 60, keep_all=True, layers=1)
    channels = {n: replace(c, values=np.zeros_like(c.values)) for n, c in q.channels.items()}
    channels["quats"] = replace(channels["quats"], values=np.ascontiguousarray(integers.T), steps=step)
    still = {"positions": grid, "layers": (1000, 2000), "shifts": None, "corrections": None, "grid_bits": 13}
    q = replace(q, channels=channels, scale_exponents=np.zeros((3, 3), np.int32), **still)
    decoded = _native.DecodedGroup(_native.encode_group(q)[0], 1).frame(0)["quats"]
    inverse = quat_conjugate(np.eye(4))[forms]
    off = quat_multiply(quat_conjugate(decoded.astype(float)), quat_multiply(quats.astype(float), inverse))
    assert (np.abs(off[:, 1:]) < step.sum()).all(), "of three rotations, none off by more than half a step"
    assert np.abs(integers * step).max() < 0.95, "the form that rotates least"


def test_scale_exponents_follow_the_sizes():
    settings = ScaleExponentSettings()
    log_scales = np.random.default_rng(0).normal(-4, 0.3, (5000, 3))
    weights = np.exp(2 * log_scales[:, [1, 0, 0]])
    wanted = np.zeros((3, 3))
    wanted[[0, 1, 2], [1, 0, 0]] = EXPONENT_UNIT * settings.share * 2 / np.log(2)
    exponents = fit_scale_exponents(log_scales, weights, settings)
    np.testing.assert_allclose(exponents, wanted, atol=0.15 * wanted.max())
    equal = weights * step_factors(log_scales, exponents) ** 2
    assert np.log(equal).std() < 0.2 * np.log(weights).std()
    assert not fit_scale_exponents(log_scales[:50], weights[:50], settings).any(), "too few to tell"


def test_dct_is_orthonormal_for_every_length():
    for t in (1, 2, 7, 20):
        np.testing.assert_allclose(dct_basis(t) @ dct_basis(t).T, np.eye(t), atol=1e-12)


def test_colour_transform_inverts():
    x = np.random.default_rng(0).standard_normal((5, 4, 3))
    np.testing.assert_allclose(correlate(decorrelate(x)), x, atol=1e-12)


def test_nodes_carry_a_rigid_motion():
    group = turning(400, frames=8).groups[0]
    fitted = next(fit_groups([group], quality=60))
    assert len(fitted.nodes.positions) == 1, "a rigid body needs one node"
    means = np.stack([g.means for g in group.frames])
    left, moved = np.abs(means - fitted.carried()[0]).max(), np.abs(means - means[4]).max()
    assert left < 3 * steps_for(60, 1.0)["means"] < 0.1 * moved


def test_a_fit_loses_nothing():
    for sequence in (turning(100, frames=5, sh_count=3), turning(100, frames=4, lifetimes=True)):
        fitted = next(fit_groups(sequence.groups))
        for t in range(len(fitted)):
            assert_close(
                sequence.groups[0].visible(t), fitted.visible(t), means=1e-5, log_scales=1e-5, sh0=1e-5, shN=1e-5
            )


def test_a_fitted_group_rests_where_the_group_before_does():
    first, second = fit_groups(changing(), random_access=60)
    known = second.parents >= 0
    np.testing.assert_array_equal(second.canonical.means[known], first.canonical.means[second.parents[known]])
    alone = list(fit_groups(changing(), random_access=60, start=1))
    np.testing.assert_array_equal(alone[0].canonical.means, second.canonical.means)


@pytest.mark.parametrize("sh_count", [0, 3, 8, 15])
def test_stream_keeps_the_content_up_to_order_and_symmetry(tmp_path, sh_count):
    sequence = turning(200, frames=5, sh_count=sh_count)
    write(sequence, tmp_path / "a.gsv", quality=90, keep_all=True)
    stream = open_stream(tmp_path / "a.gsv")
    assert stream.frame_count == 5
    assert stream.fps == 25
    for t in range(5):
        a, b = sequence.frame(t), stream.frame(t)
        i = nearest(a, b)
        assert len(np.unique(i)) == len(a) == len(b)
        b = b.take(i)
        steps = steps_for(90, subject_radius(a.means))
        assert np.abs(a.means - b.means).max() < 4 * steps["means"]
        assert np.abs(a.sh0 - b.sh0).max() < 2 * steps["sh0"]
        assert np.abs(a.logit_opacities - b.logit_opacities).max() < 2 * steps["logit_opacities"]
        ca, cb = covariances(a), covariances(b)
        error = np.linalg.norm(ca - cb, axis=(1, 2)) / np.linalg.norm(ca, axis=(1, 2))
        assert np.median(error) < 0.05
        assert error.max() < 0.3
        if sh_count:
            assert np.abs(a.shN - b.shN).max() < 3 * steps["shN"]


def test_higher_quality_costs_more_and_errs_less(tmp_path):
    sequence = turning(400, frames=4)
    sizes, errors = [], []
    for quality in (20, 50, 80):
        out = tmp_path / f"{quality}.gsv"
        sizes.append(write(sequence, out, quality=quality, keep_all=True).bytes)
        a, b = sequence.frame(2), open_stream(out).frame(2)
        errors.append(float(np.sqrt(((a.means - b.means[nearest(a, b)]) ** 2).mean())))
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 3
    assert errors == sorted(errors, reverse=True)


def test_bitrate_is_met_over_the_file(tmp_path):
    groups = [turning(400, frames=t).groups[0] for t in (4, 6, 2, 4)]
    sequence = turning().with_groups(groups)
    for kilobytes in (0.5, 0.9):
        report = write(sequence, tmp_path / f"{kilobytes}.gsv", bitrate=kilobytes * 8000 * 25)
        assert report.bytes / 16 / 1000 == pytest.approx(kilobytes, rel=0.05)


def test_what_nobody_sees_is_dropped_unless_all_is_to_be_kept(tmp_path):
    g = blob(100)
    faint = g.logit_opacities.copy()
    faint[:30] = -9
    g = Gaussians(g.means, g.quats, g.log_scales, faint, g.sh0, g.shN)
    group = DenseGroup([g])
    assert coded(group, 50)[0].gaussians <= 70
    assert coded(group, 50, keep_all=True)[0].gaussians == 100


def test_an_orbit_is_around_the_first_frame_with_gaussians(tmp_path):
    groups = [DenseGroup([Gaussians.none()]), *turning(60, frames=2).groups]
    write(turning().with_groups(groups), tmp_path / "a.gsv")
    stream = open_stream(tmp_path / "a.gsv")
    last = [list(camera_path(stream, "orbit", None, frames))[-1] for frames in (range(3), range(1, 3))]
    np.testing.assert_array_equal(last[0].viewmat, last[1].viewmat)


def test_lifetimes_survive(tmp_path):
    sequence = turning(120, frames=6, lifetimes=True)
    write(sequence, tmp_path / "a.gsv", keep_all=True)
    stream = open_stream(tmp_path / "a.gsv")
    for t in range(6):
        assert len(stream.frame(t)) == len(sequence.frame(t))


def test_what_lives_in_one_frame_of_a_room_is_measured_there():
    """The Gaussians are inside an opaque shell: only the cameras of the capture see them."""
    frames, each, rng = 20, 4, np.random.default_rng(0)
    shell, inside = (rng.normal(size=(n, 3)) for n in (3000, frames * each))
    shell *= 3 / np.linalg.norm(shell, axis=1, keepdims=True)
    n = len(shell) + len(inside)
    size = np.where(np.arange(n) < len(shell), 0.3, 0.1)[:, None].repeat(3, 1)
    arrays = (np.concatenate([shell, 0.2 * inside]), np.tile([1.0, 0, 0, 0], (n, 1)), np.log(size), np.full(n, 6.0))
    g = Gaussians(*(a.astype(np.float32) for a in (*arrays, np.zeros((n, 3)), np.zeros((n, 0, 3)))))
    t = np.arange(frames * each) // each
    lifetimes = np.concatenate([np.tile([0, frames], (len(shell), 1)), np.stack([t, t + 1], 1)]).astype(np.int32)
    K = np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1.0]])
    eyes = 1.5 * np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]])
    cameras = [Camera(str(i), K, look_at(eye, (0, 0, 0), (0, 1, 0)), 64, 64) for i, eye in enumerate(eyes)]
    removal = measure_group(ParametricGroup(frames, g, None, {}, lifetimes), cameras, PlanSettings()).removal
    assert removal[len(shell) :].reshape(frames, each).max(1).min() > 1e-2 * removal[len(shell) :].max()


def test_what_lives_in_one_frame_matters_if_any_camera_sees_it():
    """Cameras look away from each other, and only one sees each new Gaussian: two views a frame are too few."""
    frames, each, rng = 12, 2, np.random.default_rng(0)
    away = np.array([[1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1.0]])
    K = np.array([[60, 0, 32], [0, 60, 32], [0, 0, 1.0]])
    cameras = [Camera(str(i), K, look_at(0.2 * d, d, (0, 1, 0)), 64, 64) for i, d in enumerate(away)]
    before = away[rng.integers(0, len(away), frames * each)] + rng.normal(scale=0.05, size=(frames * each, 3))
    old = blob(200)
    new = replace(old.take(np.zeros(len(before), int)), means=(1.5 * before).astype(np.float32))
    t = np.arange(len(before)) // each
    lifetimes = np.concatenate([np.tile([0, frames], (len(old), 1)), np.stack([t, t + 1], 1)]).astype(np.int32)
    group = ParametricGroup(frames, concatenate([old, new]), None, {}, lifetimes)
    found = measure_group(group, cameras, PlanSettings())
    for matters in (found.removal, found.weights["means"].sum(1), found.weights["sh0"].sum(1)):
        assert matters[len(old) :].min() > 0.01 * matters[len(old) :].max()


def test_a_trainers_nodes_carry_newcomers_from_where_these_rest():
    """A turning blob; half of it is born late, has its rest position beside the other half and nodes of its own: no
    residual."""
    n, frames = 400, 6
    group = turning(n, frames).groups[0]
    x, young = group.frames[0].means, np.arange(n) >= n // 2
    rest = x + 4 * young[:, None].astype(np.float32) * [1, 0, 0]
    seeds = np.concatenate([np.arange(12), n // 2 + np.arange(12)])
    turn = np.stack([np.tile([0, 0.1 * t, 0.02 * t], (24, 1)) for t in range(frames)])
    moves = np.stack([group.frames[t].means[seeds] for t in range(frames)]) - rest[seeds]
    moves[:, 12:] = np.where(np.arange(frames)[:, None, None] < 3, moves[3:4, 12:], moves[:, 12:])  # still until birth
    turn[:3, 12:] = turn[3, 12:]
    lifetimes = np.stack([np.where(young, 3, 0), np.full(n, frames)], 1).astype(np.int32)
    own = np.where(young, 12, 0)[:, None] + np.arange(4)
    weights = np.full((n, 4), 0.25, np.float32)
    nodes = NodeMotion(*(a.astype(np.float32) for a in (rest[seeds], turn, moves)), own.astype(np.int32), weights)
    trained = ParametricGroup(frames, replace(group.frames[0], means=rest), nodes, {}, lifetimes)
    _, q = coded(trained, 50, keep_all=True)
    assert q.positions[:, 0].max() * q.grid_step > 4, "at their place of rest"
    left = {n: t.coefficients for n, t in q.trajectories.items()}
    assert all(len(c) == 1 for c in left.values()), "only what rounding has left of the canonical, nothing over time"
    assert (left.get("means", np.zeros(1)) != 0).mean() < 0.03


@pytest.mark.parametrize("count", [0, 1, 2])
def test_tiny_groups(tmp_path, count):
    g = blob(5).take(np.arange(count))
    sequence = turning().with_groups([DenseGroup([g, g, g]), DenseGroup([g])])
    write(sequence, tmp_path / "a.gsv", keep_all=True)
    stream = open_stream(tmp_path / "a.gsv")
    assert [len(stream.frame(t)) for t in range(4)] == [count] * 4


def test_frames_in_any_order_are_the_same(tmp_path):
    sequence = turning(60, frames=4)
    sequence = sequence.with_groups([sequence.groups[0]] * 3)
    write(sequence, tmp_path / "a.gsv")
    straight = [open_stream(tmp_path / "a.gsv").frame(t) for t in range(12)]
    stream = open_stream(tmp_path / "a.gsv")
    for t in (11, 0, 5, 6, 1, 10, 3):
        np.testing.assert_array_equal(stream.frame(t).means, straight[t].means)


def changing(frames=6) -> list[DenseGroup]:
    """Two groups of a turning body: in the second group 40 Gaussians are removed and 40 are new."""
    whole = turning(400, frames=2 * frames).groups[0]
    take = lambda t, index: whole.frames[t].take(index)  # noqa: E731
    first, second = np.arange(360), np.arange(400)[::-1][:360]
    parents = np.where(second < 360, second, -1).astype(np.int32)
    return [
        DenseGroup([take(t, first) for t in range(frames)]),
        DenseGroup([take(frames + t, second) for t in range(frames)], parents=parents),
    ]


def test_what_comes_out_is_parametric_again(tmp_path):
    for sh_count, lifetimes in ((3, False), (0, True)):
        write(turning(150, frames=6, sh_count=sh_count, lifetimes=lifetimes), tmp_path / "a.gsv", keep_all=True)
        stream = open_stream(tmp_path / "a.gsv")
        (group,) = stream.sequence().groups
        assert group.nodes is not None
        for t in range(6):
            near = {"means": 1e-5, "log_scales": 1e-5, "sh0": 1e-5, "shN": 1e-5, "opacity": 1e-5}
            assert_close(stream.frame(t), group.visible(t), **near)


def test_trajectories_of_no_gaussian_are_parametric_too():
    stream = open_stream(Path(__file__).parent.parent / "spec" / "vectors" / "valid" / "predicted_nothing_left.gsv")
    group = stream.sequence().groups[1]
    assert (len(group.canonical), "sh0" in group.trajectories) == (0, True)
    values, trajectories = appearance(group, np.zeros((0, 3), int))
    assert values["sh0"].shape == (0, 3)
    assert not trajectories


@pytest.mark.parametrize("layers", [1, 3])
def test_a_predicted_group_costs_less_and_keeps_the_content(tmp_path, layers):
    groups = changing()
    sequence = turning().with_groups(groups)
    alone = write(sequence, tmp_path / "alone.gsv", quality=80, keep_all=True, random_access=0, layers=layers)
    report = write(sequence, tmp_path / "a.gsv", quality=80, keep_all=True, layers=layers)
    assert (alone.predicted, report.predicted) == (0, 1)
    assert report.bytes < 0.85 * alone.bytes
    assert report.units["deaths"] < 100
    stream = open_stream(tmp_path / "a.gsv")
    assert [g["sync"] for g in stream.groups] == [True, False]
    assert stream.group(1).reference == 1
    assert (stream.group(1).parents() < 0).sum() == 40
    independent = open_stream(tmp_path / "alone.gsv")
    for t in (6, 8, 11):  # the predicted group first: a seek
        a = sequence.frame(t)
        errors = []
        for s in (independent, stream):
            b = s.frame(t)
            i = nearest(a, b)
            assert len(np.unique(i)) == len(a) == len(b)
            b = b.take(i)
            ca, cb = covariances(a), covariances(b)
            shape = np.linalg.norm(ca - cb, axis=(1, 2)) / np.linalg.norm(ca, axis=(1, 2))
            errors.append([np.abs(a.means - b.means).mean(), np.abs(a.sh0 - b.sh0).mean(), np.median(shape)])
        assert (np.array(errors[1]) < 1.5 * np.array(errors[0])).all(), errors


def test_layers_have_the_steps_of_their_sensitivity():
    g = blob(3000)
    faint = replace(g, logit_opacities=(g.logit_opacities - 4 * (np.arange(3000) % 2)).astype(np.float32))
    group = DenseGroup([faint])
    _, q = coded(group, 80, keep_all=True, layers=3)
    shifts = dict(zip(("means", *q.channels), q.shifts.T.astype(int), strict=True))
    layer = np.repeat(np.arange(3), q.layers)
    assert all(s.min() == 0 for s in shifts.values())
    assert any(s[2] > s[0] for s in shifts.values())
    for name, c in q.channels.items():
        assert (c.values % 2 ** shifts[name][layer] == 0).all()
    assert (q.positions % 2 ** shifts["means"][layer, None] == 0).all()
    sizes = [len(coded(group, 80, keep_all=True, layers=n)[0].payload) for n in (1, 3)]
    assert sizes[1] < sizes[0]


def test_black_stays_black(tmp_path):
    """The rasterizer clamps colours at 0, so the picture has no derivative by negative colours."""
    g = blob(1000)
    black = np.arange(1000) % 2 == 0
    colors = np.where(black[:, None], -0.5 / SH_C0 - 1e-6, g.sh0).astype(np.float32)
    sequence = GaussianSequence(25.0, [DenseGroup([replace(g, sh0=colors)])])
    write(sequence, tmp_path / "out.gsv")
    decoded = open_stream(tmp_path / "out.gsv").frame(0)
    now = 0.5 + SH_C0 * decoded.sh0[black[nearest(decoded, g)]]
    assert np.quantile(now, 0.99) < 0.02


def test_a_gaussian_that_has_faded_leaves_a_predicted_group():
    """A kept Gaussian costs no bits, but would keep the opacity of the reference."""
    g = blob(300)
    faded = replace(g, logit_opacities=np.where(np.arange(300) < 20, -9, g.logit_opacities).astype(np.float32))
    groups = [DenseGroup([g]), DenseGroup([faded], parents=np.arange(300))]
    first, second = fit_groups(groups, random_access=60)
    coder = GroupCoder(EncodeSettings(refine=0))
    _, state = coder.code(None, first, coder.measure(first, 0), 50, 0)
    coded_second, after = coder.code(state, second, coder.measure(second, 1), 50, 1)
    kept = _native.DecodedGroup(coded_second.payload, 1, reference=state.decoded).quantized().parents
    assert not coded_second.independent
    assert not np.isin(state.lineage[:20], kept).any()
    assert np.isin(after.lineage[20:][after.lineage[20:] >= 0], kept).mean() > 0.95


def test_a_group_that_refers_to_a_damaged_one_is_named(tmp_path):
    write(turning().with_groups(changing()), tmp_path / "a.gsv")
    data = bytearray((tmp_path / "a.gsv").read_bytes())
    group = Stream(data).groups[0]
    data[group["offset"] + 20] ^= 1  # in the group header
    with pytest.raises(BitstreamError, match=r"group 1 .*group 0 .*CRC"):
        Stream(data, strict=False).group(1)


def test_random_access_bounds_the_prediction(tmp_path):
    group = turning(60, frames=4).groups[0]
    same = np.arange(60, dtype=np.int32)
    groups = [group] + [DenseGroup(group.frames, parents=same)] * 4
    for random_access, syncs in ((12, "SPPSP"), (5, "SSSSS"), (0, "SSSSS"), (100, "SPPPP")):
        write(turning().with_groups(groups), tmp_path / "a.gsv", random_access=random_access)
        stream = open_stream(tmp_path / "a.gsv")
        assert "".join("PS"[g["sync"]] for g in stream.groups) == syncs
        assert len(stream.frame(19)) == len(stream.frame(0))


def test_no_prediction_across_a_group_as_long_as_random_access(tmp_path):
    """Not even by the shorter groups around it."""
    group, same = turning(60, frames=8), np.arange(60, dtype=np.int32)
    frames = [group.frame(t) for t in range(8)]
    groups = [DenseGroup(frames[:4]), DenseGroup(frames, parents=same), DenseGroup(frames[:4], parents=same)]
    write(turning().with_groups(groups), tmp_path / "a.gsv", random_access=8)
    stream = open_stream(tmp_path / "a.gsv")
    assert [g["sync"] for g in stream.groups] == [True] * 3
    assert len(stream.frame(15)) == 60


def test_some_frames_are_compared_with_the_same_frames(tmp_path, capsys):
    """`eval --frames`: frame t of the stream beside frame t of the capture, rates of the whole stream."""
    write(turning(60, frames=4), tmp_path / "a.gsv")
    capture = Path(__file__).parent.parent / "examples" / "lumberjack"
    with Bar() as bar:
        measure = partial(evaluate_stream, tmp_path / "a.gsv", capture, split="test", bar=bar)
        whole, last = measure(frames=None), measure(frames="3:4")
    assert [(r["frame"], r["psnr"]) for r in last["per_frame"]] == [(3, whole["per_frame"][3]["psnr"])]
    assert last["kb_per_frame"] == whole["kb_per_frame"] > 0
    assert "a.gsv has 4 frames" in capsys.readouterr().err


def test_maps_replace_all_planes_of_earlier_maps(tmp_path):
    write(turning(60, frames=4), tmp_path / "a.gsv")
    stream, maps = open_stream(tmp_path / "a.gsv"), tmp_path / "maps"
    write_maps(stream, maps)
    planes = set(maps.rglob("*.png"))
    plane = min(p for p in planes if not p.name.endswith(".high.png") and p.with_suffix(".high.png") not in planes)
    plane.with_suffix(".high.png").write_bytes(plane.read_bytes())
    write_maps(stream, maps)
    assert set(maps.rglob("*.png")) == planes


def test_a_group_beyond_the_level_is_refused(tmp_path):
    """The level is in the head of the file, which is written first; a decoder would refuse the group."""
    group = turning(60, frames=4).groups[0]
    config = stream_config(fps=25, sh_degree=0, gaussians=60, frames=4)
    groups = turning().with_groups([group, DenseGroup([group.frame(0)] * 65)])
    with pytest.raises(LimitError, match=r"group 1: .*65 frames, level 1 allows 64; use shorter groups"):
        encode_sequence(groups, tmp_path / "a.gsv", config, EncodeSettings(quality=50, refine=0))
    assert not (tmp_path / "a.gsv").exists()


@pytest.mark.parametrize("parents", [np.zeros(60, int), np.arange(50), np.arange(60) + 1])
def test_parents_that_do_not_fit_are_refused(tmp_path, parents):
    group = turning(60, frames=2).groups[0]
    with pytest.raises(CaptureError, match="parents of a group"):
        write(turning().with_groups([group, DenseGroup(group.frames, parents=parents)]), tmp_path / "a.gsv")


def test_ctrl_c_leaves_a_playable_file_and_a_second_run_goes_on(tmp_path):
    sequence = turning(60, frames=3)
    groups = list(fit_groups([sequence.groups[0]])) * 4
    config = stream_config(fps=25, sh_degree=0, gaussians=100, frames=6)
    out = tmp_path / "a.gsv"

    def interrupted(done, frames):
        assert done == 0
        yield from groups[:2]
        raise KeyboardInterrupt

    first = encode_groups(interrupted, StreamOutput(out, config, {"v": 1}), EncodeSettings())
    assert first.interrupted
    assert open_stream(out).frame_count == 6
    started = []

    def rest(done, frames):
        started.append(done)
        yield from groups[done:]

    second = encode_groups(rest, StreamOutput(out, config, {"v": 1}), EncodeSettings())
    assert started == [2]
    assert not second.interrupted
    assert open_stream(out).frame_count == 12
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.gsv"]
    whole = tmp_path / "b.gsv"
    encode_groups(lambda done, frames: iter(groups), StreamOutput(whole, config), EncodeSettings())
    assert whole.read_bytes() == out.read_bytes()


def test_other_settings_do_not_resume(tmp_path):
    config = stream_config(fps=25, sh_degree=0, gaussians=100, frames=6)
    payload = coded(DenseGroup([blob(5)]), 50)[0].payload
    for fingerprint, found in (({"q": 1}, 0), ({"q": 1}, 1), ({"q": 2}, 0)):
        writer = StreamWriter(tmp_path / "a.gsv", config, fingerprint)
        assert writer.groups == found
        if not found:
            writer.append(payload, 1)
        writer.close()


def test_a_part_cut_anywhere_keeps_its_whole_groups(tmp_path):
    sequence = turning(20, frames=2)
    out = tmp_path / "a.gsv"
    config = stream_config(fps=25, sh_degree=0, gaussians=100, frames=6)
    payload = coded(sequence.groups[0], 50)[0].payload
    writer = StreamWriter(out, config, {})
    ends = [writer.bytes]
    for _ in range(3):
        writer.append(payload, 2)
        ends.append(writer.bytes)
    writer.close()
    data = writer.part.read_bytes()
    assert len(data) == ends[-1]
    for cut in itertools.chain(range(ends[0], len(data), 7), [*ends]):
        stream = Stream(data[:cut])
        assert len(stream.groups) == sum(cut >= e for e in ends[1:])
        writer.part.write_bytes(data[:cut])
        again = StreamWriter(out, config, {})
        assert again.groups == len(stream.groups)
        again.close()
        assert writer.part.stat().st_size == ends[again.groups]


def test_a_changed_input_is_named(tmp_path):
    config = stream_config(fps=25, sh_degree=0, gaussians=100, frames=6)
    StreamWriter(
        tmp_path / "a.gsv", config, {"settings": {"quality": 50}, "input": {"files": {"a.png": [1, 2]}}}
    ).close()
    with pytest.warns(UserWarning, match=r"made differently: a\.png has changed, settings\.quality was 50, is 60"):
        StreamWriter(
            tmp_path / "a.gsv", config, {"settings": {"quality": 60}, "input": {"files": {"a.png": [1, 3]}}}
        ).close()


def test_the_state_of_the_coder_survives_a_file(tmp_path):
    """A resumed run predicts from the same state as an undisturbed run."""
    first, second = fit_groups(changing(), random_access=60)
    coder = GroupCoder(EncodeSettings(refine=0, keep_all=True))
    _, state = coder.code(None, first, coder.measure(first, 0), 60, 0)
    write_arrays(tmp_path / "state.npz", state.to_arrays())
    again = CoderState.from_arrays(read_arrays(tmp_path / "state.npz"))
    payloads = [coder.code(s, second, coder.measure(second, 6), 60, 6)[0].payload for s in (state, again)]
    assert payloads[0] == payloads[1]
    assert CoderState.from_arrays({"quality": np.array(50.0)}) is None


def test_settings_out_of_range_are_refused():
    with pytest.raises(UsageError, match="quality 101"):
        EncodeSettings(quality=101)
    with pytest.raises(UsageError, match="bitrate 0"):
        EncodeSettings(bitrate=0)
    with pytest.raises(UsageError, match="bitrate inf"):
        EncodeSettings(bitrate=float("inf"))


def test_report_is_json(tmp_path):
    report = write(turning(50), tmp_path / "a.gsv")
    facts = json.loads(json.dumps(report.to_json()))
    assert facts["bytes"] == (tmp_path / "a.gsv").stat().st_size
    assert facts["kb_per_frame"] == pytest.approx(facts["bytes"] / 6 / 1000)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_a_scene_changes_nothing(unit):
    g = blob(800)
    other = replace(g, means=np.float32(unit) * g.means, log_scales=g.log_scales + np.float32(np.log(unit)))
    usual, in_unit = (coded(DenseGroup([x]), 50)[0].payload for x in (g, other))
    assert len(in_unit) == pytest.approx(len(usual), rel=0.03)
