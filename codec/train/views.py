"""Views of a capture as training targets: decoded on demand, cached, drawn in random order; and their loss.

Where there is a mask, a target is a crop around the subject: the rest of the image is known to be background, and the
mask term needs only a margin of it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from ..capture import View, cropped
from ..capture.epipolar import epipolar_error
from ..errors import CaptureError
from ..model.camera import Calibration, Camera, meeting_point, working_distance
from ..model.gaussians import Gaussians
from ..render.backend import Backend, LossWeights, PendingLoss, RenderLoss, TargetView
from ..render.sensitivity import params_of
from .calibration import Exposure, Extrinsics
from .model import SizeBound
from .settings import TrainSettings
from .visual_hull import project

GREY = (0.5, 0.5, 0.5)  # background of images that are compared


@dataclass(frozen=True)
class Target:
    """One image that a step trains on.

    Attributes:
        camera: pinhole camera of the crop, in its calibrated pose.
        rgb: [H, W, 3] u8, unassociated colour.
        alpha: [H, W] u8; 255 everywhere where the capture has no masks.
        index: of the camera in the capture; None: a pseudo view (pseudo_views.py).
        depth: [H, W] f32, world units along the optical axis, 0 where unknown; None: the camera has no depth images.
        opaque: the capture has no masks.
        exposure: gain and offset of the camera, [3] each; None: 1 and 0.
    """

    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    index: int | None
    depth: np.ndarray | None = None
    opaque: bool = False
    exposure: tuple[np.ndarray, np.ndarray] | None = None


class Views:
    """The training views of a capture and the calibration of their cameras.

    All training uses this class, so it limits torch to one thread, in the whole process: torch handles small tensors,
    and its idle threads would take cores from the native kernels. The number of threads changes sums in their
    last bits.

    Args:
        backend: device of everything that is rendered or optimised against these views.

    Attributes:
        train_cameras: indices of the training cameras in the capture.
        exposure, extrinsics: corrections of each camera.

    Raises:
        CaptureError: there is no training camera.
    """

    def __init__(self, capture, settings: TrainSettings, backend: Backend):
        torch.set_num_threads(1)
        self.capture, self.backend = capture, backend
        self.train_cameras = capture.indices("train")
        if not self.train_cameras:
            raise CaptureError(f"{capture.name}: no training camera, expected at least one with split 'train'")
        self.exposure = Exposure(len(capture.cameras), self.train_cameras, settings, backend)
        self.extrinsics = Extrinsics(len(capture.cameras), self.train_cameras, settings, backend)
        self._seed, self._cache_bytes = settings.seed, settings.cache_bytes
        self._poses_learn = settings.calibration.refine_poses
        self._pose_error_min = settings.calibration.pose_error_min
        self._sizes = settings.sizes
        self._cache: OrderedDict[tuple, View | Target] = OrderedDict()
        self._bytes = 0
        self._order: dict[int, list[int]] = {}
        self._rounds: dict[int, int] = {}

    @property
    def largest_side(self) -> int:
        """Largest side of the pictures, pixels."""
        return max(max(self.capture.cameras[i].width, self.capture.cameras[i].height) for i in self.train_cameras)

    @cached_property
    def working_distance(self) -> float:
        """Working distance of the training cameras (`camera.working_distance`), world units."""
        return working_distance([self.capture.cameras[i] for i in self.train_cameras])

    @cached_property
    def meeting_point(self) -> np.ndarray:
        """[3] f64, meeting point of the optical axes of the training cameras (`camera.meeting_point`), world units."""
        return meeting_point([self.capture.cameras[i] for i in self.train_cameras])

    def distance(self, means: np.ndarray) -> np.ndarray:
        """[N] distances of `means` [N, 3] from `meeting_point`; 0 where there are masks, since then nothing is far."""
        if self.capture.has_alpha:
            return np.zeros(len(means))
        return np.linalg.norm(means - self.meeting_point, axis=1)

    def nearness(self, means: np.ndarray, frame: int, margin: float) -> np.ndarray:
        """[N], working distance over the depth of each of `means` [N, 3], in the nearest training camera that would
        show it in a picture `margin` times as wide and high; 0: no camera would."""
        nearest = np.zeros(len(means))
        for index in self.train_cameras:
            camera = self.camera(index, frame)
            p, depth = project(camera, means)
            size = np.array([camera.width, camera.height])
            before = (depth > camera.near) & (np.abs(p - size / 2) < margin * size / 2).all(1)
            np.maximum(nearest, self.working_distance / np.where(before, depth, np.inf), out=nearest)
        return nearest

    @cached_property
    def size_bound(self) -> SizeBound | None:
        """Bound on the scales of all Gaussians; None where there are masks."""
        if self.capture.has_alpha:
            return None
        center, near = torch.from_numpy(self.meeting_point).float(), self._sizes.near * self.working_distance
        return SizeBound(center, near, self._sizes.share)

    def view(self, camera: int, frame: int) -> View:
        """Image of camera `camera` at `frame` as the capture gives it."""
        return self._cached((camera, frame), lambda: self.capture.view(camera, frame))

    def show(self, frame: int) -> bool:
        """Whether a training camera sees something at `frame`: always, where there are no masks."""
        seen = (self.view(camera, frame).alpha for camera in self.train_cameras)
        return any(alpha is None or alpha.any() for alpha in seen)

    def covered(self, frame: int) -> list[int]:
        """Pixels of each training camera's picture that show the scene: all of them where there are no masks."""
        pictures = [self.view(camera, frame) for camera in self.train_cameras]
        return [v.rgb.shape[0] * v.rgb.shape[1] if v.alpha is None else np.count_nonzero(v.alpha) for v in pictures]

    def target(self, camera: int, frame: int, scale: float = 1.0) -> Target:
        """View of camera `camera` at `frame`, cropped to the subject; `scale` (at most 1) times its size."""

        def load() -> Target:
            return self._cropped(camera, frame) if scale == 1 else shrink(self.target(camera, frame), scale)

        target = self._cached((camera, frame, scale), load)
        moved = self.extrinsics.camera(camera, target.camera)
        return replace(target, camera=moved, exposure=self.exposure.of(camera, frame))

    def camera(self, index: int, frame: int) -> Camera:
        """Camera `index` at `frame`, in its calibrated pose."""
        return self.extrinsics.camera(index, self.capture.camera(index, frame))

    def calibration(self, frames: range) -> Calibration:
        """Corrections of the poses, and exposures, of all cameras in `frames`."""
        every = range(len(self.capture.cameras))
        corrections = np.stack([self.extrinsics.correction(i) for i in every])
        exposures = np.array([[self.exposure.of(i, frame) for i in every] for frame in frames], np.float32)
        return Calibration(corrections, exposures[:, :, 0], exposures[:, :, 1])

    def render(self, g: Gaussians, index: int, frame: int, size: Sequence[int] | None = None) -> np.ndarray:
        """Gaussians as camera `index` shows them at `frame`, with its exposure, over mid-grey; [H, W, 3] u8.

        Args:
            size: width and height; those of the camera if None.
        """
        camera = self.camera(index, frame)
        camera = camera if size is None else camera.resized(*size)
        image, _ = self.backend.render(params_of(self.exposure.applied_to(g, index, frame)), camera, GREY)
        return np.floor(255 * image.clip(0, 1) + 0.5).astype(np.uint8)

    def _cached(self, key: tuple, load: Callable[[], View | Target]) -> View | Target:
        """The result of `load`, cached up to `cache_bytes` of the settings; the least recently used goes first."""
        if key not in self._cache:
            self._cache[key] = load()
            self._bytes += self._size(self._cache[key])
            while self._bytes > self._cache_bytes and len(self._cache) > 1:
                _, old = self._cache.popitem(last=False)
                self._bytes -= self._size(old)
        self._cache.move_to_end(key)
        return self._cache[key]

    def reset_calibration(self, frame: int, center: np.ndarray, radius: float) -> None:
        """Resets colours and poses to those of the capture, for a subject around `center` ([3], world units). Poses are
        learned from `frame` on if those of the capture contradict its pictures."""
        self.exposure.reset()
        if self._poses_learn is None:
            error = epipolar_error(self.capture, frame, self.train_cameras, lambda i: self.view(i, frame))
            self._poses_learn = None if error is None else error > self._pose_error_min
        self.extrinsics.learns = bool(self._poses_learn)
        self.extrinsics.reset()
        self.extrinsics.set_subject(center, radius)

    def restart_order(self) -> None:
        """Draws views in the order of a run that starts here, so that a resumed run draws the same ones."""
        self._order.clear()
        self._rounds.clear()

    def draw(self, frame: int, scale: float = 1.0) -> Target:
        """The next view of `frame`: every camera once, in random order. It depends on the frame and on how often it was
        drawn since `restart_order`."""
        order = self._order.get(frame)
        if not order:
            number = self._rounds[frame] = self._rounds.get(frame, 0) + 1
            rng = np.random.default_rng([self._seed, frame, number])
            order = self._order[frame] = rng.permutation(self.train_cameras).tolist()
        return self.target(order.pop(), frame, scale)

    @staticmethod
    def _size(t: View | Target) -> int:
        return sum(a.nbytes for a in (t.rgb, t.alpha, t.depth) if a is not None)

    def _cropped(self, camera: int, frame: int) -> Target:
        view, crop = cropped(self.view(camera, frame), self.capture.camera(camera, frame))
        opaque = view.alpha is None
        alpha = np.full(view.rgb.shape[:2], 255, np.uint8) if opaque else view.alpha
        return Target(crop, view.rgb, alpha, camera, view.depth, opaque)


