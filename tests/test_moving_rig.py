"""A procedural rig whose cameras move, each in its own way: written, read back, trained, evaluated."""

from dataclasses import replace

import numpy as np
import pytest
from training import AS_SET

from bench.procedural import Scene, placed, write_transforms
from bench.stress_scenes import walking
from bench.train import held_out, part
from gscodec.capture import Capture, open_capture
from gscodec.metrics.evaluate import evaluate_capture
from gscodec.train.settings import TrainSettings
from gscodec.train.train import train_groups

HANDHELD, ORBIT = (3.0, 0.06), 2.0
TINY = TrainSettings(
    gop=2, keyframe_steps=200, motion_steps=30, finetune_steps=10, gaussians_max=800, initial_points=400, budget=AS_SET
)


def ball_at(t: int) -> np.ndarray:
    return np.array([0.2 * np.cos(t), 0.2 * np.sin(t), 0.1 * t])


def rig(frames: int = 4, size: int = 64, **options) -> Scene:
    """Three training cameras and a test camera around one small ball."""
    ball = lambda t: [placed(True, (0.08,) * 3, ball_at(t), (0.8, 0.5, 0.3))]  # noqa: E731
    return Scene(ball, frames=frames, train=3, test=1, size=size, handheld=HANDHELD, orbit=ORBIT, **options)


def test_every_camera_moves_smoothly_and_in_its_own_way():
    capture = rig(frames=20).capture("rig")
    assert capture.moves
    still = replace(capture, poses=None)
    assert not still.moves
    assert still.camera(0, 3) is still.cameras[0]
    shake = Scene(lambda t: [], frames=20, train=3, test=1, handheld=HANDHELD).capture("shake")
    centers = np.array([[shake.camera(i, t).center for t in range(20)] for i in range(4)])  # [C, T, 3]
    step, spread = np.linalg.norm(np.diff(centers, axis=1), axis=2), np.linalg.norm(np.ptp(centers, axis=1), axis=1)
    assert (step.max(1) < 0.5 * spread).all()
    assert (spread > 0.05).all()
    moves = (centers - centers[:, :1]).reshape(4, -1)
    assert np.abs(np.corrcoef(moves)[np.triu_indices(4, 1)]).max() < 0.95


def test_poses_come_back_where_the_pictures_are(tmp_path):
    """The read cameras project the centre of the ball to the centre of its pictures."""
    truth = rig().capture("rig")
    write_transforms(truth, tmp_path)
    capture = open_capture(tmp_path)
    assert (capture.frame_count, capture.moves) == (4, True)
    assert [(c.name, c.split) for c in capture.cameras] == [(c.name, c.split) for c in truth.cameras]
    for i in range(len(capture.cameras)):
        for t in range(capture.frame_count):
            camera = capture.camera(i, t)
            np.testing.assert_allclose(camera.viewmat, truth.camera(i, t).viewmat, atol=1e-6)
            np.testing.assert_allclose(camera.K, truth.camera(i, t).K, rtol=1e-6)
            assert np.abs(projected(camera, ball_at(t)) - centroid(capture.view(i, t).alpha)).max() < 0.5
    assert np.abs(projected(capture.cameras[0], ball_at(3)) - centroid(capture.view(0, 3).alpha)).max() > 2


def projected(camera, point: np.ndarray) -> np.ndarray:
    x = camera.K @ (camera.viewmat[:3, :3] @ point + camera.viewmat[:3, 3])
    return x[:2] / x[2]


def centroid(alpha: np.ndarray) -> np.ndarray:
    """x, y in pixels, whose centres are at half-integers."""
    y, x = np.indices(alpha.shape) + 0.5
    return np.array([(x * alpha).sum(), (y * alpha).sum()]) / alpha.sum()


def test_parts_of_a_capture_keep_their_poses():
    """Parts: a range of frames, a scale, other test cameras, every other frame."""
    capture = rig().capture("rig")
    last = capture.frames(2).scaled(0.5)
    np.testing.assert_array_equal(last.camera(1, 1).viewmat, capture.camera(1, 3).viewmat)
    np.testing.assert_array_equal(last.cameras[1].viewmat, capture.camera(1, 2).viewmat)
    np.testing.assert_array_equal(last.camera(1, 1).K[:2], 0.5 * capture.camera(1, 3).K[:2])
    held = held_out(capture, ("cam01",))
    assert [c.name for c in held.cameras] == ["cam00", "cam01", "cam02"]
    assert (held.camera(1, 3).name, held.camera(1, 3).split) == ("cam01", "test")
    np.testing.assert_array_equal(held_out(capture, ("test0",)).camera(3, 2).viewmat, capture.camera(3, 2).viewmat)
    other = part(capture.frames(1), range(0, 3, 2))
    assert (other.frame_count, other.moves) == (2, True)
    np.testing.assert_array_equal(other.camera(0, 1).viewmat, capture.camera(0, 3).viewmat)
    np.testing.assert_array_equal(other.view(0, 1).alpha, capture.view(0, 3).alpha)


def test_wrong_poses_stay_as_wrong_as_they_are():
    """The calibration error of a moving camera is the same in all frames, as for a static camera."""
    true, told = (rig(pose_noise=n).capture("rig") for n in ((0, 0), (0.5, 0.01)))
    wrong = [told.camera(1, t).viewmat @ np.linalg.inv(true.camera(1, t).viewmat) for t in range(4)]
    assert np.linalg.norm(wrong[0][:3, 3]) == pytest.approx(0.01)
    np.testing.assert_allclose(wrong[3], wrong[0], atol=1e-12)


def psnr_of_second(capture: Capture, truth: Capture) -> float:
    """psnr_fg on the test camera of `truth` after a short training on `capture`, in frame 1."""
    frames = [g for group in train_groups(capture, TINY) for g in map(group.frame, range(len(group)))]
    return evaluate_capture(lambda t: frames[t], truth, with_vmaf=False)["per_frame"][1]["psnr_fg"]


def test_training_has_the_camera_of_each_frame():
    """The same training with the cameras of the first frame in all frames is far worse."""
    figure = lambda t: walking(t, 0.3)  # noqa: E731
    capture = Scene(figure, frames=2, train=8, test=1, size=64, handheld=(6.0, 0.12), orbit=5.0).capture("walking")
    moving, fixed = psnr_of_second(capture, capture), psnr_of_second(replace(capture, poses=None), capture)
    assert moving > 23.5
    assert moving > fixed + 3
