"""Keyframes of tiny captures with known truth: initial points, calibration, densification, harmonics."""

import dataclasses

import numpy as np
import pytest
import torch
from synthetic import blob, turning
from training import TINY, arc, capture_of, psnr_of, rig, splat_wall

from bench.train import coded
from gscodec.capture.capture import Capture
from gscodec.capture.images import View
from gscodec.capture.points import Points
from gscodec.encode.settings import EncodeSettings
from gscodec.model.camera import Camera, look_at, meeting_point
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import PARAMETERS
from gscodec.render.cpu import CpuBackend
from gscodec.render.image import render_image, render_rgba
from gscodec.train.calibration import Extrinsics
from gscodec.train.far_shell import far_shell
from gscodec.train.initialization import initial_model
from gscodec.train.keyframe import Statistics, add_opacity_decay, densify, move_at_random, prune, train_keyframe
from gscodec.train.model import from_gaussians
from gscodec.train.plane_sweep import sweep, unproject
from gscodec.train.sparse_points import triangulated
from gscodec.train.train import train_groups
from gscodec.train.views import Views, add_harmonics_prior
from gscodec.train.visual_hull import hull_points, project


@pytest.fixture(scope="module")
def capture():
    return capture_of(turning(300, frames=5))


def test_axes_meet_where_the_cameras_look():
    np.testing.assert_allclose(meeting_point(rig()), 0, atol=1e-6)


def test_hull_lies_on_the_subject(capture):
    views = [(c, capture.view(i, 0).rgb, capture.view(i, 0).alpha) for i, c in enumerate(capture.cameras)]
    points, colors = hull_points(capture.cameras, views, 500, TINY.visual_hull)
    assert 300 < len(points) < 800
    distance = np.linalg.norm(points, axis=1)
    assert np.median(distance) == pytest.approx(1.1, abs=0.2), "a sphere of radius 1, and the width of its Gaussians"
    assert colors.min() >= 0
    assert colors.max() <= 1


def test_sweep_finds_a_textured_wall():
    """A wall y = 0 of coloured splats, seen from an arc in front of it: the points lie on it."""
    wall, cameras = splat_wall(), arc()
    views = [(c, render_image(wall, c, (0, 0, 0)), None) for c in cameras]
    points, colors = sweep(views, 1000, 0, TINY.plane_sweep)
    assert len(points) == len(colors) == 1000
    assert (np.abs(points[:, 1]) < 0.22).mean() > 0.9, "a plane and a half: they are 0.15 apart there"


def test_far_shell_is_opaque_and_far():
    """White pictures give a white shell: it fills every picture before black, and lies far behind the wall."""
    views = [(c, np.full((c.height, c.width, 3), 255, np.uint8), None) for c in arc()]
    shell = far_shell(views, TINY.far_shell).gaussians()
    assert (shell.means[:, 1] > 8).all()
    middles = [render_image(shell, c, (0, 0, 0))[8:-8, 8:-8] for c, _, _ in views]  # shell ends where no camera looks
    assert min(m.min() for m in middles) > 225


def test_nothing_around_a_scene_without_masks_grows_up_to_the_cameras():
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([blob(50)])]), masks=False)
    views, model = Views(capture, TINY, CpuBackend()), from_gaussians(blob(50))
    model.start_optimizer(CpuBackend(), TINY.adam, views.size_bound)
    model.step({"log_scales": torch.full((50, 3), -1.0)}, {"log_scales": 100.0})
    nearest = min(np.linalg.norm(c.center - model.params["means"].numpy(), axis=1).min() for c in capture.cameras)
    assert model.params["log_scales"].exp().max() < nearest / 3