def shrink(target: Target, scale: float) -> Target:
    """The same view at `scale` times its size; a pixel is the mean of those it covers, with the depth of one."""
    import cv2

    height, width = target.rgb.shape[:2]
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    share = (target.alpha / np.float32(255))[..., None]
    small = cv2.resize(share, size, interpolation=cv2.INTER_AREA)
    rgb = cv2.resize(target.rgb * share, size, interpolation=cv2.INTER_AREA) / np.maximum(small, 1e-3)[..., None]
    return replace(
        target,
        camera=target.camera.resized(*size),
        rgb=np.rint(rgb.clip(0, 255)).astype(np.uint8),
        alpha=np.rint(255 * small).astype(np.uint8),
        depth=None if target.depth is None else cv2.resize(target.depth, size, interpolation=cv2.INTER_NEAREST_EXACT),
    )


def _target_view(target: Target, rng: np.random.Generator) -> TargetView:
    background = GREY if target.opaque else tuple(rng.uniform(0, 1, 3))
    return TargetView(target.camera, target.rgb, target.alpha, background, target.exposure, target.depth)


def photometric_loss(
    params: dict, target: Target, settings: TrainSettings, rng: np.random.Generator, backend: Backend
) -> RenderLoss:
    """Loss of Gaussians against one target (`Backend.photometric_loss`). Targets with alpha have a random background:
    with a known one, Gaussians in its colour could stand for transparency. Opaque targets have a grey background, which
    Gaussians must cover."""
    return backend.photometric_loss(params, [_target_view(target, rng)], _weights(settings))


