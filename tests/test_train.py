"""Training on tiny captures with known truth: carving, keyframe, motion, rate term, checkpoints."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from synthetic import blob, turning
from synthetic import coded as one_group

from bench.train import coded
from gscodec import _native
from gscodec.bitstream.quantization import steps_for
from gscodec.bitstream.quantized_group import QuantizedTrajectories
from gscodec.capture.capture import Capture
from gscodec.capture.images import View
from gscodec.encode.coded_form import coded_form
from gscodec.encode.measure import measure_group
from gscodec.encode.quantization_plan import plan_group
from gscodec.encode.quantize import quantize
from gscodec.encode.settings import EncodeSettings
from gscodec.errors import CaptureError, UsageError
from gscodec.metrics.image import psnr
from gscodec.model.camera import Camera, look_at, meeting_point
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import concatenate
from gscodec.model.parametric_group import ParametricGroup
from gscodec.model.rotations import quat_to_matrix, rotvec_to_quat
from gscodec.render.cpu import CpuBackend
from gscodec.render.image import render_image, render_rgba
from gscodec.train.calibration import Extrinsics
from gscodec.train.change_detection import Changes
from gscodec.train.checkpoint import Checkpoint
from gscodec.train.deformation_graph import NodeGraph, Pose
from gscodec.train.entropy_model import CanonicalRate, laplace_bits
from gscodec.train.finetune import GroupModel
from gscodec.train.initialization import initial_model
from gscodec.train.keyframe import Statistics, densify, prune, train_keyframe
from gscodec.train.model import from_gaussians
from gscodec.train.plane_sweep import shell, sweep
from gscodec.train.ray_jobs import train_segment
from gscodec.train.relocalization import relocalize
from gscodec.train.settings import TrainSettings, train_settings
from gscodec.train.tracking import Tracker
from gscodec.train.train import segments, train_groups
from gscodec.train.views import Views
from gscodec.train.visual_hull import hull_points, project

SIZE = 64
TINY = TrainSettings(
    gop=3, keyframe_steps=150, motion_steps=60, finetune_steps=10, gaussians_max=600, initial_points=300, sh_degree=1
)
FEW_NODES = dataclasses.replace(TINY.graph, nodes=32)


def rig(count=10):
    """Cameras on two rings around the origin; the last one is held out."""
    cameras = []
    for i in range(count):
        angle, z = 2.4 * i, (-1.2, 1.2, 0.2)[i % 3]
        eye = np.array([3.2 * np.cos(angle), 3.2 * np.sin(angle), z])
        K = np.array([[80.0, 0, SIZE / 2], [0, 80.0, SIZE / 2], [0, 0, 1]])
        split = "test" if i == count - 1 else "train"
        cameras.append(Camera(f"cam{i}", K, look_at(eye, np.zeros(3), [0, 0, 1]), SIZE, SIZE, split=split))
    return cameras


def capture_of(sequence: GaussianSequence, masks=True) -> Capture:
    """What the rig sees of a sequence."""
    cameras = rig()

    def read(camera, frame):
        g = sequence.frame(frame)
        if not masks:
            return View(render_image(g, cameras[camera], (0, 0, 0)), None)
        rgba = render_rgba(g, cameras[camera])
        rgb = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)
        to_u8 = lambda x: np.rint(255 * np.clip(x, 0, 1)).astype(np.uint8)  # noqa: E731
        return View(to_u8(rgb), to_u8(rgba[..., 3]))

    return Capture("synthetic", 25.0, cameras, sequence.frame_count, masks, read)


@pytest.fixture(scope="module")
def capture():
    return capture_of(turning(300, frames=5))


def psnr_of(model_or_gaussians, capture, frame):
    g = model_or_gaussians.gaussians() if hasattr(model_or_gaussians, "gaussians") else model_or_gaussians
    camera = capture.cameras[-1]
    view = capture.view(len(capture.cameras) - 1, frame)
    a = view.alpha[..., None] / 255
    reference = np.rint(view.rgb * a + 127.5 * (1 - a)).astype(np.uint8)
    return psnr(reference, render_image(g, camera))


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


def splat_wall(n=3000, seed=1, width=4.0, height=3.0):
    """A wall y = 0 of coloured splats."""
    rng = np.random.default_rng(seed)
    x, z = width * rng.uniform(-0.5, 0.5, n), height * rng.uniform(-0.5, 0.5, n)
    return dataclasses.replace(
        blob(n),
        means=np.stack([x, np.zeros(n), z], 1).astype(np.float32),
        log_scales=np.full((n, 3), np.log(0.04), np.float32),
        logit_opacities=np.full(n, 4, np.float32),
        sh0=rng.uniform(-1.7, 1.7, (n, 3)).astype(np.float32),
    )


def arc():
    """Six cameras in front of it."""
    K = np.array([[150.0, 0, 64], [0, 150.0, 48], [0, 0, 1]])
    eyes = [(x, -3.0, z) for z in (-0.3, 0.3) for x in (-0.8, 0, 0.8)]
    return [Camera(f"cam{i}", K, look_at(eye, np.zeros(3), [0, 0, 1]), 128, 96) for i, eye in enumerate(eyes)]


def test_sweep_finds_a_textured_wall():
    """A wall y = 0 of coloured splats, seen from an arc in front of it: the points lie on it, the shell far behind."""
    wall, cameras = splat_wall(), arc()
    views = [(c, render_image(wall, c, (0, 0, 0)), None) for c in cameras]
    points, colors = sweep(views, 1000, 0, TINY.plane_sweep)
    assert len(points) == len(colors) == 1000
    assert (np.abs(points[:, 1]) < 0.22).mean() > 0.9, "a plane and a half: they are 0.15 apart there"
    behind, _ = shell(views, TINY.plane_sweep)
    assert len(behind) > 5
    assert (behind[:, 1] > 8).all()


def test_initial_points_do_without_shell_or_sweep():
    """The ablations of the initial points, by settings alone."""
    wall = splat_wall()
    cameras = [dataclasses.replace(c, split="train") for c in arc()]
    read = lambda camera, _: View(render_image(wall, cameras[camera], (0, 0, 0)), None)  # noqa: E731
    capture = Capture("wall", 25.0, cameras, 1, False, read)
    no_shell = dataclasses.replace(TINY, plane_sweep=dataclasses.replace(TINY.plane_sweep, shell_points=0))
    no_sweep = dataclasses.replace(TINY, initialization=dataclasses.replace(TINY.initialization, use_plane_sweep=False))
    with_shell, without, random = (initial_model(capture, 0, 300, s)[0] for s in (TINY, no_shell, no_sweep))
    assert len(with_shell) > len(without) == TINY.initial_points
    opacities = [float(torch.sigmoid(m.params["logit_opacities"][0])) for m in (without, random)]
    assert opacities == pytest.approx([TINY.initialization.surface_opacity, TINY.initialization.random_opacity])


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
    points = 300 if masks else 2000  # a random box has most of its points where nothing is
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
    """Up to what all cameras share; equal ones stay equal."""
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
    gain, offset = views.exposure.of(0)
    shown = render_image(views.exposure.applied_to(model.gaussians(), 0), capture.cameras[0], (0, 0, 0))
    plain = render_image(model.gaussians(), capture.cameras[0], (0, 0, 0))
    np.testing.assert_allclose(shown, plain * gain + 255 * offset * (plain.max(2, keepdims=True) > 0), atol=3)


@pytest.mark.parametrize("wrong", [0.0, 0.03])
def test_pose_of_each_camera_is_found(wrong):
    """Up to what all cameras share; right ones stay as they are."""
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
    """Two frames of the turning blob, whose colours change by `gloss` with the direction, each in its own way: equal
    ones would look like cameras of different brightness."""
    group = turning(300, frames=2).groups[0]
    shN = gloss * np.random.default_rng(4).choice([-1, 1], (300, 3, 3)).astype(np.float32)
    frames = [dataclasses.replace(g, shN=shN) for g in group.frames]
    return GaussianSequence(25.0, [DenseGroup(frames)])


@pytest.mark.parametrize(("gloss", "kept"), [(0.0, 0), (0.3, 3)])
def test_harmonics_stay_where_colours_depend_on_the_view(gloss, kept):
    """From keyframe to stream; a whole run, since every stage has to carry them."""
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


def test_tracking_finds_the_turn(capture):
    truth = turning(300, frames=5)
    key = from_gaussians(truth.frame(0))
    views = Views(capture, TINY, CpuBackend())
    tracker = Tracker.start(key, views, TINY, 0.01, range(3))
    models, poses = [tracker.model], [tracker.pose]
    for frame in (1, 2):
        tracker.advance(frame)
        models.append(tracker.model)
        poses.append(tracker.pose)
    still = np.abs(truth.frame(2).means - truth.frame(0).means).mean()
    missed = np.abs(truth.frame(2).means - tracker.model.params["means"].numpy()).mean()
    assert missed < 0.25 * still, (missed, still)
    angle = 2 * np.arccos(np.abs(tracker.pose.rotations[:, 0].numpy()).clip(0, 1))
    assert np.median(angle) == pytest.approx(0.2, abs=0.08), "0.1 rad a frame"
    group = GroupModel(
        tracker.graph, None, models, poses, steps_for(50, 1.0), torch.ones(len(key), dtype=torch.bool), TINY
    )
    assert psnr_of(group.group(None).frame(2), capture, 2) > psnr_of(truth.frame(0), capture, 2) + 4
    carried = group.frame(2, CpuBackend()).means.detach().numpy()
    carried = np.abs(truth.frame(2).means - carried).mean()
    assert carried < 0.3 * still, "the nodes have found it, not the Gaussians each for itself"


def test_nodes_carry_a_rigid_motion_exactly_and_hold_against_others():
    x = torch.from_numpy(blob(200).means)
    graph = NodeGraph.of(x, torch.ones(200), 1.0, torch.ones(200, dtype=torch.bool), 32, TINY.graph)
    turn = rotvec_to_quat(torch.tensor([[0.3, -0.2, 0.5]])).repeat(len(graph), 1)
    R = quat_to_matrix(turn)
    nodes = torch.einsum("nij,nj->ni", R, graph.nodes) + 1
    pose = dataclasses.replace(Pose.rest(graph), nodes=nodes, rotations=turn)
    means, turned = graph.carry(x, pose)
    np.testing.assert_allclose(means, x @ R[0].T + 1, atol=1e-5)
    np.testing.assert_allclose(turned, turn[:1].expand(200, 4), atol=1e-5)
    assert graph.rigidity(pose) < 1e-5
    stretched = dataclasses.replace(Pose.rest(graph), nodes=1.2 * graph.nodes)
    assert graph.rigidity(stretched) > 0.01


def test_newcomers_have_nodes_of_their_own_that_change_nothing_for_others():
    x = torch.from_numpy(blob(200).means)
    spawned = 0.2 * torch.from_numpy(blob(60, seed=1).means) + torch.tensor([0.9, 0, 0])  # amid the others
    graph = NodeGraph.of(x, torch.ones(200), 1.0, torch.ones(200, dtype=torch.bool), 32, TINY.graph)
    pose = dataclasses.replace(Pose.rest(graph), nodes=1.1 * graph.nodes)
    before, known = graph.carry(x, pose)[0], len(graph)
    shift = graph.add_nodes(spawned)
    pose = pose.extended(graph.nodes[known:] - shift)
    graph.extend(spawned + shift)
    np.testing.assert_array_equal(graph.batch_of() == 1, np.arange(260) >= 200)
    pose.nodes[known:] += 3
    means, _ = graph.carry(graph.means, pose)
    np.testing.assert_array_equal(means[:200], before)
    np.testing.assert_allclose(means[200:], spawned + 3, atol=1e-5)
    again = NodeGraph.restored(graph.state(), TINY.graph)
    np.testing.assert_array_equal(again.carry(again.means, pose)[0], means)


def test_what_jumps_is_found_and_what_is_gone_is_not():
    """A patch in front of a wall, farther away in the next frame than any gradient reaches, then nowhere."""
    wall, patch = splat_wall(), splat_wall(800, 2, 0.9, 0.9)
    at = lambda x: dataclasses.replace(patch, means=patch.means + np.float32([x, -0.6, 0]))  # noqa: E731
    frames, cameras = [concatenate([wall, at(-0.5)]), concatenate([wall, at(0.5)]), wall], arc()
    read = lambda camera, t: View(render_image(frames[t], cameras[camera], (0, 0, 0)), None)  # noqa: E731
    capture = Capture("patch", 25.0, cameras, 3, False, read)
    views, model, some = Views(capture, TINY, CpuBackend()), from_gaussians(frames[0]), torch.arange(3800) >= 3000
    changes = Changes.since(views, 0, TINY.change_detection)
    shift = relocalize(model, some, 1, changes, changes.advance(1), TINY)
    np.testing.assert_allclose(shift, [1, 0, 0], atol=0.25)
    assert relocalize(model, some, 2, changes, changes.advance(2), TINY) is None


def test_a_longer_group_has_more_temporal_frequencies():
    key = from_gaussians(blob(50))
    everything = torch.ones(50, dtype=torch.bool)
    graph = NodeGraph.of(key.params["means"], torch.ones(50), 1.0, everything, 8, TINY.graph)
    for frames, means, colours in ((4, 4, 4), (20, 10, 6), (30, 15, 9), (31, 16, 10)):
        poses = [Pose.rest(graph)] * frames
        group = GroupModel(graph, None, [key] * frames, poses, steps_for(50, 1.0), everything, TINY)
        assert len(group.coefficients["means"]) == means
        assert len(group.coefficients["sh0"]) == colours


def test_masks_say_where_nothing_is():
    """A part of the subject is gone in frame 1, everything in frame 2: what is dead ends its lifetime."""
    left, right = (
        dataclasses.replace(g, means=0.4 * g.means + np.float32([x, 0, 0]), log_scales=g.log_scales - 1)
        for g, x in ((blob(100), -0.7), (blob(100, seed=1), 0.7))
    )
    whole, none = concatenate([left, right]), left.take(np.zeros(0, int))
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in (whole, left, none, none)]))
    tracker = Tracker.start(from_gaussians(whole), Views(capture, TINY, CpuBackend()), TINY, 0.01, range(4))
    models, poses = [tracker.model], [tracker.pose]
    for frame in (1, 2, 3):
        loss = tracker.advance(frame)
        models.append(tracker.model)
        poses.append(tracker.pose)
    assert loss is None
    group = GroupModel(tracker.graph, None, models, poses, steps_for(50, 1.0), torch.zeros(200, dtype=torch.bool), TINY)
    shown = [len(group.group(None).visible(t)) for t in range(4)]
    assert shown[0] == 200
    assert 80 < shown[1] < 120
    assert shown[2:] == [0, 0]


def test_light_that_comes_on_ends_a_group_and_not_the_subject():
    dark = blob(200)
    lit = dataclasses.replace(dark, sh0=dark.sh0 + 0.6)
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in (dark,) * 5 + (lit,) * 2]))
    first, second = train_groups(capture, dataclasses.replace(TINY, gop=8))
    assert (len(first), len(second)) == (5, 2)
    assert second.parents is not None
    np.testing.assert_array_equal(first.frame(0).sh0, first.frame(4).sh0)
    still = psnr_of(first.frame(0), capture, 0)
    assert min(psnr_of(g, capture, 5) for g in map(second.frame, range(len(second)))) > still - 2


def test_laplace_bits_are_code_lengths():
    x = torch.arange(-200, 201).float()
    for b in (0.1, 0.5, 2.0, 20.0):
        bits = laplace_bits(x, torch.tensor(np.log(b)))
        assert torch.exp2(-bits.double()).sum() == pytest.approx(1, abs=1e-3)
    assert laplace_bits(x, torch.tensor(20.0)).isfinite().all(), "no law is too wide"
    x = torch.tensor([0.3, 2.0, -7.0, 300.0], requires_grad=True)
    laplace_bits(x, torch.tensor(-1.0)).sum().backward()
    assert (x.grad * x.detach() > 0).all(), "every coefficient is pulled to zero, however far away"
    x = torch.tensor([[-3.2, -0.4, 0.1], [0.45, 0.7, 25.0]], dtype=torch.double, requires_grad=True)
    log_scale = torch.tensor([[-1.0], [0.7]], dtype=torch.double, requires_grad=True)
    assert torch.autograd.gradcheck(laplace_bits, (x, log_scale)), "the closed form of its derivatives"


def test_rate_term_tracks_the_coders_bits():
    """The loss and the coder agree on what a set of residual trajectories costs, up to 20 %."""
    sequence = turning(6000, frames=4)
    _, integers = one_group(sequence.groups[0], 50, keep_all=True)
    n = len(integers)
    rng = np.random.default_rng(0)
    predicted, coded = [], []
    for scale in (0.15, 0.4, 1.0, 3.0):
        c = np.rint(rng.laplace(0, scale, (2, 3, n))).astype(np.int32)
        trajectories = {"means": QuantizedTrajectories(c, 0.01)}
        units = _native.encode_group(dataclasses.replace(integers, trajectories=trajectories))[1]
        coded.append(8 * sum(u["bytes"] for u in units if u["type"] == "trajectories"))
        x = torch.from_numpy(c).float()
        log_scale = torch.zeros(2, 1, 1, requires_grad=True)
        optimizer = torch.optim.Adam([log_scale], lr=0.1)
        for _ in range(100):
            optimizer.zero_grad()
            total = laplace_bits(x, log_scale).sum()
            total.backward()
            optimizer.step()
        predicted.append(total.item())
    assert np.corrcoef(predicted, coded)[0, 1] > 0.99
    np.testing.assert_allclose(predicted, coded, rtol=0.2)


def test_canonical_rate_is_what_the_coder_pays_and_falls_along_its_gradient():
    """Estimated and coded bits of each attribute; coded bits after a descent on nothing but the rate."""
    model, steps = from_gaussians(blob(3000, sh_count=3)), steps_for(62, 1.0)
    rate, noise = CanonicalRate(model.params["means"], steps, TINY.entropy_model), torch.Generator().manual_seed(0)
    names = ("quats", "log_scales", "logit_opacities", "sh0", "shN")
    estimated, before = rate.bits(model.params, noise), coded_bits(rate, model, 62)
    for name in names:
        assert estimated[name].item() == pytest.approx(before[name], rel=0.15), name
    model.start_optimizer(CpuBackend(), TINY.adam)
    for _ in range(60):
        rates = {n: 0.1 * steps[n] for n in names}
        model.step(rate.gradients(model.params, noise)[1], rates)
    after = coded_bits(rate, model, 62)
    for name in names:
        assert after[name] < 0.97 * before[name], name


def test_rate_of_one_gaussian_is_finite():
    model = from_gaussians(blob(1))
    rate = CanonicalRate(model.params["means"], steps_for(50, 1.0), TINY.entropy_model)
    _, grads = rate.gradients(model.params, torch.Generator().manual_seed(0))
    assert all(torch.isfinite(g).all() for g in grads.values())


def coded_bits(rate, model, quality):
    """Bits of each attribute's channels at the steps of `rate`."""
    group, settings = ParametricGroup(1, model.gaussians()), EncodeSettings(keep_all=True, layers=1)
    form = coded_form(group, np.full(len(model), -1))
    importance = measure_group(group, [], settings.plan).with_axes(form.axis_order)
    q = quantize(form, plan_group(form, importance, quality, settings), settings.rdo)
    channels = dict(q.integers.channels)
    for name, x in rate.channels(model.params).items():
        values = np.rint(x.numpy()[q.form.index].T).astype(np.int32)
        values -= np.median(values, 1, keepdims=True).astype(np.int32)
        channels[name] = dataclasses.replace(channels[name], values=np.ascontiguousarray(values))
    units = _native.encode_group(dataclasses.replace(q.integers, channels=channels))[1]
    return {u["attribute"]: 8 * u["bytes"] for u in units if u["type"] == "channels"}


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


