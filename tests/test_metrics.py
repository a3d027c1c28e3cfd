"""Metrics against values known from their definitions; evaluations with a stand-in for the renderer."""

import json
import sys
import types
import warnings
from dataclasses import replace

import numpy as np
import pytest

from gscodec.capture import Capture, View
from gscodec.errors import UsageError
from gscodec.metrics import (
    TemporalMeter,
    VmafMeter,
    bd_rate,
    codec_cameras,
    evaluate_capture,
    evaluate_splats,
    foreground,
    haze,
    psnr,
    psnr_corrected,
    psnr_fg,
    rising,
    ssim,
)
from gscodec.metrics import vmaf as vmaf_module
from gscodec.model.camera import Camera
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import Gaussians

# keys that scripts read (README, bench)
KEYS = {"frames", "gaussians", "bytes", "kb_per_frame", "bits_per_gaussian_frame", "psnr", "psnr_fg", "ssim", "vmaf"}
KEYS |= {"flicker", "per_frame", "codec_psnr", "codec_psnr_fg"}


def grey(level, h=32, w=40):
    return np.full((h, w, 3), level, np.uint8)


def noise(seed=0, h=64, w=64):
    return np.random.default_rng(seed).integers(0, 256, (h, w, 3), dtype=np.uint8)


# -- images


def test_psnr_of_a_constant_error():
    assert psnr(grey(100), grey(110)) == pytest.approx(20 * np.log10(255 / 10))
    assert psnr(grey(110), grey(100)) == pytest.approx(28.1308, abs=1e-4)  # no wrap-around of u8
    assert psnr(grey(7), grey(7)) == 100


def test_psnr_fg_leaves_the_empty_outside_alone():
    alpha = np.zeros((32, 40), np.uint8)
    alpha[16, 20] = 1
    image = grey(100)
    inside = foreground(alpha)
    assert inside.sum() == sum(x * x + y * y <= 64 for x in range(-8, 9) for y in range(-8, 9))
    image[~inside] += 50
    assert psnr_fg(grey(100), image, alpha) == 100
    assert haze(grey(100), image, alpha) == 50
    assert psnr_fg(grey(100), image, None) == psnr(grey(100), image)
    assert haze(grey(100), image, None) == 0


def test_psnr_corrected_leaves_out_the_colour_of_a_camera():
    image = np.random.default_rng(0).integers(40, 200, (20, 30, 3)).astype(np.uint8)
    reference = np.rint(image * [1.1, 0.9, 1.0] + [5, 10, -8]).astype(np.uint8)
    assert psnr(reference, image) < 30
    assert psnr_corrected(reference, image) > 50
    assert psnr_corrected(image, image, np.zeros((20, 30), bool)) == 100


def test_ssim():
    a = noise()
    assert ssim(a, a) == pytest.approx(1)
    assert ssim(a, 255 - a) < -0.9
    c1 = (0.01 * 255) ** 2  # for two constants only the luminance term is left
    assert ssim(grey(100), grey(120)) == pytest.approx((2 * 100 * 120 + c1) / (100**2 + 120**2 + c1), abs=1e-6)
    with pytest.raises(UsageError, match="at least 11x11 pixels, got 40x5"):
        ssim(grey(0, 5), grey(0, 5))


def test_images_that_cannot_be_compared():
    with pytest.raises(UsageError, match=r"cannot compare uint8 \(5, 40, 3\) with the reference uint8 \(32, 40, 3\)"):
        psnr(grey(0), grey(0, 5))
    with pytest.raises(UsageError, match="expected two uint8 images of one size"):
        haze(grey(0), grey(0).astype(np.float32), None)


# -- over time


