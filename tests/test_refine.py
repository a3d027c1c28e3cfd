"""Refinement: pictures come nearer to the source at about the same bytes."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic import blob, coded, moved

from gscodec import _native
from gscodec.capture import Capture, View
from gscodec.encode.adaptive_rounding import AdaptiveRounding
from gscodec.encode.coder import GroupCoder
from gscodec.encode.quality_search import choose_quality
from gscodec.encode.rounding_variables import Latents
from gscodec.encode.settings import CompandingSettings, EncodeSettings, RoundingSettings
from gscodec.fit import fit_groups
from gscodec.metrics.codec_cameras import codec_cameras
from gscodec.metrics.evaluate import evaluate_splats
from gscodec.model.camera import Calibration
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians
from gscodec.render.cpu import CpuBackend
from gscodec.render.optimizer import Adam
from gscodec.render.sensitivity import arrays_of, params_of
from gscodec.render.workspace import Workspace
from gscodec.train.refinement import PictureRefinement


def small_cameras(frames):
    """Training cameras of 64 x 64 pixels around the frames."""
    small = {"width": 64, "height": 64, "split": "train"}
    return [replace(c, K=c.K / 8 + np.diag([0, 0, 7 / 8]), **small) for c in codec_cameras(frames)]


def test_a_refined_frame_is_nearer():
    group = DenseGroup([blob(1500, sh_count=3)])
    sequence = GaussianSequence(30.0, [group])
    found = []
    for views in (0, 20):
        payload = coded(group, 60, refine=views, companding=CompandingSettings(least=1000))[0].payload
        decoded = Gaussians(**_native.DecodedGroup(payload, 1).frame(0))
        found.append((len(payload), evaluate_splats(lambda _, g=decoded: g, sequence)["codec_psnr"]))
    (plain, before), (refined, after) = found
    assert after > before + 0.1
    assert refined < 1.03 * plain


def test_what_no_view_shows_does_not_move():
    """Squares of tiny derivatives are 0 in single precision: Adam would divide by 0."""
    zero, settings = np.zeros((1, 1)), RoundingSettings()
    latents = Latents(np.full((1, 1), 0.4), zero, (zero, zero), settings)
    adam = Adam(CpuBackend(), settings.adam)
    for derivative, rate, change in ((-1e-24, 0.1, 0), (1e-24, 0.1, 0), (-1e-24, 0.1, 0), (-1e-2, 0.2, 1)):
        adam.step({"sh0": latents.values}, {"sh0": np.full((1, 1), derivative, np.float32)}, {"sh0": rate})
        latents.round()
        assert latents.change == change


def test_positions_and_order_stay():
    group = DenseGroup([blob(1200)])
    plain, refined = (coded(group, 70, refine=n)[1] for n in (0, 3))
    np.testing.assert_array_equal(plain.positions, refined.positions)
    np.testing.assert_array_equal(plain.shifts, refined.shifts)
    assert (plain.channels["sh0"].values != refined.channels["sh0"].values).any()


@pytest.mark.parametrize("curves_from", [1000, 10_000])
def test_refined_groups_are_nearer(curves_from):
    """An independent group and one predicted from it; colours change and some Gaussians are not shown."""
    groups, still, life = [], blob(1500), np.tile(np.array([0, 5], np.int32), (1500, 1))
    life[:300, 1] = 3
    for start in (0, 5):
        frames = [moved(still, [0, 0.04 * t, 0], [0.02 * t, 0, 0]) for t in range(start, start + 5)]
        frames = [replace(f, sh0=f.sh0 * np.float32(np.cos(0.3 * t))) for t, f in enumerate(frames, start)]
        groups.append(DenseGroup(frames, life, parents=np.arange(1500) if start else None))
    found = []
    for views in (0, 40):
        companding = CompandingSettings(least=curves_from)
        coder = GroupCoder(EncodeSettings(keep_all=True, layers=2, refine=views, companding=companding))
        done, state = [], None
        for i, g in enumerate(fit_groups(groups, random_access=60)):
            result, state = coder.code(state, g, coder.measure(g, 5 * i), 40, 5 * i)
            done.append(result)
        first, second = done
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
    """A capture of `truth`, frame by frame, by cameras with the given gains."""

    def read(i, t):
        image, alpha = Workspace().forward(arrays_of(truth[t]), cameras[i], (0, 0, 0))
        rgb = gains[i] * image / np.maximum(alpha, 1e-3)[..., None]
        return View(*(np.rint(255 * x.clip(0, 1)).astype(np.uint8) for x in (rgb, alpha)))

    return Capture("synthetic", 30.0, cameras, len(truth), True, read)


@pytest.mark.parametrize(("attribute", "gain"), [("sh0", 0.5), ("log_scales", 0.3)])
@pytest.mark.parametrize("frames", [1, 4])
def test_a_trained_group_comes_nearer_to_its_pictures(frames, attribute, gain):
    """Refinement also lowers errors of training, here in colours or sizes; each picture has its camera's brightness."""
    truth = [moved(blob(600), [0, 0.05 * t, 0], [0, 0, 0]) for t in range(frames)]
    cameras = small_cameras(truth)
    gains = np.geomspace(0.7, 1 / 0.7, len(cameras), dtype=np.float32)[:, None].repeat(3, 1)
    wrong = np.random.default_rng(1).normal(0, 0.15, (600, 3)).astype(np.float32)
    model = [replace(g, **{attribute: getattr(g, attribute) + wrong}) for g in truth]
    capture = pictures_of(truth, cameras, gains)
    calibration = replace(Calibration.plain(16, frames), gains=gains[None].repeat(frames, 0))
    found = []
    for told in (None, calibration):
        settings = EncodeSettings(keep_all=True, layers=1, refine=80)
        coder = GroupCoder(settings, refine_by_pictures=PictureRefinement(capture, views=80))
        group = replace(next(fit_groups([DenseGroup(model)])), calibration=told)
        result, _ = coder.code(None, group, coder.measure(group, 0), 50, 0)
        decoded = _native.DecodedGroup(result.payload, 1)
        shown = lambda t, d=decoded: Gaussians(**d.frame(t))  # noqa: E731
        near = evaluate_splats(shown, GaussianSequence(30.0, [DenseGroup(truth)]))["codec_psnr"]
        found.append((len(result.payload), near))
    (plain, before), (refined, after) = found
    assert after > before + gain
    assert refined < 1.1 * plain


