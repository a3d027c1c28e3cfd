"""Last stage of training: the integers of a coded group are refined against the pictures of the capture.

Decoded values are compared with the pictures and not with the trained model, so that errors left by training are
corrected as well. The encoder hands over its quantizer, which takes the steps (`follow`); this stage draws the pictures
and sets the size of the steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from ..capture import Capture, View, blend, cropped
from ..model.camera import Camera
from ..model.parametric_group import ParametricGroup
from .settings import RefinementSettings

Picture = tuple[int, Camera, tuple[float, float, float], np.ndarray]  # frame, camera, background, [H, W, 3] f32


class Quantizer(Protocol):
    """A group in integers that can be moved.

    Attributes:
        frames: number of frames of the group.
        gaussians: number of coded Gaussians.
    """

    frames: int
    gaussians: int

    def follow(self, targets: Iterable[Picture], count: int, rate: float) -> None:
        """One optimiser step for each of `count` pictures; the first moves a value by `rate` quantization steps."""


class PictureRefinement:
    """Refines groups against the training pictures of `capture`, whose frame 0 is that of the stream.

    Args:
        views: number of pictures for each group; None: from `settings`.
    """

    def __init__(self, capture: Capture, settings: RefinementSettings | None = None, views: int | None = None):
        self._capture, self._settings, self._views = capture, settings or RefinementSettings(), views
        self._trained = capture.indices("train")

    def __call__(
        self, group: ParametricGroup, first_frame: int, quantizer: Quantizer, views: int | None = None
    ) -> None:
        """Refines `group`, which begins at `first_frame`, against `views` pictures; None: as set on construction.

        Raises:
            CaptureError: a picture cannot be read.
        """
        s, cameras = self._settings, self._capture.cameras
        usual = min(s.passes * len(self._trained), s.frame_pictures) * quantizer.frames
        views = self._views if views is None else views
        count = usual if views is None else views
        if not count:
            return
        pixels = sum(cameras[i].width * cameras[i].height for i in self._trained)
        reach = min(s.reach_max, s.reach * (pixels / max(quantizer.gaussians, 1)) ** 0.5)
        quantizer.follow(self.pictures(group, first_frame, count), count, reach / count**0.5)

    def pictures(self, group: ParametricGroup, first_frame: int, count: int, seed: int = 0) -> Iterator[Picture]:
        """`count` pictures of `group`, which begins at `first_frame`, in random order (`seed`): all frames in turn, all
        cameras of a frame before one comes again. Each picture has a random background: with a known one, haze in its
        colour would pass for transparency.

        Raises:
            CaptureError: a picture cannot be read.
        """
        return (picture for picture, _ in self.masked_pictures(group, first_frame, count, seed))

    def masked_pictures(
        self, group: ParametricGroup, first_frame: int, count: int, seed: int = 0
    ) -> Iterator[tuple[Picture, np.ndarray | None]]:
        """`pictures`, each with its mask, [H, W] u8; None: the capture has none.

        Raises:
            CaptureError: a picture cannot be read.
        """
        calibration, frames = group.calibration, len(group)

        def read(camera: int, t: int) -> tuple[View, Camera]:
            view, there = self._capture.view(camera, first_frame + t), self._capture.camera(camera, first_frame + t)
            return cropped(view, calibration.camera(there, camera))

        largest = max(4 * c.width * c.height for c in self._capture.cameras)
        cached = lru_cache(max(1, self._settings.cache_bytes // largest))(read)
        random, order = np.random.default_rng(seed), [[] for _ in range(frames)]
        rounds = [random.permutation(frames) for _ in range(0, count, frames)]
        for t in np.concatenate(rounds)[:count].tolist():
            order[t] = order[t] or random.permutation(self._trained).tolist()
            i = order[t].pop()
            view, camera = cached(i, t)
            background = tuple(random.uniform(0, 1, 3).tolist())
            evened = replace(view, rgb=calibration.evened(view.rgb, i, t))
            picture = np.ascontiguousarray(blend(evened, background) / 255, np.float32)
            yield (t, camera, background, picture), view.alpha
