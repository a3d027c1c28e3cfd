"""Refinement: the picture comes nearer to the source for about the same bytes."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import blob, moved

from gscodec import _native
from gscodec.capture import Capture, View
from gscodec.encode.adaptive_rounding import Moving
from gscodec.encode.coder import GroupCoder
from gscodec.encode.intra_group import group_integers
from gscodec.metrics.codec_cameras import codec_cameras
from gscodec.metrics.evaluate import evaluate_splats
from gscodec.model.camera import Calibration
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.render.sensitivity import arrays_of
from gscodec.render.workspace import Workspace


def test_a_refined_frame_is_nearer(monkeypatch):
    monkeypatch.setattr("gscodec.encode.curves.LEAST", 1000)
    group = DenseGroup([blob(1500, sh_count=3)])
    sequence = GaussianSequence(30.0, [group])
    found = []
    for views in (0, 20):
        payload, _ = _native.encode_group(group_integers(group, 60, views=views))
        decoded = Gaussians(**_native.DecodedGroup(payload, 1).frame(0))
        found.append((len(payload), evaluate_splats(lambda _, g=decoded: g, sequence)["codec_psnr"]))
    (plain, before), (refined, after) = found
    assert after > before + 0.1
    assert refined < 1.03 * plain


def test_what_no_view_shows_does_not_move():
    """Squares of such derivatives are 0 in single precision, where Adam would divide by nothing."""
    latents = np.full((1, 1), 0.4)
    part = Moving("sh0", latents, np.zeros((1, 1)), (np.zeros((1, 1)), np.zeros((1, 1))))
    for step, derivative in enumerate((-1e-24, 1e-24, -1e-24), 1):
        part.follow(np.full((1, 1), derivative, np.float32), 0.1, step)
    assert part.change == 0
    part.follow(np.full((1, 1), -1e-2, np.float32), 0.2, 4)
    assert part.change == 1


def test_positions_and_order_stay():
    group = DenseGroup([blob(1200)])
    plain, refined = (group_integers(group, 70, views=n) for n in (0, 3))
    assert np.array_equal(plain["positions"], refined["positions"])
    assert plain["shifts"] == refined["shifts"]


@pytest.mark.parametrize("curves_from", [1000, 10_000])
def test_refined_groups_are_nearer(monkeypatch, curves_from):
    """An independent group and one predicted from it, in which colours change and some Gaussians are not shown."""
    monkeypatch.setattr("gscodec.encode.curves.LEAST", curves_from)
    groups, still, life = [], blob(1500), np.tile(np.array([0, 5], np.int32), (1500, 1))
    life[:300, 1] = 3
    for start in (0, 5):
        frames = [moved(still, [0, 0.04 * t, 0], [0.02 * t, 0, 0]) for t in range(start, start + 5)]
        frames = [replace(f, sh0=f.sh0 * np.float32(np.cos(0.3 * t))) for t, f in enumerate(frames, start)]
        groups.append(DenseGroup(frames, life, parents=np.arange(1500) if start else None))
    found = []
    for views in (0, 40):
        coder = GroupCoder(keep_all=True, layers=2, random_access=60, refine=views)
        first, second = (coder.code(g, 40, 5 * i) for i, g in enumerate(groups))
        assert not second.independent
        reference = _native.DecodedGroup(first.payload, 1)
        decoded = [reference, _native.DecodedGroup(second.payload, 1, reference=reference)]
        shown = lambda t, d=decoded: Gaussians(**d[t // 5].frame(t % 5)).take(d[t // 5].visible(t % 5))  # noqa: E731
        sequence = GaussianSequence(30.0, groups)
        near = [evaluate_splats(shown, sequence, r)["codec_psnr"] for r in (range(5), range(5, 10))]
        found.append(([len(first.payload), len(second.payload)], near))
    (plain, before), (refined, after) = found
    assert all(b > a + 0.05 for a, b in zip(before, after, strict=True))
    assert all(b < 1.03 * a for a, b in zip(plain, refined, strict=True))


def pictures_of(truth, cameras, gains):
    """A capture of `truth`, frame by frame, by cameras that show it brighter by `gains`."""

    def read(i, t):
        image, alpha = Workspace().forward(arrays_of(truth[t]), cameras[i], (0, 0, 0))
        rgb = gains[i] * image / np.maximum(alpha, 1e-3)[..., None]
        return View(*(np.rint(255 * x.clip(0, 1)).astype(np.uint8) for x in (rgb, alpha)))

    return Capture("synthetic", 30.0, cameras, len(truth), True, read)


@pytest.mark.parametrize("frames", [1, 4])
def test_a_trained_group_comes_nearer_to_its_pictures(frames):
    """What training has left wrong, too, here the colours; each picture in the brightness of its camera."""
    truth = [moved(blob(600), [0, 0.05 * t, 0], [0, 0, 0]) for t in range(frames)]
    cameras = [
        replace(c, K=c.K / 8 + np.diag([0, 0, 7 / 8]), width=64, height=64, split="train") for c in codec_cameras(truth)
    ]
    gains = np.geomspace(0.7, 1 / 0.7, len(cameras), dtype=np.float32)[:, None].repeat(3, 1)
    wrong = np.random.default_rng(1).normal(0, 0.15, truth[0].sh0.shape).astype(np.float32)
    model = [replace(g, sh0=g.sh0 + wrong) for g in truth]
    capture, calibration = pictures_of(truth, cameras, gains), Calibration(np.tile(np.eye(4), (16, 1, 1)), gains)
    found = []
    for told in (None, calibration):
        coder = GroupCoder(keep_all=True, layers=1, random_access=60, refine=80, capture=capture)
        coded = coder.code(DenseGroup(model, calibration=told), 50, 0)
        decoded = _native.DecodedGroup(coded.payload, 1)
        shown = lambda t, d=decoded: Gaussians(**d.frame(t))  # noqa: E731
        near = evaluate_splats(shown, GaussianSequence(30.0, [DenseGroup(truth)]))["codec_psnr"]
        found.append((len(coded.payload), near))
    (plain, before), (refined, after) = found
    assert after > before + 0.5
    assert refined < 1.1 * plain