def test_flicker_looks_at_still_pixels_only():
    meter = TemporalMeter()
    for t in range(5):
        reference = grey(100)
        reference[:, :20] = 40 * t  # moves
        reference[:, 20] += t % 2  # within 2 levels: still
        image = reference.copy()
        image[:, 30:] += np.uint8(4 * (t % 2))
        meter.add(reference, image)
    still_share, expected = 20, np.std([0, 4, 0, 4, 0])
    own = 1 * np.std([0, 1, 0, 1, 0])  # the column with a varying reference
    assert meter.flicker == pytest.approx((10 * expected + own) / still_share, rel=1e-5)


def test_flicker_within_a_mask_and_without_enough_frames():
    meter, mask = TemporalMeter(), np.zeros((32, 40), bool)
    mask[0, 0] = True
    for t in range(4):
        assert meter.add(grey(100), grey(100 + t), mask) is None
    assert meter.flicker is None
    assert meter.add(grey(100), grey(104), mask) == meter.flicker == pytest.approx(np.std(range(5)))


def test_stability_ignores_a_constant_error():
    meter = TemporalMeter()
    assert meter.stability is None
    for t in range(3):
        meter.add(grey(100 + t), grey(130 + t))
    assert meter.stability == 100
    meter.add(grey(103), grey(143))
    assert meter.stability == pytest.approx((100 + 100 + 20 * np.log10(255 / 10)) / 3)


# -- VMAF


def test_vmaf_of_equal_and_of_blurred_video():
    cv2 = pytest.importorskip("cv2")
    scores = []
    for blur in (0, 3):
        with VmafMeter(30) as meter:
            for t in range(3):
                frame = cv2.GaussianBlur(noise(t, 200, 220), (0, 0), 2)
                meter.add(frame, cv2.GaussianBlur(frame, (0, 0), blur) if blur else frame)
            scores.append(meter.score())
    assert scores[0] > 95
    assert scores[1] < 60


def test_vmaf_crop_holds_the_subject_of_all_frames():
    with VmafMeter(30) as meter:
        for x in (300, 340):
            alpha = np.zeros((400, 800), np.uint8)
            alpha[100:350, x : x + 60] = 9
            meter.add(grey(0, 400, 800), grey(0, 400, 800), alpha)
        crop = meter.crop()
    assert (crop["y"], crop["height"], crop["scale"]) == (84, 282, 1)
    assert crop["width"] == 192  # 132 with margins, so grown
    assert crop["x"] <= 284
    assert crop["x"] + crop["width"] >= 416


def test_vmaf_enlarges_small_images():
    with VmafMeter(30) as meter:
        meter.add(noise(), noise())
        assert meter.crop() == {"x": 0, "y": 0, "width": 64, "height": 64, "scale": 3}
        assert meter.score() > 95


def test_vmaf_refuses(monkeypatch):
    with VmafMeter(30) as meter:
        with pytest.raises(UsageError, match="VMAF of no frames"):
            meter.score()
        meter.add(noise(), noise())
        with pytest.raises(UsageError, match="frames of one size"):
            meter.add(grey(0), grey(0))
        monkeypatch.setattr(vmaf_module, "_ffmpeg", lambda: None)
        with pytest.warns(UserWarning, match="VMAF is left out: the ffmpeg of imageio-ffmpeg has no libvmaf"):
            assert meter.score() is None
        monkeypatch.setattr(vmaf_module, "_ffmpeg", lambda: sys.executable)
        with pytest.raises(RuntimeError, match="ffmpeg failed on VMAF"):
            meter.score()


# -- rate


def curve(factor=1.0, shift=0.0):
    return [(factor * 100 * 2**i, 30 + 3 * i + shift) for i in range(5)]


def test_bd_rate_of_a_part():
    test = [(1, 30), *curve(0.5)[1:]]  # far below at first, then half
    assert bd_rate(curve(), test) < -60
    assert bd_rate(curve(), test, within=(39, 60)) == pytest.approx(-50)
    with pytest.raises(UsageError, match="share no range"):
        bd_rate(curve(), test, within=(43, 45))


