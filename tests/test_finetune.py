"""Joint fine-tuning of tiny groups: frequencies, rate terms beside the coder's bits, Gaussians added and removed."""

import dataclasses

import numpy as np
import pytest
import torch
from synthetic import blob, turning
from synthetic import coded as one_group
from training import TINY, capture_of, psnr_of

from gscodec import _native
from gscodec.bitstream.quantization import steps_for
from gscodec.bitstream.quantized_group import QuantizedTrajectories
from gscodec.encode.coded_form import coded_form
from gscodec.encode.measure import measure_group
from gscodec.encode.quantization_plan import plan_group
from gscodec.encode.quantize import quantize
from gscodec.encode.settings import EncodeSettings
from gscodec.model.parametric_group import ParametricGroup
from gscodec.render.backend import TURNS
from gscodec.render.cpu import CpuBackend
from gscodec.train.deformation_graph import NodeGraph, Pose
from gscodec.train.entropy_model import CanonicalRate, laplace_bits
from gscodec.train.finetune import GroupModel
from gscodec.train.joint_optimization import _Finetuner, finetune
from gscodec.train.model import Model, from_gaussians, harmonics_turned
from gscodec.train.tracking import Tracker
from gscodec.train.train import train_groups
from gscodec.train.views import Views


@pytest.fixture(scope="module")
def capture():
    return capture_of(turning(300, frames=5))


def resting(count, frames):
    """A group of `count` Gaussians that do not move."""
    key, everything = from_gaussians(blob(count)), torch.ones(count, dtype=torch.bool)
    nodes = dataclasses.replace(TINY.graph, nodes=8)
    graph = NodeGraph.of(key.params["means"], torch.ones(count), 1.0, everything, nodes)
    poses = [Pose.rest(graph)] * frames
    return GroupModel(graph, None, [key] * frames, poses, steps_for(50, 1.0), everything, TINY)


def test_a_longer_group_has_more_temporal_frequencies():
    for frames, means, colours in ((4, 4, 4), (20, 10, 6), (30, 15, 9), (31, 16, 10)):
        group = resting(50, frames)
        assert len(group.coefficients["means"]) == means
        assert len(group.coefficients["sh0"]) == colours


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
    """The loss and the coder agree on the bits of residual trajectories up to 20 %."""
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
    """Estimated and coded bits of each attribute; coded bits after a descent on the rate alone."""
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


def test_fine_tuning_removes_and_adds_gaussians(capture, monkeypatch):
    """The next group continues with the changed Gaussians."""
    changes = []
    append, select = GroupModel.append, GroupModel.select
    monkeypatch.setattr(GroupModel, "append", lambda g, c, p: (changes.append(len(p)), append(g, c, p))[1])
    monkeypatch.setattr(GroupModel, "select", lambda g, k: (changes.append(-int((~k).sum())), select(g, k))[1])
    eager = dataclasses.replace(TINY.keyframe, gradient_unit=1e-6, price=0.02)
    settings = dataclasses.replace(TINY, finetune_steps=40, gaussians_max=2000, keyframe=eager)
    first, second = train_groups(capture, settings)
    assert changes[0] > 0 > changes[1], "some were added, some removed"
    assert len(second.parents) == len(second.canonical) >= len(first.canonical) + min(second.parents.min(), 0)
    assert psnr_of(first.frame(2), capture, 2) > 22
    assert psnr_of(second.frame(1), capture, 4) > 21


def test_what_one_frame_shows_takes_one_step_for_each_gradient(capture):
    """Adam alone takes about five more steps after a gradient that occurs in one of 22 steps."""
    frames, rounds = 20, 5
    group = resting(60, frames)
    group.start[:20], group.end[:20] = 4, 5
    run = _Finetuner(group, Views(capture, TINY, CpuBackend()), range(frames), TINY, radius=1.0)
    before = group.key.params["log_scales"].clone()
    for step in range(rounds * (frames + 2)):
        shown = torch.arange(60) >= (0 if step % (frames + 2) == 4 else 20)
        grads = {n: torch.zeros_like(p) for n, p in group.key.params.items()}
        grads["log_scales"] -= shown[:, None].float()
        run._step_canonical(grads, 1.0)
    moved = (group.key.params["log_scales"] - before).mean(1) / run.canonical_rates["log_scales"]
    assert moved[20:].min() == pytest.approx(rounds * (frames + 2), rel=0.05)
    assert 0.5 * rounds < moved[:20].mean() < 1.5 * rounds


