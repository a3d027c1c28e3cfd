"""Tracking of tiny captures with known ground truth: nodes, new Gaussians, jumping and disappearing parts."""

import dataclasses

import numpy as np
import pytest
import torch
from synthetic import blob, moved, turning
from training import TINY, arc, capture_of, psnr_of, splat_wall

from gscodec.bitstream.quantization import steps_for
from gscodec.capture.capture import Capture
from gscodec.capture.images import View
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.model.gaussians import concatenate
from gscodec.model.rotations import quat_to_matrix, rotate, rotvec_to_quat
from gscodec.render.cpu import CpuBackend
from gscodec.render.image import render_image
from gscodec.train.change_detection import Changes
from gscodec.train.deformation_graph import NodeGraph, Pose
from gscodec.train.finetune import GroupModel
from gscodec.train.model import from_gaussians
from gscodec.train.motion_field import MotionField
from gscodec.train.motion_search import search
from gscodec.train.relocalization import relocalize
from gscodec.train.settings import AdamSettings, MotionFieldSettings
from gscodec.train.tracking import Tracker
from gscodec.train.views import Views


def started(model, capture, settings=TINY, frames=2):
    """A tracker with the given Gaussians as keyframe of the capture."""
    return Tracker.start(from_gaussians(model), Views(capture, settings, CpuBackend()), settings, 0.01, range(frames))


@pytest.fixture(scope="module")
def capture():
    return capture_of(turning(300, frames=5))


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


def test_a_far_background_does_not_make_what_moves_larger():
    """Learning rates of the nodes are in radii of the moving subject: if the sky counted, the subject would fly off."""
    capture, subject = capture_of(turning(300, frames=2), masks=False), blob(300)
    sky = dataclasses.replace(subject, means=20 * subject.means, log_scales=subject.log_scales + 3)
    alone = started(subject, capture).radius
    assert started(concatenate([subject, sky.take(np.arange(100))]), capture).radius < 1.5 * alone


def test_a_motion_out_of_reach_of_the_gradient_is_searched_for():
    turn, shift = np.array([0.0, 0.8, 0.1]), np.array([0.9, -0.3, 0.2])
    first = blob(300)
    to = lambda g: capture_of(GaussianSequence(25.0, [DenseGroup([first, g], None)]))  # noqa: E731
    rough = dataclasses.replace(first, sh0=first.sh0 + 0.5 * np.random.default_rng(0).standard_normal((300, 3)))
    sky = dataclasses.replace(first, means=20 * first.means).take(np.arange(100))

    def tracker_of(capture, model=rough):  # of a keyframe with errors, as in practice
        tracker = started(model, capture)
        tracker.moving[:] = True
        return tracker

    R = quat_to_matrix(rotvec_to_quat(turn))
    for model in (concatenate([rough, sky]), rough):
        tracker = tracker_of(to(moved(first, turn, shift)), model)
        found, nodes = search(tracker, 1, TINY.motion_search.ratio).next().nodes.numpy(), tracker.pose.nodes.numpy()
        near = np.linalg.norm(nodes, axis=1) < 2
        missed = np.abs(found - (nodes @ R.T + shift))[near].mean()
        assert missed < 0.1, "radii of the blob, most of whose nodes move by more than 1"
        np.testing.assert_array_equal(found[~near], nodes[~near], "the sky stays")
    tracker.moving[:] = False
    assert search(tracker, 1, TINY.motion_search.ratio) is None, "there is nothing to search for"
    near = to(moved(first, 0.03 * turn, 0.03 * shift))
    assert search(tracker_of(near), 1, TINY.motion_search.ratio) is None, "a search takes seconds"


def test_a_limb_that_swings_is_found_where_parts_do_not():
    body, rod, end = blob(300), blob(120, seed=1), np.array([1.3, 0.0, 0.8])
    rod = dataclasses.replace(rod, means=(rod.means * [0.15, 0.15, 0.8] + [1.3, 0, 0]).astype(np.float32))
    turn = np.array([0.8, 0.0, 0.0])
    swung = moved(rod, turn, end - quat_to_matrix(rotvec_to_quat(turn)) @ end)
    first, second = concatenate([body, rod]), concatenate([body, swung])
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([first, second], None)]))
    rough = dataclasses.replace(first, sh0=first.sh0 + 0.3 * np.random.default_rng(0).standard_normal((420, 3)))

    def missed(limb_ratio):
        motion_search = dataclasses.replace(TINY.motion_search, limb_ratio=limb_ratio)
        tracker = started(rough, capture, dataclasses.replace(TINY, motion_search=motion_search))
        tracker.moving[:] = True
        pose = search(tracker, 1, motion_search.ratio) or tracker.pose
        apart = tracker.graph.carry(tracker.graph.means, pose.next())[0].numpy() - second.means
        return [float(np.linalg.norm(x, axis=1).mean()) for x in (apart[:300], apart[300:])]

    of_body, of_rod = missed(TINY.motion_search.limb_ratio)
    assert of_body < 0.05
    assert of_rod < 0.2
    assert missed(np.inf)[1] > 0.5, "or the search for limbs has nothing to do"