def test_depth_of_a_sweep_lies_between_its_planes():
    """A painted wall y = 0. Planes are 0.15 apart there: without interpolation depth is off by 0.04."""
    views = []
    for camera in arc():
        y, x = np.mgrid[: camera.height, : camera.width]
        paint = unproject(camera, x.ravel(), y.ravel(), np.ones(x.size)) - camera.center
        x, z = (camera.center - paint * (camera.center[1] / paint[:, 1:2]))[:, ::2].T
        grey = 128 + 40 * (np.sin(13 * x + 7 * z) + np.sin(5 * x - 11 * z) + np.sin(17 * z))
        views.append((camera, np.rint(grey).astype(np.uint8).reshape(camera.height, -1, 1).repeat(3, 2), None))
    points, _ = sweep(views, 1000, 0, TINY.plane_sweep)
    assert np.median(np.abs(points[:, 1])) < 0.02


def test_sweep_finds_a_floor_seen_from_sides_far_apart():
    """Windows parallel to an image do not match between views more than 60 degrees apart; horizontal windows do."""
    wall, turned = splat_wall(height=4.0), np.sqrt(0.5).astype(np.float32)
    floor = dataclasses.replace(wall, means=wall.means[:, [0, 2, 1]], quats=wall.quats * turned)
    K = np.array([[150.0, 0, 64], [0, 150.0, 48], [0, 0, 1]])
    eyes = [(2.2 * np.cos(a), 2.2 * np.sin(a), 2.6) for a in (0.1, 2.2, 4.3)]
    cameras = [Camera(f"cam{i}", K, look_at(e, np.zeros(3), [0, 0, 1]), 128, 96) for i, e in enumerate(eyes)]
    views = [(c, render_image(floor, c, (0, 0, 0)), None) for c in cameras]
    settings = dataclasses.replace(TINY.plane_sweep, axis_cosine_min=0.8)
    points, _ = sweep(views, 1000, 0, settings)
    assert len(points) == 1000
    assert (np.abs(points[:, 2]) < 0.15).mean() > 0.7, "two views agree by chance, too"
    parallel = dataclasses.replace(settings, scored_neighbours=0)  # now no view lacks near neighbours
    assert len(sweep(views, 1000, 0, parallel)[0]) == 0


def test_initial_points_do_without_shell_or_sweep():
    """Ablations of the initial points, by settings."""
    wall = splat_wall()
    cameras = [dataclasses.replace(c, split="train") for c in arc()]
    read = lambda camera, _: View(render_image(wall, cameras[camera], (0, 0, 0)), None)  # noqa: E731
    capture = Capture("wall", 25.0, cameras, 1, False, read)
    no_shell = dataclasses.replace(TINY, far_shell=dataclasses.replace(TINY.far_shell, points=0))
    nothing = dataclasses.replace(TINY.initialization, use_plane_sweep=False, triangulate=False)
    no_sweep = dataclasses.replace(TINY, initialization=nothing)
    with_shell, without, random = (initial_model(capture, 0, 300, s)[0] for s in (TINY, no_shell, no_sweep))
    assert len(with_shell) > len(without) == TINY.initial_points
    opacities = [float(torch.sigmoid(m.params["logit_opacities"][0])) for m in (without, random)]
    assert opacities == pytest.approx([TINY.initialization.surface_opacity, TINY.initialization.random_opacity])


def test_matched_features_of_a_wall_lie_on_it():
    wall, cameras = splat_wall(), [dataclasses.replace(c, split="train") for c in arc()]
    capture = Capture(
        "wall", 25.0, cameras, 1, False, lambda i, _: View(render_image(wall, cameras[i], (0, 0, 0)), None)
    )
    points = triangulated(capture, 0, TINY.initialization)
    assert len(points) > 20
    assert (np.abs(points.means[:, 1]) < 0.22).mean() > 0.9, "as near as those of the plane sweep"
    narrow = dataclasses.replace(TINY.initialization, parallax_min=90.0)
    assert not len(triangulated(capture, 0, narrow)), "no two neighbours see it from sides so far apart"


def test_each_picture_is_decoded_once_for_the_initial_points():
    wall, cameras, read = splat_wall(), [dataclasses.replace(c, split="train") for c in arc()], []

    def look(camera, _):
        read.append(camera)
        return View(render_image(wall, cameras[camera], (0, 0, 0)), None)

    initial_model(Capture("wall", 25.0, cameras, 1, False, look), 0, 300, TINY)
    assert sorted(read) == list(range(len(cameras)))