@pytest.mark.parametrize("views", [1, 2])
def test_rotations_fit_the_sizes_after_few_pictures(views):
    truth = [moved(blob(300), [0, 0.05 * t, 0], [0, 0, 0]) for t in range(2)]
    cameras = [replace(c, split="train") for c in codec_cameras(truth)[:3]]
    group = next(fit_groups([DenseGroup(truth)]))
    group = replace(group, calibration=Calibration.plain(3, 2))
    coder = GroupCoder(EncodeSettings(keep_all=True, layers=1))
    rounding = AdaptiveRounding(coder.quantized(group, coder.measure(group, 0), 50), coder.settings)
    capture = pictures_of(truth, cameras, np.ones((3, 3), np.float32))
    rounding.follow(PictureRefinement(capture).pictures(group, 0, views), views, 2.0)
    decoded = _native.DecodedGroup.reconstruct(rounding.quantized().integers, None)
    for t in range(2):
        for name in ("quats", "log_scales"):
            np.testing.assert_allclose(getattr(rounding.frame(t), name), decoded.frame(t)[name], atol=1e-4)


def test_a_cleaner_capture_gets_a_finer_quality():
    """Without a given quality, coding loses the dB that the settings allow, measured on the pictures of the capture."""
    truth = [blob(400)]
    cameras = small_cameras(truth)
    calibration, chosen = Calibration.plain(16, 1), []
    refine = PictureRefinement(pictures_of(truth, cameras, calibration.gains[0]))
    coder = GroupCoder(EncodeSettings(layers=1), refine_by_pictures=refine)
    for noise in (0.05, 0.2):
        wrong = np.random.default_rng(1).normal(0, noise, truth[0].sh0.shape).astype(np.float32)
        model = replace(truth[0], sh0=truth[0].sh0 + wrong)
        group = replace(next(fit_groups([DenseGroup([model])])), calibration=calibration)
        chosen.append(choose_quality(coder, group, coder.measure(group, 0), 0))
    clean, noisy = chosen
    assert 30 < noisy < clean - 3 < 87


