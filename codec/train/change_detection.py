"""Change detection: pixels that changed since they were last fitted, and the Gaussians behind them.

In: the images of a frame. Out: [N] bool, Gaussians that may move or change. The others are frozen while the frame is
fitted, so that a still background costs bits in its keyframe only and does not flicker. For each camera an image holds
every pixel as it was last fitted, so that slow drift adds up until it is detected.
"""

from __future__ import annotations

import numpy as np

from ..capture import blend
from .settings import ChangeDetectionSettings
from .views import GREY, Views
from .visual_hull import project


class Changes:
    """Reference image of each training camera of `views`: each pixel as it was last fitted.

    Args:
        fitted: [h, w, 3] u8 of each training camera, small images over mid-grey.
    """

    def __init__(self, views: Views, fitted: list[np.ndarray], settings: ChangeDetectionSettings):
        self.views, self.fitted, self.settings = views, fitted, settings

    @staticmethod
    def since(views: Views, frame: int, settings: ChangeDetectionSettings) -> Changes:
        """Reference images that are those of `frame`."""
        changes = Changes(views, [], settings)
        changes.fitted = [changes._image(i, frame) for i in views.train_cameras]
        return changes

    def copy(self) -> Changes:
        """A copy, to detect changes in later frames that do not yet count as fitted."""
        return Changes(self.views, [image.copy() for image in self.fitted], self.settings)

    def _image(self, camera: int, frame: int) -> np.ndarray:
        """Small image of a camera over mid-grey, [h, w, 3] u8."""
        import cv2

        rgb = blend(self.views.view(camera, frame), GREY)
        height, width = rgb.shape[:2]
        scale = min(1.0, self.settings.width / width)
        size = (max(1, round(scale * width)), max(1, round(scale * height)))
        return np.rint(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)

    def advance(self, frame: int) -> list[np.ndarray]:
        """Changed pixels of `frame` and a margin around them, [h, w] bool of each training camera. They count as fitted
        from now on."""
        import cv2

        masks = []
        for camera, fitted in zip(self.views.train_cameras, self.fitted, strict=True):
            now = self._image(camera, frame)
            difference = cv2.blur(now.astype(np.float32) - fitted, (3, 3))
            changed = np.maximum.reduce(cv2.split(np.abs(difference))) > self.settings.threshold
            fitted[changed] = now[changed]
            masks.append(self._dilated(changed))
        return masks

    def outside(self, frame: int, means: np.ndarray) -> np.ndarray:
        """Gaussians outside of the subject at `frame`, [N] bool: most cameras have them outside of their masks, or no
        camera has them in its image. None is outside in a capture without masks.

        Args:
            means: [N, 3] world units.
        """
        import cv2

        masks = []
        for camera, fitted in zip(self.views.train_cameras, self.fitted, strict=True):
            alpha = self.views.view(camera, frame).alpha
            if alpha is None:
                return np.zeros(len(means), bool)
            masks.append(self._dilated(cv2.resize(alpha, fitted.shape[1::-1], interpolation=cv2.INTER_AREA) > 0))
        return ~self.behind(frame, masks, means)

    def behind(
        self, frame: int, masks: list[np.ndarray], means: np.ndarray, visible: list[np.ndarray] | None = None
    ) -> np.ndarray:
        """Gaussians behind the pixels of `masks`, [N] bool: a large enough share of the cameras that see a Gaussian
        (`seen_share`) see it there, and it is not too far away to have changed (`far`).

        Args:
            masks: [h, w] bool of each training camera, from `advance`.
            means: [N, 3] world units.
            visible: [N] bool of each training camera, Gaussians that the camera sees; None: all.
        """
        visible = visible or [np.ones(len(means), bool)] * len(masks)
        seen, hit = np.zeros(len(means), np.int32), np.zeros(len(means), np.int32)
        for camera, mask, sees in zip(self.views.train_cameras, masks, visible, strict=True):
            height, width = mask.shape
            p, depth = project(self.views.camera(camera, frame).resized(width, height), means)
            x, y = np.floor(p).astype(np.int64).T
            on = np.flatnonzero(sees & (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height))
            seen[on] += 1
            hit[on] += mask[y[on], x[on]]
        return ~self.far(means) & (hit > 0) & (hit >= self.settings.seen_share * seen)

    def within(self, frame: int, points: np.ndarray) -> np.ndarray:
        """[P] bool: `points` [P, 3] in the picture of a training camera at `frame`, and not too far away (`far`)."""
        return self.behind(frame, [np.ones(image.shape[:2], bool) for image in self.fitted], points)

    def far(self, means: np.ndarray) -> np.ndarray:
        """[N] bool: `means` [N, 3] that are too far away to measure their motion (`ChangeDetectionSettings.far`)."""
        return self.views.distance(means) > self.settings.far * self.views.working_distance

    def _dilated(self, mask: np.ndarray) -> np.ndarray:
        """`mask` [h, w] bool with a margin around it."""
        import cv2

        size = 2 * round(self.settings.margin * mask.shape[1]) + 1
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        return cv2.dilate(mask.astype(np.uint8), near) > 0