def test_a_keyframe_starts_from_depth_images():
    """Depth images replace the plane sweep; some cameras may have none."""
    wall, cameras = splat_wall(), [dataclasses.replace(c, split="train") for c in arc()]
    params = {name: getattr(wall, name) for name in PARAMETERS}

    def read(camera, _):
        depth = None if camera == 0 else CpuBackend().render_depth(params, cameras[camera])
        return View(render_image(wall, cameras[camera], (0, 0, 0)), None, depth)

    capture = Capture("wall", 25.0, cameras, 1, False, read, has_depth=True)
    no_shell = dataclasses.replace(TINY, far_shell=dataclasses.replace(TINY.far_shell, points=0))
    found = initial_model(capture, 0, 300, no_shell)[0].params["means"].numpy()
    assert len(found) == 300
    assert np.abs(found[:, 1]).max() < 0.3, "on the wall"


@pytest.mark.parametrize("masks", [True, False])
def test_a_keyframe_starts_from_the_captures_points(masks):
    """Points that the pictures do not refute are kept; other initial points of the surface are added."""
    plain = capture_of(turning(3000, frames=1), masks)
    means = np.float32([(0, 0, 0.1), (0, 0.1, 0), (0, 0, 1.6), (50, 0, 0)])  # two in all masks, one outside, one unseen
    points = Points(means, np.uint8([(255, 0, 0), (0, 255, 0), (0, 0, 255), (9, 9, 9)]))
    capture = dataclasses.replace(plain, points=points)
    model, _ = initial_model(capture, 0, 300, TINY)
    kept = means[: 2 if masks else 3]
    found = model.params["means"].numpy()[: len(kept)]
    assert {tuple(x) for x in found.tolist()} == {tuple(x) for x in kept.tolist()}
    assert len(model) >= 0.6 * len(initial_model(plain, 0, 300, TINY)[0])
    told = dataclasses.replace(TINY, initialization=dataclasses.replace(TINY.initialization, use_points=False))
    without = initial_model(capture, 0, 300, told)[0].params["means"]
    assert torch.equal(without, initial_model(plain, 0, 300, TINY)[0].params["means"])


def test_projection_is_the_renderers(capture):
    camera = capture.cameras[0]
    g = blob(1)
    g = dataclasses.replace(
        g, means=np.array([[0.3, 0.2, 0.1]], np.float32), log_scales=np.full((1, 3), -4, np.float32)
    )
    alpha = render_rgba(g, camera)[..., 3]
    y, x = np.unravel_index(alpha.argmax(), alpha.shape)
    p, depth = project(camera, g.means)
    assert depth[0] > 0
    assert np.abs(p[0] - [x + 0.5, y + 0.5]).max() <= 0.51


@pytest.mark.parametrize("masks", [True, False])
def test_keyframe_learns_a_view_it_has_not_seen(masks):
    capture = capture_of(turning(300, frames=1), masks=masks)
    points = 300 if masks else 2000  # most points of a random box are in empty space
    settings = dataclasses.replace(TINY, initial_points=points, gaussians_max=2 * points)
    model, radius = initial_model(capture, 0, points, settings)
    losses = []
    train_keyframe(
        model,
        Views(capture, settings, CpuBackend()),
        0,
        settings,
        steps=200,
        radius=radius,
        on_step=lambda _, loss: losses.append(loss),
    )
    assert np.mean(losses[-20:]) < 0.6 * np.mean(losses[:20])
    assert len(model) <= settings.gaussians_max
    if masks:
        assert psnr_of(model, capture, 0) > 22