def start_photometric_loss(
    params: dict, targets: Sequence[Target], settings: TrainSettings, rng: np.random.Generator, backend: Backend
) -> PendingLoss:
    """`photometric_loss` of Gaussians as they are now against all `targets`, summed, in parallel to the caller
    (`Backend.start_photometric_loss`)."""
    views = [_target_view(t, rng) for t in targets]
    return backend.start_photometric_loss(params, views, _weights(settings))


def photometric_loss_value(
    params: dict, targets: Sequence[Target], settings: TrainSettings, rng: np.random.Generator, backend: Backend
) -> float:
    """`photometric_loss` of Gaussians against all `targets`, summed, without gradients."""
    return backend.photometric_loss_value(params, [_target_view(t, rng) for t in targets], _weights(settings))


def _weights(settings: TrainSettings) -> LossWeights:
    return LossWeights(settings.ssim_lambda, settings.mask_lambda, settings.depth_lambda)


def add_harmonics_prior(
    grads: dict[str, torch.Tensor], params: dict, settings: TrainSettings, pictures: int = 1
) -> None:
    """Adds to the gradients of `pictures` pictures those of half the square of the harmonics."""
    shN = params["shN"]
    grads["shN"].add_(shN, alpha=pictures * settings.harmonics_lambda / len(shN))


def view_losses(
    params: dict, views: Views, frame: int, settings: TrainSettings, scale: float = 1.0
) -> Iterator[RenderLoss]:
    """`photometric_loss` against every training view of `frame`, in the order of the cameras."""
    rng = np.random.default_rng(settings.seed)
    for camera in views.train_cameras:
        yield photometric_loss(params, views.target(camera, frame, scale), settings, rng, views.backend)