def test_groups_come_out_whole_and_a_stopped_run_goes_on(capture, tmp_path):
    done = []
    groups = []
    for group in train_groups(
        capture, TINY, checkpoints=tmp_path, on_progress=lambda p: done.append((p.done, p.total))
    ):
        groups.append(group)
        if len(groups) == 1:
            assert Checkpoint(tmp_path).load(3) is not None
    assert [len(g) for g in groups] == [3, 2]
    np.testing.assert_array_equal(groups[1].parents, np.arange(len(groups[0].frame(0))))
    assert done[-1][0] == done[-1][1], "progress ends at its total"
    assert psnr_of(groups[1].frame(1), capture, 4) > 21
    # The first group again from nothing, the second from the checkpoint of the first.
    first = next(iter(train_groups(capture, TINY, checkpoints=tmp_path / "again")))
    np.testing.assert_array_equal(first.frame(2).means, groups[0].frame(2).means)
    (rest,) = train_groups(capture, TINY, first_frame=3, checkpoints=tmp_path / "again")
    np.testing.assert_array_equal(rest.frame(1).means, groups[1].frame(1).means)


def test_fine_tuning_removes_and_adds_gaussians(capture, monkeypatch):
    """The next group goes on from them."""
    changes = []
    append, select = GroupModel.append, GroupModel.select
    monkeypatch.setattr(GroupModel, "append", lambda g, c, p: (changes.append(len(p)), append(g, c, p))[1])
    monkeypatch.setattr(GroupModel, "select", lambda g, k: (changes.append(-int((~k).sum())), select(g, k))[1])
    eager = dataclasses.replace(TINY.keyframe, gradient_min=1e-6, contribution_min=8.0)
    settings = dataclasses.replace(TINY, finetune_steps=40, gaussians_max=2000, keyframe=eager)
    first, second = train_groups(capture, settings)
    assert changes[0] > 0 > changes[1], "some were added, some removed"
    assert len(second.parents) == len(second.canonical) >= len(first.canonical) + min(second.parents.min(), 0)
    assert psnr_of(first.frame(2), capture, 2) > 22
    assert psnr_of(second.frame(1), capture, 4) > 21