@pytest.mark.parametrize("darkest", [0.75, 1.0])
def test_exposure_of_each_camera_is_found(darkest):
    """Gains are found up to a common factor; equal ones stay equal."""
    capture = capture_of(turning(300, frames=1))
    gains = np.random.default_rng(2).uniform(darkest, 1, len(capture.cameras))

    def dimmed(camera, frame):
        view = capture.read(camera, frame)
        return dataclasses.replace(view, rgb=np.rint(gains[camera] * view.rgb).astype(np.uint8))

    views = Views(dataclasses.replace(capture, read=dimmed), TINY, CpuBackend())
    model, _ = initial_model(capture, 0, 300, TINY)
    train_keyframe(model, views, 0, TINY, steps=600, radius=1.0)
    true = np.log(gains[:-1]) - np.log(gains[:-1]).mean()
    np.testing.assert_allclose(views.exposure.values[:-1, :3], true[:, None] + np.zeros(3), atol=0.07)
    gain, offset = views.exposure.of(0, 0)
    shown = render_image(views.exposure.applied_to(model.gaussians(), 0, 0), capture.cameras[0], (0, 0, 0))
    plain = render_image(model.gaussians(), capture.cameras[0], (0, 0, 0))
    np.testing.assert_allclose(shown, plain * gain + 255 * offset * (plain.max(2, keepdims=True) > 0), atol=3)


@pytest.mark.parametrize("wrong", [0.0, 0.03])
def test_pose_of_each_camera_is_found(wrong):
    """Poses are found up to a common change; correct ones stay unchanged."""
    capture = capture_of(turning(300, frames=1))
    count = len(capture.cameras)
    told, trained = Extrinsics(count, list(range(count - 1)), TINY, CpuBackend()), slice(0, -1)
    told.values[trained] = np.random.default_rng(3).uniform(-wrong, wrong, (count - 1, 6))
    cameras = [told.camera(i, c) for i, c in enumerate(capture.cameras)]
    told_to = dataclasses.replace(TINY, calibration=dataclasses.replace(TINY.calibration, refine_poses=True))
    views = Views(dataclasses.replace(capture, cameras=cameras), told_to, CpuBackend())
    model, _ = initial_model(capture, 0, 300, TINY)
    train_keyframe(model, views, 0, told_to, steps=400, radius=1.0)
    left = views.extrinsics.values[trained] + told.values[trained] - told.values[trained].mean(0)
    assert np.sqrt(np.mean(left**2)) <= max(0.5 * np.sqrt(np.mean(told.values[trained] ** 2)), 0.005)


def glossy(gloss: float) -> GaussianSequence:
    """Two frames of the turning blob; colours change by `gloss` with the direction, differently for each Gaussian:
    equal changes would look like cameras of different brightness."""
    group = turning(300, frames=2).groups[0]
    shN = gloss * np.random.default_rng(4).choice([-1, 1], (300, 3, 3)).astype(np.float32)
    frames = [dataclasses.replace(g, shN=shN) for g in group.frames]
    return GaussianSequence(25.0, [DenseGroup(frames)])


@pytest.mark.parametrize(("gloss", "kept"), [(0.0, 0), (0.3, 3)])
def test_harmonics_stay_where_colours_depend_on_the_view(gloss, kept):
    """A whole run, from keyframe to stream, since every stage must keep the harmonics."""
    capture = capture_of(glossy(gloss))
    settings = dataclasses.replace(TINY, gop=2, keyframe_steps=500)
    (group,) = train_groups(capture, settings)
    assert [g.shN.shape[1] for g in map(group.frame, range(2))] == [kept] * 2
    if kept:
        plain = dataclasses.replace(group.frame(1), shN=group.frame(1).shN[:, :0])
        assert psnr_of(group.frame(1), capture, 1) > psnr_of(plain, capture, 1) + 0.5
    _, decoded, *_ = coded(capture, [group], settings, EncodeSettings(50.0))
    assert decoded[1].shN.shape[1] == kept
    assert psnr_of(decoded[1], capture, 1) > psnr_of(group.frame(1), capture, 1) - 1


def test_prior_of_harmonics_has_the_gradient_of_half_their_square():
    shN = torch.from_numpy(np.random.default_rng(0).normal(size=(50, 15, 3)).astype(np.float32))
    grads = {"shN": torch.ones_like(shN)}
    add_harmonics_prior(grads, {"shN": shN}, TINY, pictures=2)
    torch.testing.assert_close(grads["shN"], 1 + 2 * TINY.harmonics_lambda * shN / 50)


