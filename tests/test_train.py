"""Training of whole sequences: groups, segments, checkpoints, settings, refused inputs."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import blob, turning
from training import TINY, capture_of, psnr_of

from gscodec.errors import CaptureError, UsageError
from gscodec.model.gaussian_sequence import DenseGroup, GaussianSequence
from gscodec.train.budget import keyframe_budget, with_frame_budget
from gscodec.train.checkpoint import Checkpoint
from gscodec.train.ray_jobs import train_segment
from gscodec.train.settings import train_settings
from gscodec.train.tracking import Tracker
from gscodec.train.train import segments, train_groups


@pytest.fixture(scope="module")
def capture():
    return capture_of(turning(300, frames=5))


def test_light_that_comes_on_starts_a_group():
    dark = blob(200)
    lit = dataclasses.replace(dark, sh0=dark.sh0 + 0.6)
    of_frames = lambda *frames: capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in frames]))  # noqa: E731
    settings = dataclasses.replace(TINY, gop=8, finetune_steps=30)
    capture = of_frames(*(dark,) * 5, lit, lit)
    first, second = train_groups(capture, settings)
    assert (len(first), first.ended, len(second)) == (5, "change", 2)
    np.testing.assert_array_equal(first.frame(0).sh0, first.frame(4).sh0)
    assert second.parents is not None, "what is lit is still there"
    (alone,) = train_groups(of_frames(lit, lit), settings)
    assert psnr_of(second.frame(1), capture, 6) > psnr_of(alone.frame(1), capture, 6) - 1.0


def test_a_jump_starts_a_group():
    """In one group, low temporal frequencies would spread the jump over all frames."""
    whole = blob(300)
    at = lambda x: DenseGroup([dataclasses.replace(whole, means=whole.means + np.float32([x, 0, 0]))])  # noqa: E731
    frames = [at(0.03 * t) for t in range(6)] + [at(-0.6 + 0.03 * t) for t in range(2)]
    capture = capture_of(GaussianSequence(25.0, frames))
    first, second = train_groups(capture, dataclasses.replace(TINY, gop=10, finetune_steps=30))
    assert (len(first), first.ended, len(second)) == (6, "jump", 2)
    assert second.parents is not None
    assert psnr_of(second.frame(0), capture, 6) > 33


def test_the_first_frame_that_is_fitted_may_lose_more_than_the_next(capture, monkeypatch):
    """No tracked frame fits as well as the keyframe: the bound of a cut does not apply to the first tracked frame."""
    advance, losses = Tracker.advance, iter((1.8, 2.9))  # times the keyframe's loss; cut: 1.5 times the last

    def scripted(self, frame, on_step=None):
        key = self.loss if frame == 1 else self.loss / 1.8
        advance(self, frame, on_step)
        self.loss = key * next(losses)
        return self.loss

    monkeypatch.setattr(Tracker, "advance", scripted)
    group = dataclasses.replace(TINY.group, drift_ratio=10.0, cut_loss_floor=0.0)
    first = next(train_groups(capture, dataclasses.replace(TINY, group=group)))
    assert (len(first), first.ended) == (2, "cut")


def test_what_comes_into_the_pictures_has_a_keyframe():
    """A figure walks in: its part in the first frame is too small to grow the rest from."""
    whole = blob(300)
    part = whole.take(whole.means[:, 0] > 0.7)
    frames = [DenseGroup([g]) for g in (part, part, whole, whole)]
    group = dataclasses.replace(TINY.group, cut_loss_floor=10.0)  # no cut, at any loss
    settings = dataclasses.replace(TINY, gop=8, group=group)
    first, second = train_groups(capture_of(GaussianSequence(25.0, frames)), settings)
    assert (len(first), first.ended, len(second), second.parents) == (2, "more", 2, None)


@pytest.mark.parametrize(("last", "lengths"), [(6, [3, 3]), (7, [3, 2, 2])])
def test_few_frames_that_drift_pay_for_no_keyframe(last, lengths, monkeypatch):
    """Drift starts at frame 5. Of six frames one is left: less than a quarter of the five frames of the keyframe."""
    advance = Tracker.advance

    def scripted(self, frame, on_step=None):
        key = self.loss / (1.2 if frame > 1 else 1.0)
        advance(self, frame, on_step)
        self.loss = 1.2 * key
        return self.loss * (2 if frame == 5 else 1)

    monkeypatch.setattr(Tracker, "advance", scripted)
    group = dataclasses.replace(TINY.group, drift_ratio=2.0, cut_loss_floor=0.0)
    settings = dataclasses.replace(TINY, group=group, cut_ratio=10.0)
    groups = list(train_groups(capture_of(turning(300, frames=last)), settings))
    assert [len(g) for g in groups] == lengths


def test_larger_pictures_have_longer_keyframes_whose_fit_frames_need_not_reach():
    """The same for presets with longer keyframes; small pictures change neither the fit nor the bound."""

    def bound_and_steps(side, preset="medium"):
        views, settings = SimpleNamespace(covered=lambda _: [side * side]), train_settings(preset)
        frames = with_frame_budget(settings, views, 0)
        return frames.group.drift_ratio, keyframe_budget(views, 0, settings).steps, frames.motion_steps

    usual = int(np.sqrt(train_settings("medium").budget.pixels))
    ratio, steps, motion_steps = bound_and_steps(usual)
    large = bound_and_steps(2 * usual)
    assert large == (pytest.approx(ratio * 2**0.75, rel=1e-2), pytest.approx(2 * steps, rel=1e-2), motion_steps / 2)
    assert bound_and_steps(usual // 4)[0] == ratio
    slow = bound_and_steps(usual, "slow")[0]
    assert slow == pytest.approx(2.232 * ratio, abs=0.01), "frames may lose as much as with medium"


def test_a_frame_is_as_sharp_where_the_others_are_empty():
    """Empty frames carry no information on a Gaussian's value, its quantization steps, or the success of tracking. A
    subject in three frames is 0.9 to 1.1 dB sharper than in one, over three seeds."""
    whole = blob(200)
    none = whole.take(np.zeros(0, int))
    settings = dataclasses.replace(TINY, keyframe_steps=200, finetune_steps=30)

    def trained(*frames):
        capture = capture_of(GaussianSequence(25.0, [DenseGroup([g]) for g in frames]))
        groups = list(train_groups(capture, settings))
        models = [g.frame(t) for g in groups for t in range(len(g))]
        return [psnr_of(models[t], capture, t) for t in range(3) if len(frames[t])], [len(g) for g in groups]

    (least, *_), _ = trained(whole, whole, whole)
    (gone,), lengths = trained(whole, none, none)
    assert lengths == [3]
    assert gone > least - 1.2
    come, lengths = trained(none, whole, whole)
    assert lengths == [1, 2]
    assert min(come) > least - 1


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
    # The first group is trained again from scratch, the second from the checkpoint of the first.
    first = next(iter(train_groups(capture, TINY, checkpoints=tmp_path / "again")))
    np.testing.assert_array_equal(first.frame(2).means, groups[0].frame(2).means)
    (rest,) = train_groups(capture, TINY, first_frame=3, checkpoints=tmp_path / "again")
    np.testing.assert_array_equal(rest.frame(1).means, groups[1].frame(1).means)


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
    """A run is resumed by its fingerprint, which is JSON."""
    stored = dataclasses.asdict(TINY)
    assert json.loads(json.dumps(stored)) == stored


def test_what_cannot_be_trained_is_said():
    with pytest.raises(UsageError, match="fast, medium, slow"):
        train_settings("turbo")
    capture = capture_of(turning(50, frames=1))
    held = dataclasses.replace(capture, cameras=[dataclasses.replace(c, split="test") for c in capture.cameras])
    with pytest.raises(CaptureError, match="training camera"):
        next(train_groups(held, TINY))
