"""Tiny captures with known ground truth for tests of training, and settings that train them in seconds."""

import dataclasses

import numpy as np
from synthetic import blob

from gscodec.capture.capture import Capture
from gscodec.capture.images import View
from gscodec.metrics.image import psnr
from gscodec.model.camera import Camera, look_at
from gscodec.model.gaussian_sequence import GaussianSequence
from gscodec.render.image import render_image, render_rgba
from gscodec.train.settings import BudgetSettings, KeyframeSettings, TrainSettings

SIZE = 64
AS_SET = BudgetSettings(steps_most=1.0)  # number of steps as set, also for small pictures
TINY = TrainSettings(
    gop=3,
    keyframe_steps=150,
    motion_steps=60,
    finetune_steps=10,
    gaussians_max=600,
    initial_points=300,
    sh_degree=1,
    budget=AS_SET,
    keyframe=KeyframeSettings(teachers=0),  # after so few steps they know less than the pictures
)


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
    """A capture of the sequence by the rig."""
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


def psnr_of(model_or_gaussians, capture, frame):
    g = model_or_gaussians.gaussians() if hasattr(model_or_gaussians, "gaussians") else model_or_gaussians
    camera = capture.cameras[-1]
    view = capture.view(len(capture.cameras) - 1, frame)
    a = view.alpha[..., None] / 255
    reference = np.rint(view.rgb * a + 127.5 * (1 - a)).astype(np.uint8)
    return psnr(reference, render_image(g, camera))


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
    """Six cameras in front of the wall."""
    K = np.array([[150.0, 0, 64], [0, 150.0, 48], [0, 0, 1]])
    eyes = [(x, -3.0, z) for z in (-0.3, 0.3) for x in (-0.8, 0, 0.8)]
    return [Camera(f"cam{i}", K, look_at(eye, np.zeros(3), [0, 0, 1]), 128, 96) for i, eye in enumerate(eyes)]