def test_points_that_others_beat_are_left_out():
    assert rising([(3, 40), (1, 30), (2, 41), (2, 35), (4, 41)]) == [(1, 30), (2, 41)]


def test_bd_rate_of_known_curves():
    assert bd_rate(curve(), curve()) == pytest.approx(0)
    assert bd_rate(curve(), curve(0.5)) == pytest.approx(-50)
    assert bd_rate(curve(), curve(2)[::-1]) == pytest.approx(100)
    assert bd_rate(curve(), curve(1, 3)) == pytest.approx(-50)  # 3 dB are one octave on this line


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (curve()[:3], "needs at least 4 points, the test curve has 3"),
        (curve(1, 50), "share no range of PSNR .30.00 to 42.00 dB and 80.00 to 92.00 dB."),
        ([*curve()[:3], (50, 39)], "the test curve does not rise in both rate and PSNR"),
        ([(0, 1), *curve()], "rate that is not positive"),
    ],
)
def test_bd_rate_refuses(points, message):
    with pytest.raises(UsageError, match=message):
        bd_rate(curve(), points)


# -- evaluation


def gaussians(n=200, level=0.0):
    rng = np.random.default_rng(0)
    quats = np.tile([1.0, 0, 0, 0], (n, 1)).astype(np.float32)
    f = np.float32
    means = rng.normal(size=(n, 3)).astype(f)
    return Gaussians(
        means, quats, np.zeros((n, 3), f), np.zeros(n, f), np.full((n, 3), level, f), np.zeros((n, 0, 3), f)
    )


@pytest.fixture
def stub(monkeypatch):
    """A renderer that paints the middle half of the image with sh0 of the first Gaussian as grey level."""

    def render_rgba(gaussians, camera):
        out = np.zeros((camera.height, camera.width, 4), np.float32)
        h, w = camera.height // 4, camera.width // 4
        out[h:-h, w:-w] = (*[float(gaussians.sh0[0, 0]) / 255] * 3, 1)
        return out

    def render_image(gaussians, camera, background=(0.5, 0.5, 0.5)):
        x = render_rgba(gaussians, camera)
        return ((x[..., :3] + np.array(background) * (1 - x[..., 3:])) * 255 + 0.5).astype(np.uint8)

    module = types.ModuleType("gscodec.render.image")
    module.render_rgba, module.render_image = render_rgba, render_image
    monkeypatch.setitem(sys.modules, "gscodec.render.image", module)


def capture_of(level, frames=6, alpha=True):
    cameras = [
        Camera(f"c{i}", np.diag([50.0, 50, 1]), np.eye(4), 64, 64, split=s) for i, s in enumerate(("train", "test"))
    ]

    def read(_, frame):
        a = np.zeros((64, 64), np.uint8)
        a[16:48, 16:48] = 255
        rgb = grey(level, 64, 64) if alpha else np.where(a[..., None] > 0, grey(level, 64, 64), 128)
        return View(rgb.astype(np.uint8), a if alpha else None)

    return Capture("toy", 30, cameras, frames, alpha, read)


@pytest.mark.usefixtures("stub")
@pytest.mark.parametrize("alpha", [True, False])
def test_evaluate_capture(alpha):
    seen = []
    report = evaluate_capture(
        lambda t: gaussians(level=110 if t % 2 else 100),
        capture_of(100, alpha=alpha),
        size=6000,
        with_vmaf=False,
        progress=lambda *p: seen.append(p),
    )
    assert set(report) >= KEYS
    json.dumps(report, allow_nan=False)
    assert (report["frames"], report["gaussians"], report["kb_per_frame"]) == (6, 200, 1.0)
    assert report["bits_per_gaussian_frame"] == pytest.approx(40)
    wrong = psnr(grey(0), grey(10)) + 10 * np.log10(4)  # a quarter of the picture is wrong
    assert [r["psnr"] for r in report["per_frame"]] == pytest.approx([100, wrong] * 3)
    assert report["psnr"] == pytest.approx((100 + wrong) / 2)
    assert (report["psnr_fg"] < report["psnr"]) is alpha
    assert report["flicker"] > 0.5
    assert (report["haze"], report["views"], report["vmaf"], report["codec_psnr"]) == (0, ["c1"], None, None)
    assert seen[-1] == (6, 6)


