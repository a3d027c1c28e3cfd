"""What refinement compares with: views drawn of the source, or the pictures of the capture that it was trained on.

A model that was trained is only as near to its pictures as training came. Where they are at hand, rounded values are
held against them and not against the model: so errors of the model are made up for as well, for which they go farther.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from ..capture import Capture, View, blend, cropped
from ..model.camera import Calibration, Camera
from ..model.gaussians import Gaussians
from ..render.sensitivity import GREY, arrays_of, sensitivity_cameras
from ..render.workspace import Workspace

CACHE_BYTES = 1 << 30  # of pictures
DRIFT, DRIFT_MOST = 0.03, 1.0  # toward pictures of the capture: times the root of their pixels per Gaussian; at most

Colour = tuple[float, float, float]
Target = tuple[int, Camera, Colour, np.ndarray]  # frame, camera, background, [H, W, 3] f32 picture over it


class DrawnTargets:
    """Views of the source, by `cameras`, that no step has seen before.

    Attributes:
        drift: quantization steps that the first view moves an integer, times the root of the number of views.
    """

    drift = 0.1

    def __init__(self, cameras: list[Camera]):
        self._cameras = cameras

    def __len__(self) -> int:
        return len(self._cameras)

    def draw(self, source: Callable[[int], Gaussians], frames: int) -> Iterator[Target]:
        """One for each camera; `frames` take turns, all of them before any one again.

        Args:
            source: frame -> what it is to look like.
        """
        workspace, random = Workspace(), np.random.default_rng(0)
        turns = _turns(random, frames, len(self))
        for i, t in zip(random.permutation(len(self)), turns, strict=True):
            picture, _ = workspace.forward(arrays_of(source(t)), self._cameras[i], GREY)
            yield t, self._cameras[i], GREY, picture


class PictureTargets:
    """`count` pictures of the training cameras, all cameras of a frame before any one again, each over a background of
    its own: a haze in the colour of one that is known would pass for opacity.

    Args:
        first_frame: of the capture, where the group begins. calibration: what training found out about its cameras.
        gaussians: in the group.

    Attributes:
        drift: as of `DrawnTargets`; the fewer pixels tell about each Gaussian, the nearer integers stay to the model.
    """

    def __init__(self, capture: Capture, calibration: Calibration, first_frame: int, count: int, gaussians: int):
        self._capture, self._calibration, self._first, self._count = capture, calibration, first_frame, count
        self._trained = capture.indices("train")
        pixels = sum(capture.cameras[i].width * capture.cameras[i].height for i in self._trained)
        self.drift = min(DRIFT_MOST, DRIFT * (pixels / max(gaussians, 1)) ** 0.5)

    def __len__(self) -> int:
        return self._count

    def draw(self, source: Callable[[int], Gaussians], frames: int) -> Iterator[Target]:
        """As of `DrawnTargets`; what the source looks like is not asked."""
        largest = max(4 * c.width * c.height for c in self._capture.cameras)
        read = lru_cache(max(1, CACHE_BYTES // largest))(self._read)
        random, order = np.random.default_rng(0), [[] for _ in range(frames)]
        for t in _turns(random, frames, len(self)):
            order[t] = order[t] or random.permutation(self._trained).tolist()
            i = order[t].pop()
            view, camera = read(i, t)
            background = tuple(random.uniform(0, 1, 3).tolist())
            evened = View(view.rgb / self._calibration.gains[i], view.alpha)
            yield t, camera, background, np.ascontiguousarray(blend(evened, background) / 255, np.float32)

    def _read(self, camera: int, t: int) -> tuple[View, Camera]:
        view = self._capture.view(camera, self._first + t)
        there = self._capture.camera(camera, self._first + t)
        return cropped(view, self._calibration.camera(there, camera))


def targets_of(
    means: np.ndarray, views: int, cameras: list[Camera], pictures: PictureTargets | None
) -> DrawnTargets | PictureTargets | None:
    """The `pictures` if there are any, else so many `views` around `means` [N, 3] (`sensitivity_cameras`). None: no
    views, or nothing to see."""
    if not views or not len(means):
        return None
    return pictures or DrawnTargets(sensitivity_cameras(means, cameras, views))


def _turns(random: np.random.Generator, frames: int, count: int) -> list[int]:
    rounds = [random.permutation(frames) for _ in range(0, count, frames)]
    return np.concatenate(rounds)[:count].tolist()
