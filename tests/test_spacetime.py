"""Moving scenes: Spacetime Gaussians from and to streams, by the library and the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import blob, encode_sequence, moved, turning
from test_cli import fails, run

from gscodec.commands.sources import _restricted
from gscodec.decode import open_stream
from gscodec.encode.encode import stream_config
from gscodec.encode.measure import measure_group
from gscodec.encode.settings import EncodeSettings, PlanSettings
from gscodec.errors import UsageError
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.model.parametric_group import ParametricGroup
from gscodec.splats import open_sequence, read_splat, spacetime_fit, write_sequence
from gscodec.splats.spacetime import SpacetimeGaussians, spacetime_groups
from gscodec.splats.spacetime_fit import fit_spacetime
from gscodec.splats.splatv import ROW, read_splatv, splatv_header, write_splatv

GOLDEN = Path(__file__).parent / "data" / "splats" / "spacetime.splatv"  # made by: see test_splat_formats.py
FRAMES = 12


def scene(n=80, seed=3):
    """Gaussians; half of them stay, half appear and disappear."""
    r, g = np.random.default_rng(seed), blob(n)
    centers, widths = r.uniform(0.1, 0.9, n), np.where(np.arange(n) % 2, r.uniform(0.1, 0.4, n), np.inf)
    motion, turn = 0.3 * r.standard_normal((3, n, 3)), 0.5 * r.standard_normal((n, 4))
    rest = Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, np.clip(g.sh0, -1.5, 1.5), g.shN)
    return SpacetimeGaussians(rest, motion, turn, centers, widths)


def sequence(frames=FRAMES, gop=FRAMES):
    return GaussianSequence(10.0, spacetime_groups(scene(), np.arange(frames) / frames, gop))


def same_frames(a, b, t, limit):
    """Checks for the same Gaussians in the same order, with opacities, positions and rotations within `limit`."""
    assert len(a) == len(b), t
    np.testing.assert_allclose(a.means, b.means, atol=limit)
    alpha = lambda g: 1 / (1 + np.exp(-g.logit_opacities))  # noqa: E731
    np.testing.assert_allclose(alpha(a), alpha(b), atol=limit)
    np.testing.assert_allclose(np.abs((a.quats * b.quats).sum(1)), 1, atol=limit)


def test_a_splatv_comes_back(tmp_path):
    given = scene()
    write_splatv(tmp_path / "a.splatv", given, FRAMES, 10.0)
    back = open_sequence(tmp_path / "a.splatv")
    assert (back.fps, back.frame_count) == (10.0, FRAMES)
    assert len(read_splatv(tmp_path / "a.splatv")) == 80  # padding of the texture is left out
    for t in (0, 5, 11):
        same_frames(back.frame(t), given.at(t / FRAMES).take(given.shown(t / FRAMES)), t, 0.01)


def test_a_splatv_is_what_others_write(tmp_path):
    theirs = np.fromfile(GOLDEN, ROW, 5, offset=splatv_header(GOLDEN).start)
    write_splatv(tmp_path / "a.splatv", read_splatv(GOLDEN), 50, 30.0)
    ours = np.fromfile(tmp_path / "a.splatv", ROW, 5, offset=splatv_header(tmp_path / "a.splatv").start)
    drawn = theirs[theirs["quats"].any(1)]
    for name in ROW.names:
        np.testing.assert_array_equal(ours[: len(drawn)][name], drawn[name], name)
    assert not ours[len(drawn) :]["quats"].any()  # padding of the texture row is not drawn


def test_the_fit_finds_the_scene():
    given = sequence()
    found = fit_spacetime(given, [np.arange(len(g.frame(0).means)) for g in given.groups])
    for t in range(FRAMES):
        all_given, all_found = given.groups[0].frame(t), found.at(t / FRAMES)
        life = given.groups[0].lifetimes
        shown = (life[:, 0] <= t) & (t < life[:, 1]) & (life[:, 1] - life[:, 0] > 5)  # few frames fit many cubics
        same_frames(all_found.take(shown), all_given.take(shown), t, 0.03)


def test_the_fit_knows_gaussians_across_groups():
    given = sequence(gop=5)
    parents = [g.parents for g in given.groups]
    identities, known = [], 0
    for own, g in zip(parents, given.groups, strict=True):
        new = known + np.arange(len(g.frame(0)))
        identities.append(new if own is None else np.where(own >= 0, identities[-1][own], new))
        known += len(new)
    _, numbers = np.unique(np.concatenate(identities), return_inverse=True)
    cuts = np.cumsum([len(i) for i in identities])[:-1]
    found = fit_spacetime(given, np.split(numbers, cuts))
    assert len(found) <= 82
    stays = np.isinf(found.widths)
    assert stays.sum() >= 35


def test_the_fit_is_bounded(monkeypatch):
    monkeypatch.setattr(spacetime_fit, "VALUES_MAX", 100)
    given = sequence()
    with pytest.raises(UsageError, match=r"Gaussians in 12 frames, expected 1 to 100 in all for a \.splatv"):
        fit_spacetime(given, [np.arange(80)])
    with pytest.raises(UsageError, match="0 Gaussians in 0 frames"):
        fit_spacetime(GaussianSequence(1.0, []), [])


def config(frames=FRAMES):
    return stream_config(fps=10.0, sh_degree=0, gaussians=100, frames=frames)


def test_identities_follow_predicted_groups(tmp_path):
    g = blob(60)
    frames = [moved(g, np.zeros(3), np.array([0.02 * t, 0, 0])) for t in range(8)]
    same = np.arange(60, dtype=np.int32)
    groups = [DenseGroup(frames[:4]), DenseGroup(frames[4:], parents=same)]
    settings = EncodeSettings(quality=60, keep_all=True, doubt=1e9, refine=0)
    encode_sequence(GaussianSequence(10.0, groups), tmp_path / "a.gsv", config(), settings)
    stream = open_stream(tmp_path / "a.gsv")
    first, second = stream.identities()
    assert stream.group(1).quantized().reference == 1
    assert sorted(first) == sorted(second) == list(range(60))
    a, b = (Gaussians(**stream.group(i).frame(t)) for i, t in ((0, 3), (1, 0)))
    place = np.argsort(first)[second]
    assert np.linalg.norm(a.means[place] - b.means, axis=1).max() < 0.1


def test_gaussians_between_three_frames_are_measured():
    g = blob(100)
    life = np.tile(np.array([0, 30], np.int32), (100, 1))
    life[:10] = [3, 9]  # not in the first, the middle or the last frame
    group = ParametricGroup(30, g, lifetimes=life)
    found = measure_group(group, [], PlanSettings())
    whole = measure_group(ParametricGroup(30, g), [], PlanSettings())
    share = found.removal[:10].sum() / whole.removal[:10].sum()
    assert 0.1 < share < 0.4  # they live for a fifth of the time


def test_a_range_of_frames_drops_who_does_not_live_in_it():
    given = sequence(frames=20, gop=10)
    cut = _restricted(given, "4:14")
    assert [len(g) for g in cut.groups] == [6, 4]
    for g in cut.groups:
        assert (g.lifetimes[:, 0] < g.lifetimes[:, 1]).all()
        assert len(g.lifetimes) == len(g.frame(0))
    for t in (0, 5, 6, 9):
        same_frames(cut.frame(t), given.frame(t + 4), t, 1e-6)
    first, second = cut.groups
    known = second.parents >= 0
    np.testing.assert_allclose(first.frame(5).log_scales[second.parents[known]], second.frame(0).log_scales[known])


# -- the command line


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    """A .splatv and the stream made of it."""
    path = tmp_path_factory.mktemp("spacetime")
    write_splatv(path / "a.splatv", scene(), FRAMES, 10.0)
    done = run("encode", path / "a.splatv", path / "a.gsv", "--quality", 70, "--gop", 6, "--refine", 0)
    assert done.returncode == 0, done.stderr
    assert "index i is the same Gaussian in all frames of a group" in done.stderr
    return path / "a.gsv"


def test_decode_to_a_splatv(stream, tmp_path):
    done = run("decode", stream, tmp_path / "b.splatv")
    assert done.returncode == 0, done.stderr
    assert "over 12 frames" in done.stdout
    assert open_sequence(tmp_path / "b.splatv").frame_count == FRAMES
    fails(run("decode", stream, tmp_path / "c.splatv", "--frames", "0:2"), "made of the whole stream")


@pytest.mark.parametrize("form", ["spz", "glb", "ply"])
def test_decode_some_frames(stream, tmp_path, form):
    done = run("decode", stream, tmp_path, "--format", form, "--frames", "3:5")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"00000{t}.{form}" for t in (3, 4)]
    if form != "glb":
        assert len(read_splat(tmp_path / f"000004.{form}")) == len(open_stream(stream).frame(4))
    fails(run("decode", stream, tmp_path, "--format", "obj"), "--format obj: expected ply, spz, glb, drc")


def test_a_jumping_scene_is_no_splatv(tmp_path):
    g, r = blob(200), np.random.default_rng(0)
    frames = [moved(g, r.standard_normal(3), np.zeros(3)) for _ in range(8)]
    write_sequence(GaussianSequence(10.0, [DenseGroup(frames)]), tmp_path / "plys")
    assert run("encode", tmp_path / "plys", tmp_path / "a.gsv", "--refine", 0).returncode == 0
    fails(run("decode", tmp_path / "a.gsv", tmp_path / "a.splatv"), "the motion is no .splatv", "expected 30 or more")
    assert not (tmp_path / "a.splatv").exists()


def test_eval_of_a_part_counts_the_frames_of_the_stream(tmp_path):
    write_splatv(tmp_path / "a.splatv", scene(), FRAMES, 10.0)
    assert run("encode", tmp_path / "a.splatv", tmp_path / "a.gsv", "--frames", "0:4", "--refine", 0).returncode == 0
    facts = json.loads(run("eval", tmp_path / "a.gsv", tmp_path / "a.splatv", "--json").stdout)
    assert facts["frames"] == 4
    assert facts["kb_per_frame"] == pytest.approx((tmp_path / "a.gsv").stat().st_size / 4000)


def test_info_of_splats(stream, tmp_path):
    done = run("info", stream.with_name("a.splatv"))
    assert ".splatv (Spacetime Gaussians, antimatter15), 12 frames at 10 fps" in done.stdout
    write_sequence(turning(20, frames=2), tmp_path / "plys")
    facts = json.loads(run("info", tmp_path / "plys", "--json").stdout)
    assert (facts["format"], facts["frames"], facts["gaussians"]) == ("3DGS .ply", 2, 20)
    (tmp_path / "bad.spz").write_bytes(b"no")
    fails(run("info", tmp_path / "bad.spz"), "not a .spz")
    fails(run("info", tmp_path / "bad.splatv"), "no such file or folder")
    (tmp_path / "transforms.json").write_text("{}")
    fails(run("info", tmp_path), "no 'frames', expected a transforms.json")