@pytest.mark.usefixtures("stub")
def test_frames_without_the_subject_have_no_psnr_of_it():
    capture = capture_of(100)
    empty = replace(
        capture, read=lambda i, t: replace(capture.read(i, t), alpha=np.full((64, 64), 255 * (t < 3), np.uint8))
    )
    report = evaluate_capture(lambda t: gaussians(level=110), empty, with_vmaf=False)
    assert [r["psnr_fg"] is None for r in report["per_frame"]] == [False] * 3 + [True] * 3
    assert report["psnr_fg"] == report["per_frame"][0]["psnr_fg"]


@pytest.mark.usefixtures("stub")
def test_evaluate_capture_with_vmaf():
    report = evaluate_capture(lambda t: gaussians(level=100), capture_of(100, 2), split="train")
    assert report["vmaf"] > 95
    assert report["vmaf_crop"][0]["scale"] == 3
    assert report["bytes"] is report["kb_per_frame"] is None


def test_evaluate_capture_without_such_cameras():
    with pytest.raises(UsageError, match="toy: no val cameras to evaluate against"):
        evaluate_capture(lambda t: gaussians(), capture_of(0), split="val")


@pytest.mark.usefixtures("stub")
def test_evaluate_splats():
    sequence = GaussianSequence(30, [DenseGroup([gaussians(level=100)] * 3)])
    report = evaluate_splats(lambda t: gaussians(100, level=110), sequence, frames=[0, 2], size=3000)
    assert set(report) >= KEYS
    json.dumps(report, allow_nan=False)
    assert report["codec_psnr_fg"] == pytest.approx(psnr(grey(0), grey(10)))
    assert report["codec_psnr"] == pytest.approx(psnr(grey(0), grey(10)) + 10 * np.log10(4))
    assert (report["frames"], report["kb_per_frame"], report["bits_per_gaussian_frame"]) == (3, 1.0, 40)
    assert [r["frame"] for r in report["per_frame"]] == [0, 2]
    assert report["psnr"] is None


@pytest.mark.usefixtures("stub")
@pytest.mark.parametrize("frames", [[3], [-1], []])
def test_evaluate_splats_outside_the_sequence(frames):
    sequence = GaussianSequence(30, [DenseGroup([gaussians()] * 3)])
    with pytest.raises(UsageError, match="to evaluate, the sequence has 0 to 2"):
        evaluate_splats(lambda t: gaussians(), sequence, frames)


def test_codec_cameras_frame_the_bounding_sphere():
    g = gaussians(5000)
    cameras = codec_cameras([g])
    low, high = np.percentile(g.means, (1, 99), axis=0)
    center, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    assert len(cameras) == 16
    for i, c in enumerate(cameras):
        x, y, z, _ = c.viewmat @ (*center, 1)
        assert (x, y) == pytest.approx((0, 0), abs=1e-9)
        tangent = np.tan(np.arcsin(radius / (z * (1 if i % 2 == 0 else 2))))
        assert c.K[0, 0] * tangent == pytest.approx(256)  # the sphere's outline touches the frame
        assert (c.width, c.K[0, 0] / c.width) == (512, 1.2)
    directions = np.array([(c.center - center) / np.linalg.norm(c.center - center) for c in cameras])
    assert np.abs(directions.mean(0)).max() < 0.05
    with pytest.raises(UsageError, match="no Gaussians to place cameras around"):
        codec_cameras([])


def test_metrics_do_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert psnr(grey(1), grey(1), np.zeros((32, 40), bool)) == 100