def test_opacity_decay_has_the_gradient_of_the_mean_weighted_opacity():
    params, weights = from_gaussians(blob(50)).params, torch.linspace(0, 2, 50)
    logits = params["logit_opacities"].clone().requires_grad_()
    (weights * torch.sigmoid(logits)).mean().backward()
    grads = {"logit_opacities": torch.zeros(50)}
    add_opacity_decay(grads, params, weights)
    torch.testing.assert_close(grads["logit_opacities"], logits.grad)


def test_nearness_counts_what_the_nearest_camera_could_draw_in_a_wider_picture():
    """Two cameras face each other at 3 units from the middle; pictures reach 0.4 of the depth to each side."""
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([blob(10)])]), masks=False)
    K = np.array([[80.0, 0, 32], [0, 80.0, 32], [0, 0, 1]])
    cameras = [Camera(f"{x}", K, look_at((x, 0, 0), np.zeros(3), (0, 0, 1)), 64, 64, near=0.5) for x in (-3.0, 3.0)]
    views = Views(dataclasses.replace(capture, cameras=cameras), TINY, CpuBackend())
    points = [(0, 0, 0), (1.5, 0, 0), (-2.0, 0, 0.7), (-2.0, 0, 0.9), (2.6, 0, 0), (9, 0, 0), (0, 9, 0)]
    near = views.nearness(np.array(points), 0, 2.0)
    np.testing.assert_allclose(near, [1, 2, 3, 3 / 5, 3 / 5.6, 3 / 12, 0])


def test_only_what_shows_nothing_moves_at_random():
    model = from_gaussians(blob(1000))
    before = model.params["means"].clone()
    model.params["logit_opacities"][:] = torch.where(torch.arange(1000) < 500, 6.0, -6.0)
    move_at_random(model.params, 0.3, np.random.default_rng(0))
    spread = (model.params["means"] - before).norm(dim=1) / model.params["log_scales"].exp().mean(1)
    assert spread[:500].max() < 1e-6
    assert spread[500:].square().mean().sqrt() == pytest.approx(0.3 * 3**0.5, rel=0.15)


def test_growing_and_pruning_keep_the_moments_in_step():
    model = from_gaussians(blob(100))
    model.start_optimizer(CpuBackend(), TINY.adam)
    model.step({n: torch.ones_like(p) for n, p in model.params.items()}, dict.fromkeys(model.params, 0.0))
    stats = Statistics(100, 1e-8)
    stats.screen_gradient += torch.linspace(0, 1, 100)
    stats.seen += 1
    stats.max_weight += 0.5
    densify(model, stats, 105, np.random.default_rng(0), TINY.keyframe)
    assert len(model) == 105, "no more than the most that is allowed"
    model.params["logit_opacities"][:10] = -9
    prune(model, Statistics(len(model), 1e-8), TINY.keyframe)
    assert len(model) == 95
    stats = Statistics(95, 1e-8)
    stats.max_weight += 0.5
    stats.squared_opacity_gradient[:90] = 1
    prune(model, stats, TINY.keyframe, thin=True)
    assert len(model) == 90, "what changes nothing in the picture is not worth its bits"
    model.step({n: torch.ones_like(p) for n, p in model.params.items()}, {"means": 0.1})
    assert torch.isfinite(model.params["means"]).all()


def test_many_points_leave_room_for_the_hull():
    plain = capture_of(turning(3000, frames=1))
    means = np.random.default_rng(0).uniform(-0.2, 0.2, (5000, 3)).astype(np.float32)
    capture = dataclasses.replace(plain, points=Points(means, np.zeros((5000, 3), np.uint8)))
    found = initial_model(capture, 0, 300, TINY)[0].params["means"].numpy()
    own = (np.abs(found) <= 0.2).all(1).sum()
    assert own >= 210
    assert 260 < len(found) < 420