def test_a_motion_that_explains_little_of_an_error_is_none():
    """With few views a keyframe fits its own frame far better than the next, and some small motion always fits the next
    a little better."""
    first, turn, shift = blob(300), np.array([0.0, 0.012, 0.0015]), np.array([0.0135, -0.0045, 0.003])
    noise = lambda seed, by: first.sh0 + by * np.random.default_rng(seed).standard_normal((300, 3))  # noqa: E731
    key, other = (dataclasses.replace(first, sh0=noise(*of)) for of in ((0, 0.2), (1, 1.0)))
    sequence = GaussianSequence(25.0, [DenseGroup([first, moved(other, turn, shift)], None)])

    def found(settings):
        tracker = started(key, capture_of(sequence), settings)
        tracker.moving[:] = True
        return search(tracker, 1, settings.motion_search.ratio)

    assert found(TINY) is None
    easy = dataclasses.replace(TINY.motion_search, gain_min=0.0)
    assert found(dataclasses.replace(TINY, motion_search=easy)) is not None, "it does fit better"


def test_nodes_carry_a_rigid_motion_exactly_and_hold_against_others():
    x = torch.from_numpy(blob(200).means)
    graph = NodeGraph.of(
        x, torch.ones(200), 1.0, torch.ones(200, dtype=torch.bool), dataclasses.replace(TINY.graph, nodes=32)
    )
    turn = rotvec_to_quat(torch.tensor([[0.3, -0.2, 0.5]])).repeat(len(graph), 1)
    R = quat_to_matrix(turn)
    nodes = torch.einsum("nij,nj->ni", R, graph.nodes) + 1
    pose = dataclasses.replace(Pose.rest(graph), nodes=nodes, rotations=turn)
    means, turned = graph.carry(x, pose)
    np.testing.assert_allclose(means, x @ R[0].T + 1, atol=1e-5)
    np.testing.assert_allclose(turned, turn[:1].expand(200, 4), atol=1e-5)
    none, still = (torch.zeros(200, 3), torch.zeros(200, 4)), torch.zeros(len(graph), 3)
    by_shifts = lambda at: graph.gradients(x, (at.rotations, still), at, none, 1.0)[1]  # noqa: E731
    stretched = dataclasses.replace(Pose.rest(graph), nodes=1.2 * graph.nodes)
    assert not by_shifts(Pose.rest(graph)).any(), "what is rigid is left alone"
    smaller = 1.2 * graph.nodes - 0.02 * by_shifts(stretched) / by_shifts(stretched).abs().max()
    spread = lambda p: (p - p.mean(0)).norm()  # noqa: E731
    assert spread(smaller) < spread(stretched.nodes), "against the stretch"


def test_nodes_that_carry_what_is_far_do_not_move():
    """If nodes that carry far Gaussians moved, the sky would follow near objects up to the cameras."""
    x = torch.from_numpy(blob(200).means)
    x[:40] *= 12
    everything, far = torch.ones(200, dtype=torch.bool), torch.arange(200) < 40
    settings = dataclasses.replace(TINY.graph, nodes=32)
    graph = NodeGraph.of(x, torch.ones(200), 1.0, everything, settings, far)
    carriers = graph.copy().carriers(everything)
    assert 0 < carriers.sum() < len(graph)
    assert not (carriers & NodeGraph.of(x, torch.ones(200), 1.0, everything, settings).carriers(far)).any()


def test_newcomers_have_nodes_of_their_own_that_change_nothing_for_others():
    x = torch.from_numpy(blob(200).means)
    spawned = 0.2 * torch.from_numpy(blob(60, seed=1).means) + torch.tensor([0.9, 0, 0])  # amid the other Gaussians
    graph = NodeGraph.of(
        x, torch.ones(200), 1.0, torch.ones(200, dtype=torch.bool), dataclasses.replace(TINY.graph, nodes=32)
    )
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
    """A patch in front of a wall: in the next frame beyond the reach of gradients, then gone."""
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