def test_masks_that_are_wrong_do_not_lower_the_quality():
    truth = [blob(400)]
    calibration, chosen = Calibration.plain(16, 1), []
    capture = pictures_of(truth, small_cameras(truth), calibration.gains[0])
    holes = np.zeros((64, 64), bool)
    holes[26:38, 26:38] = True  # in the middle of the subject

    def pierced(camera: int, frame: int) -> View:
        view = capture.read(camera, frame)
        return replace(view, alpha=np.where(holes & (camera % 4 == 0), 0, view.alpha).astype(np.uint8))

    wrong = np.random.default_rng(1).normal(0, 0.05, truth[0].sh0.shape).astype(np.float32)
    model = replace(truth[0], sh0=truth[0].sh0 + wrong)
    group = replace(next(fit_groups([DenseGroup([model])])), calibration=calibration)
    for pictures in (capture, replace(capture, read=pierced)):
        coder = GroupCoder(EncodeSettings(layers=1), refine_by_pictures=PictureRefinement(pictures))
        chosen.append(choose_quality(coder, group, coder.measure(group, 0), 0))
    assert abs(chosen[0] - chosen[1]) < 5


def test_what_refinement_has_chosen_is_not_undone_by_a_predicted_group():
    """Unchanged attributes cost no bits, except positions: trajectories correct them where the error is visible."""
    truth = [blob(400, sh_count=3)]
    cameras = small_cameras(truth)
    calibration = Calibration.plain(16, 1)
    capture = pictures_of(truth * 2, cameras, calibration.gains[0])
    coder = GroupCoder(EncodeSettings(layers=1), refine_by_pictures=PictureRefinement(capture))
    wrong = np.random.default_rng(1).normal(0, 0.1, truth[0].sh0.shape).astype(np.float32)
    still = DenseGroup([replace(truth[0], sh0=truth[0].sh0 + wrong)])
    first, second = fit_groups([still, replace(still, parents=np.arange(400))], random_access=60)
    first, second = (replace(g, calibration=calibration) for g in (first, second))
    coded, state = coder.code(None, first, coder.measure(first, 0), 50, 0)
    assert any(r.any() for r in state.form.rounding.values())
    again, _ = coder.code(state, second, coder.measure(second, 1), 50, 1)
    changed = {u["attribute"] for u in again.units if u["type"] == "trajectories"}
    assert not again.independent
    assert changed <= {"means"}
    assert len(again.payload) < 0.1 * len(coded.payload)


def test_a_group_whose_harmonics_turn_comes_nearer_to_its_pictures():
    """The quantizer renders the same as a decoder, and moves harmonics in their coded form: at rest."""
    still, wrong = blob(400, sh_count=8), np.random.default_rng(1).normal(0, 0.2, (400, 8, 3)).astype(np.float32)
    group = next(fit_groups([DenseGroup([moved(still, [0, 0.5 * t, 0], [0, 0, 0]) for t in range(4)])]))
    truth = replace(group, canonical=replace(group.canonical, shN=still.shN), trajectories={}, turned_harmonics=True)
    off = replace(truth.canonical, shN=still.shN + wrong)
    group, shown = (
        replace(truth, canonical=off, calibration=Calibration.plain(16, 4)),
        [truth.frame(t) for t in range(4)],
    )
    cameras = small_cameras(shown)
    coder = GroupCoder(EncodeSettings(keep_all=True, layers=1))
    rounding = AdaptiveRounding(coder.quantized(group, coder.measure(group, 0), 50), coder.settings, only=("shN",))
    capture = pictures_of(shown, cameras, np.ones((16, 3), np.float32))

    def error():
        images = CpuBackend()
        pictures = PictureRefinement(capture).pictures(group, 0, 64, seed=1)
        return np.mean(
            [np.mean((images.render(params_of(rounding.frame(t)), c, b)[0] - p) ** 2) for t, c, b, p in pictures]
        )

    before = error()
    rounding.follow(PictureRefinement(capture).pictures(group, 0, 200), 200, 0.1)
    assert error() < 0.8 * before
    decoded = _native.DecodedGroup.reconstruct(rounding.quantized().integers, None)
    for t in (0, 3):
        np.testing.assert_allclose(rounding.frame(t).shN, decoded.frame(t)["shN"], atol=1e-4)