def test_segments_are_trained_without_a_look_at_others(capture):
    assert segments(5, 3, 0) == [range(5)]
    assert segments(5, 3, 2) == [range(3), range(3, 5)], "a group may be longer than that"
    settings = dataclasses.replace(TINY, gop=2)
    whole = list(train_groups(capture, settings, random_access=3))
    assert [len(g) for g in whole] == [2, 1, 2]
    assert [g.parents is None for g in whole] == [True, False, True]
    (alone,) = train_segment(lambda: capture, settings, 3, range(3, 5))
    np.testing.assert_array_equal(alone.frame(1).means, whole[2].frame(1).means)
    np.testing.assert_array_equal(alone.nodes.translations, whole[2].nodes.translations)


def test_settings_are_the_same_from_json():
    """The fingerprint of a run, by which it is resumed, is JSON."""
    stored = dataclasses.asdict(TINY)
    assert json.loads(json.dumps(stored)) == stored


def test_what_cannot_be_trained_is_said():
    with pytest.raises(UsageError, match="fast, medium, slow"):
        train_settings("turbo")
    capture = capture_of(turning(50, frames=1))
    held = dataclasses.replace(capture, cameras=[dataclasses.replace(c, split="test") for c in capture.cameras])
    with pytest.raises(CaptureError, match="training camera"):
        next(train_groups(held, TINY))