def test_what_no_camera_sees_goes_on_as_it_moved():
    """A ball goes around the origin, is hidden by a shell from all cameras, and comes out of it."""
    shell, ball, place = blob(400), blob(80, seed=1), np.float32([1.4, 0, 0])
    shell = dataclasses.replace(
        shell,
        means=0.35 * shell.means + place,
        log_scales=np.full_like(shell.log_scales, np.log(0.09)),
        logit_opacities=np.full_like(shell.logit_opacities, 6),
    )
    ball = dataclasses.replace(ball, means=0.15 * ball.means + place, log_scales=ball.log_scales - 1)
    angles = [-0.6, -0.1, 0.0, 0.1, 0.2, 0.3]  # of the ball; of 0.1 on its motion is known
    frames = [concatenate([shell, moved(ball, [0, 0, angle], np.zeros(3))]) for angle in angles]
    tracker = started(frames[0], capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in frames])), frames=6)
    tracker.changes.advance(1)
    tracker.moving[400:] = True
    nodes, about_z = tracker.graph.carriers(tracker.moving).float()[:, None], torch.tensor([[0, 0, 1.0]])

    def around(angle):
        """Turn and shift of the ball's nodes around the origin."""
        there = rotate(rotvec_to_quat(angle * about_z), tracker.pose.nodes)
        return angle * about_z * nodes, (there - tracker.pose.nodes) * nodes

    tracker.pose = tracker.pose.moved(*around(0.5))
    assert tracker.changes.within(1, np.float32([[1.4, 0, 0], [0, 0, 4]])).tolist() == [True, False], (
        "what can be found"
    )
    turn, back = around(-0.1)
    tracker.pose = dataclasses.replace(tracker.pose, angular_velocity=-turn, velocity=-back)
    for t, tolerance in ((2, 1e-5), (3, 1e-5), (4, 1e-5), (5, 0.02)):
        tracker.advance(t)
        apart = (tracker.model.params["means"].numpy() - frames[t].means)[400:]
        assert np.linalg.norm(apart.mean(0)) < tolerance, f"frame {t}; it moves by 0.14 a frame"
        assert tracker.coasting[nodes[:, 0] > 0].all() if t < 5 else tracker.moving[400:].any()


def test_masks_say_where_nothing_is():
    """A part of the subject is gone in frame 1, all of it in frame 2: lifetimes of the missing Gaussians end."""
    left, right = (
        dataclasses.replace(g, means=0.35 * g.means + np.float32([x, 0, 0]), log_scales=g.log_scales - 1)
        for g, x in ((blob(100), -0.8), (blob(100, seed=1), 0.8))
    )
    whole, none = concatenate([left, right]), left.take(np.zeros(0, int))
    capture = capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in (whole, left, none, none)]))
    tracker = started(whole, capture, frames=4)
    models, poses = [tracker.model], [tracker.pose]
    for frame in (1, 2, 3):
        loss = tracker.advance(frame)
        models.append(tracker.model)
        poses.append(tracker.pose)
    assert loss is None
    group = GroupModel(tracker.graph, None, models, poses, steps_for(50, 1.0), torch.zeros(200, dtype=torch.bool), TINY)
    end = group.group(None).lifetimes[:, 1]
    assert (end[:100] == 2).all(), "what is left lives in frames 0 and 1"
    assert (end[100:] == 1).sum() > 70, "what is gone ends, but for some at its rim"
    assert set(end) == {1, 2}


def test_the_motion_field_is_zero_at_first_and_learns_a_motion_that_nodes_share():
    nodes = torch.from_numpy(np.random.default_rng(3).uniform(-1, 1, (40, 3)).astype(np.float32))
    settings = MotionFieldSettings()
    field = MotionField(nodes, 2.0, 6, settings, 0, CpuBackend(), AdamSettings())
    first = [field(t) for t in range(6)]
    assert not any(m.turn.any() or m.shift.any() for m in first), "the nodes begin as they were tracked"
    for step in range(300):
        t = step % 6
        motion = field(t)
        wanted = 0.1 * nodes + torch.tensor([0.1 * t, 0.0, 0.2])
        field.step(
            motion,
            2 * (motion.turn - 0.05 * t),
            2 * (motion.shift - wanted),
            settings.searched_rates * 0.1 ** (step / 300),
        )
    for t in range(6):
        motion = field(t)
        assert (motion.turn - 0.05 * t).abs().max() < 0.1
        assert (motion.shift - torch.tensor([0.1 * t, 0.0, 0.2]) - 0.1 * nodes).abs().max() < 0.1
    assert torch.equal(field(2).turn, field(2).turn)
    assert torch.equal(field(2).shift, field(2).shift)