def test_a_bit_is_no_cheaper_where_bits_are_many(capture):
    run = _Finetuner(resting(60, 5), Views(capture, TINY, CpuBackend()), range(5), TINY, radius=1.0)
    run.loss = 1.0

    def weight(bits_of_a_frame: float) -> float:
        run.bits = 5 * bits_of_a_frame * run.canonical_bits
        return run._bit_weight() * run.canonical_bits / TINY.rate_lambda

    share = TINY.finetune.residual_share
    assert weight(0.0) == pytest.approx(1)
    assert weight(share / 2) == pytest.approx(1 / (1 + 2.5 * share))
    assert weight(10.0) == weight(share) == pytest.approx(1 / (1 + 5 * share))


def test_few_views_have_dearer_bits_and_a_faster_field(capture):
    cameras = len(capture.indices("train"))
    many, few, least = (dataclasses.replace(TINY, few_views=n * cameras).of_capture(capture) for n in (0.5, 2, 3))
    fields, slow = [s.motion_field for s in (many, few, least)], TINY.motion_field
    assert [s.rate_lambda / TINY.rate_lambda for s in (many, few, least)] == pytest.approx([1, 2, 3])
    assert [f.grid_rate / slow.grid_rate for f in fields] == pytest.approx([1, 4, slow.searched_rates])
    assert [f.mlp_rate / slow.mlp_rate for f in fields] == pytest.approx([1, 4, slow.searched_rates])
    assert [f.searched_rates * f.grid_rate for f in fields] == pytest.approx([slow.searched_rates * slow.grid_rate] * 3)


def test_many_views_need_no_prior_and_no_dropout(capture):
    cameras, k = len(capture.indices("train")), TINY.keyframe
    few, many = (dataclasses.replace(TINY, few_views=n * cameras).of_capture(capture) for n in (2, 0.5))
    assert [few.harmonics_lambda, few.keyframe.dropout] == [TINY.harmonics_lambda, k.dropout]
    assert [many.harmonics_lambda, many.keyframe.dropout] == [TINY.harmonics_lambda / 4, k.dropout / 16]
    room = TINY.of_capture(capture_of(turning(300, frames=3), masks=False))
    assert [room.harmonics_lambda, room.keyframe.dropout] == [TINY.harmonics_lambda, 0.0]


@pytest.mark.parametrize("drift", [0.2, 0.0])
def test_a_camera_whose_brightness_drifts_is_followed(capture, drift):
    """In each frame, up to a gain common to all cameras; a camera without drift has the same gain in all frames."""
    gains = np.exp(drift * np.linspace(0, 1, 3)[:, None] * np.sin(np.arange(len(capture.cameras))))

    def rolled(camera, frame):
        view = capture.read(camera, frame)
        return dataclasses.replace(view, rgb=np.rint(gains[frame, camera] * view.rgb).clip(0, 255).astype(np.uint8))

    drifting = dataclasses.replace(capture, frame_count=3, read=rolled)
    settings = dataclasses.replace(TINY, keyframe_steps=300, finetune_steps=200, cut_ratio=3.0)
    (group,) = train_groups(drifting, settings)
    trained = capture.indices("train")
    found, true = (np.log(g[:, trained]) for g in (group.calibration.gains, gains))
    since = found - found[0]
    off = since - (true - true.mean(1, keepdims=True))[..., None]
    assert np.abs(off).max() < (0.06 if drift else 0.02)


