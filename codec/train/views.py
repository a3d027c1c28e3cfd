"""Views of a capture as training targets: decoded on demand, kept while memory allows, drawn in random order.

A view is drawn as a crop around the subject where there is a mask: outside it the target is known to be background,
and the mask term needs only a margin of it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..capture import View, cropped
from ..model.camera import Calibration, Camera
from ..model.gaussians import Gaussians
from ..render.backend import Backend, Crop, RenderLoss
from ..render.sensitivity import params_of
from .calibration import Exposure, Extrinsics
from .settings import TrainSettings

CACHE_BYTES = 2 << 30  # of decoded targets: a bound on memory, with no effect on the result
GREY = (0.5, 0.5, 0.5)  # background of images that are compared


@dataclass(frozen=True)
class Target:
    """One image to be matched.

    Attributes:
        camera: pinhole camera of the crop.
        rgb: [H, W, 3] u8, unassociated.
        alpha: [H, W] u8 or None.
        index: of the camera in the capture; gain: [3], its exposure.
    """

    camera: object
    rgb: np.ndarray
    alpha: np.ndarray | None
    index: int
    gain: np.ndarray | None = None


class Views:
    """The training views of a capture, `train_cameras` being their indices; `exposure` and `extrinsics` say by how much
    each differs from what the capture tells."""

    def __init__(self, capture, settings: TrainSettings, backend: Backend):
        self.capture, self.backend = capture, backend
        self.train_cameras = capture.indices("train")
        self.exposure = Exposure(len(capture.cameras), self.train_cameras, settings, backend)
        self.extrinsics = Extrinsics(len(capture.cameras), self.train_cameras, settings, backend)
        self._seed = settings.seed
        self._held: OrderedDict[tuple, View | Target] = OrderedDict()
        self._bytes = 0
        self._order: dict[int, list[int]] = {}
        self._rounds: dict[int, int] = {}

    def view(self, camera: int, frame: int) -> View:
        """Image of camera index `camera` at `frame`, as the capture has it."""
        return self._hold((camera, frame), lambda: self.capture.view(camera, frame))

    def target(self, camera: int, frame: int, scale: float = 1.0) -> Target:
        """View of camera index `camera` at `frame`, cropped to the subject, `scale` times its size (at most 1)."""
        load = lambda: self._cropped(camera, frame) if scale == 1 else shrink(self.target(camera, frame), scale)  # noqa: E731
        held = self._hold((camera, frame, scale), load)
        there = self.extrinsics.camera(camera, held.camera)
        return replace(held, camera=there, gain=self.exposure.gain(camera))

    def camera(self, index: int, frame: int) -> Camera:
        """Camera `index` at `frame`, in its calibrated pose."""
        return self.extrinsics.camera(index, self.capture.camera(index, frame))

    def calibration(self) -> Calibration:
        """Corrections of the poses, and exposures, of all cameras."""
        every = range(len(self.capture.cameras))
        corrections = np.stack([self.extrinsics.correction(i) for i in every])
        return Calibration(corrections, np.stack([self.exposure.gain(i) for i in every]))

    def render(self, g: Gaussians, index: int, frame: int, size: Sequence[int] | None = None) -> np.ndarray:
        """Gaussians as camera `index` shows them at `frame`, with its exposure, over mid-grey; [H, W, 3] u8.

        Args:
            size: width and height; those of the camera if None.
        """
        camera = self.camera(index, frame)
        camera = camera if size is None else camera.resized(*size)
        image, _ = self.backend.render(params_of(self.exposure.seen(g, index)), camera, GREY)
        return np.floor(255 * image.clip(0, 1) + 0.5).astype(np.uint8)

    def _hold(self, key: tuple, load: Callable[[], View | Target]):
        """What `load` gives, which is kept as long as there is room."""
        if key not in self._held:
            self._held[key] = load()
            self._bytes += self._size(self._held[key])
            while self._bytes > CACHE_BYTES and len(self._held) > 1:
                _, old = self._held.popitem(last=False)
                self._bytes -= self._size(old)
        self._held.move_to_end(key)
        return self._held[key]

    def restart(self) -> None:
        """Draws anew, as a run that goes on from here will."""
        self._order.clear()
        self._rounds.clear()

    def draw(self, frame: int, scale: float = 1.0) -> Target:
        """The next view of `frame`; every camera once before any comes again, in an order that depends on the frame
        and not on what was drawn before (a resumed run draws the same)."""
        order = self._order.get(frame)
        if not order:
            turn = self._rounds[frame] = self._rounds.get(frame, 0) + 1
            rng = np.random.default_rng([self._seed, frame, turn])
            order = self._order[frame] = rng.permutation(self.train_cameras).tolist()
        return self.target(order.pop(), frame, scale)

    @staticmethod
    def _size(t: View | Target) -> int:
        return t.rgb.nbytes + (0 if t.alpha is None else t.alpha.nbytes)

    def _cropped(self, camera: int, frame: int) -> Target:
        view, there = cropped(self.view(camera, frame), self.capture.camera(camera, frame))
        return Target(there, view.rgb, view.alpha, camera)


def shrink(target: Target, scale: float) -> Target:
    """The same view on fewer pixels, each the mean of those it covers."""
    import cv2

    height, width = target.rgb.shape[:2]
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    alpha = np.full((height, width), 255, np.uint8) if target.alpha is None else target.alpha
    share = (alpha / np.float32(255))[..., None]
    small = cv2.resize(share, size, interpolation=cv2.INTER_AREA)
    rgb = cv2.resize(target.rgb * share, size, interpolation=cv2.INTER_AREA) / np.maximum(small, 1e-3)[..., None]
    return Target(
        target.camera.resized(*size),
        np.rint(rgb.clip(0, 255)).astype(np.uint8),
        None if target.alpha is None else np.rint(255 * small).astype(np.uint8),
        target.index,
    )


def photometric_loss(
    params: dict, target: Target, settings: TrainSettings, rng: np.random.Generator, backend: Backend
) -> RenderLoss:
    """Loss of Gaussians against one target (`Backend.photometric_loss`). The background is random in each step, so that
    opacity is learned instead of a background painted with Gaussians."""
    background = tuple(rng.uniform(0, 1, 3))
    crop = Crop(target.camera, target.rgb, target.alpha, background, target.gain)
    return backend.photometric_loss(params, [crop], ssim_lambda=settings.ssim_lambda, mask_lambda=settings.mask_lambda)


def view_losses(
    params: dict, views: Views, frame: int, settings: TrainSettings, scale: float = 1.0
) -> Iterator[RenderLoss]:
    """`photometric_loss` against every training view of `frame`, in the order of the cameras."""
    rng = np.random.default_rng(settings.seed)
    for camera in views.train_cameras:
        yield photometric_loss(params, views.target(camera, frame, scale), settings, rng, views.backend)
