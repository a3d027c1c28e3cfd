"""Pseudo views: cameras between the training cameras, pictures of several models, what a keyframe learns of them."""

import dataclasses

import numpy as np
import pytest
from synthetic import turning
from training import TINY, capture_of

from gscodec.model.camera import Camera, look_at
from gscodec.render.cpu import CpuBackend
from gscodec.render.image import render_rgba
from gscodec.render.sensitivity import params_of
from gscodec.train import keyframe
from gscodec.train.calibration import Exposure
from gscodec.train.initialization import initial_model
from gscodec.train.pseudo_views import between, pseudo_view
from gscodec.train.settings import KeyframeSettings, train_settings
from gscodec.train.views import Views


def ring(count: int) -> list[Camera]:
    K = np.array([[80.0, 0, 64], [0, 80.0, 64], [0, 0, 1]])
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [np.array([3 * np.cos(a), 3 * np.sin(a), 0.5]) for a in angles]
    return [Camera(f"{i}", K, look_at(eye, np.zeros(3), [0, 0, 1]), 128, 128) for i, eye in enumerate(eyes)]


def test_a_pseudo_camera_stands_halfway_and_looks_where_its_neighbours_look():
    cameras = ring(8)
    found = between(cameras)
    assert len(found) == 8  # each has two neighbours, each pair counts once
    for camera in found:
        assert np.linalg.norm(camera.center) == pytest.approx(np.linalg.norm(cameras[0].center))
        angles = sorted(np.degrees(np.arccos(camera.center @ c.center / (c.center @ c.center))) for c in cameras)
        assert angles[0] == pytest.approx(angles[1], abs=0.1)
        assert angles[1] < 23
        in_view = camera.viewmat[:3, 3]  # the origin
        np.testing.assert_allclose(in_view / in_view[2], [0, 0, 1], atol=0.02)
    assert between(ring(4)) == []  # a right angle apart
    assert between(cameras[:1]) == []


@pytest.mark.parametrize("opaque", [True, False])
def test_a_pseudo_view_is_the_mean_picture_of_its_models(opaque):
    camera, backend = between(ring(8))[0], CpuBackend()
    a, b = (turning(300, frames=6).frame(t) for t in (0, 5))
    target = pseudo_view(camera, [params_of(a), params_of(b)], opaque, backend)
    crop = target.camera
    rgba = np.mean([render_rgba(g, crop) for g in (a, b)], 0)
    alpha = np.ones(rgba.shape[:2]) if opaque else target.alpha / 255
    background = 0.5 * (1 - rgba[..., 3:]) if opaque else 0
    np.testing.assert_allclose(target.rgb / 255 * alpha[..., None], rgba[..., :3].clip(0, 1) + background, atol=6e-3)
    if not opaque:
        np.testing.assert_allclose(alpha, rgba[..., 3], atol=3e-3)
        assert crop.width < camera.width or crop.height < camera.height


def test_a_keyframe_sees_pseudo_views_as_long_as_it_grows(monkeypatch):
    """They teach no camera its exposure; teachers see the capture alone."""
    capture, exposed, drawn = capture_of(turning(300, frames=1)), [], []
    learn, start = Exposure.learn, keyframe.start_photometric_loss

    def spied(params, targets, *more):
        drawn.append(targets[0].index)
        return start(params, targets, *more)

    monkeypatch.setattr(keyframe, "start_photometric_loss", spied)
    monkeypatch.setattr(
        Exposure, "learn", lambda self, camera, *more: (exposed.append(camera), learn(self, camera, *more))
    )
    settings = dataclasses.replace(TINY, keyframe=KeyframeSettings(teachers=2))
    model, radius = initial_model(capture, 0, 300, settings)
    keyframe.train_keyframe(model, Views(capture, settings, CpuBackend()), 0, settings, steps=100, radius=radius)
    teachers, growing, grown = drawn[:200], drawn[200:260], drawn[260:]
    assert len(grown) == 40
    assert None not in teachers + grown
    count = len(between([capture.cameras[i] for i in capture.indices("train")]))
    assert growing[: count + 9].count(None) == count > 0
    assert exposed == [i for i in drawn if i is not None]


@pytest.mark.parametrize(("views", "masks", "teachers"), [(12, True, 2), (20, True, 0), (20, False, 2)])
def test_many_masks_leave_little_to_chance(views, masks, teachers):
    cameras = ring(views)
    capture = dataclasses.replace(capture_of(turning(30, frames=1), masks), cameras=cameras)
    assert train_settings("medium").of_capture(capture).keyframe.teachers == teachers