def test_a_group_goes_on_from_what_was_fine_tuned(capture):
    """The tracker's last frame equals that of the fine-tuned group, except for small coefficients."""
    key = from_gaussians(turning(300, frames=5).frame(0))
    tracker = Tracker.start(key, Views(capture, TINY, CpuBackend()), TINY, 0.01, range(3))
    models, poses = [tracker.model], [tracker.pose]
    tracker.advance(1)
    models.append(tracker.model)
    poses.append(tracker.pose)
    everything = torch.ones(len(key), dtype=torch.bool)
    group = GroupModel(tracker.graph, None, models, poses, steps_for(50, 1.0), everything, TINY)
    group.turns[1] += 0.1
    group.key.params["sh0"] += 0.2
    group.key.params["means"] += 0.1
    group.append({n: p[:20].clone() for n, p in group.key.params.items()}, torch.arange(20))
    group.coefficients["sh0"][0, :10], group.coefficients["sh0"][0, 10:20] = 50.0, 0.9 * TINY.finetune.shrinkage
    tracker.moving[:] = True
    tracker.adopt(group)
    shown, model = group.frame(1, CpuBackend(), shrinkage=TINY.finetune.shrinkage).params, tracker.model.params
    own = (model["sh0"] - group.key.params["sh0"])[:20].abs().mean(1)
    assert own[:10].min() > 0
    assert own[10:].max() < own[:10].min() / 10
    shown["shN"] = harmonics_turned(shown["shN"], shown.pop(TURNS))
    for name, values in shown.items():
        np.testing.assert_allclose(model[name].detach().numpy(), values.detach().numpy(), atol=2e-5, err_msg=name)
    assert len(tracker.moving) == 320


def test_what_moves_in_a_predicted_group_starts_nearer_to_rest():
    key, moved = from_gaussians(blob(60)), torch.arange(60) < 30
    graph = NodeGraph.of(key.params["means"], torch.ones(60), 1.0, moved, dataclasses.replace(TINY.graph, nodes=8))
    brighter = torch.linspace(0, 1, 30).repeat(2)[:, None]
    frames = [Model({**key.params, "sh0": key.params["sh0"] + brighter})] * 4
    group = GroupModel(graph, key, frames, [Pose.rest(graph)] * 4, steps_for(50, 1.0), moved, TINY)
    steps = (2 * brighter / group.unit["sh0"]).numpy()  # 2: square root of 4 frames
    found = group.coefficients["sh0"][0]
    np.testing.assert_allclose(found[30:], np.broadcast_to(steps[30:], (30, 3)), atol=1e-3)
    smaller = np.maximum(steps[:30] - TINY.finetune.shrinkage, 0)
    np.testing.assert_allclose(found[:30], np.broadcast_to(smaller, (30, 3)), atol=1e-3)


def test_nodes_that_carry_only_what_rests_stay(capture):
    key, views = from_gaussians(turning(300, frames=5).frame(0)), Views(capture, TINY, CpuBackend())
    tracker = Tracker.start(key, views, TINY, 0.01, range(3))
    moved = key.params["means"][:, 0] > 0.5
    model, pose = tracker.model, tracker.pose
    group = GroupModel(tracker.graph, None, [model] * 3, [pose] * 3, steps_for(50, 1.0), moved, TINY)
    carriers = group.graph.carriers(moved)
    assert 0.05 < carriers.float().mean() < 0.7
    finetune(group, views, range(3), TINY, radius=1.0)
    far = np.linalg.norm(group.nodes().translations, axis=2).max(0)
    assert far[~carriers.numpy()].max() == 0
    assert far[carriers.numpy()].min() > 0


def test_trajectories_do_not_outgrow_the_bound_on_sizes():
    capture = capture_of(turning(300, frames=3), masks=False)
    views = Views(capture, TINY, CpuBackend())
    key = from_gaussians(turning(300, frames=3).frame(0))
    tracker = Tracker.start(key, views, TINY, 0.01, range(3))
    everything = torch.ones(300, dtype=torch.bool)
    group = GroupModel(
        tracker.graph, None, [tracker.model] * 3, [tracker.pose] * 3, steps_for(50, 1.0), everything, TINY
    )
    group.coefficients["log_scales"][0, :20] = 100.0
    group.coefficients["log_scales"][1, :20] = 30.0
    finetune(group, views, range(3), TINY, radius=1.0)
    for t in range(3):
        params = group.frame(t, CpuBackend()).params
        assert (params["log_scales"] <= views.size_bound.log_scales(params["means"]) + 0.1).all()
