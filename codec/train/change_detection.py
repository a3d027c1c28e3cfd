"""What moves: pixels that have changed since the Gaussians last looked at them, and the Gaussians behind these.

In: the pictures of a frame. Out: [N] bool, Gaussians that may have to move or change. The others are frozen while the
frame is fitted, so that a still background costs its keyframe and nothing more, and does not flicker. Each camera keeps
a picture of what was fitted last, pixel by pixel: a slow drift adds up until it is seen.
"""

from __future__ import annotations

import numpy as np

from ..capture import blend
from .settings import ChangeDetectionSettings
from .views import GREY
from .visual_hull import project


class Changes:
    """Follows the pictures of the training cameras of `views`.

    Args:
        fitted: [h, w, 3] u8 of each training camera: what the Gaussians show.
    """

    def __init__(self, views, fitted: list[np.ndarray], settings: ChangeDetectionSettings):
        self.views, self.fitted, self.settings = views, fitted, settings

    @staticmethod
    def since(views, frame: int, settings: ChangeDetectionSettings) -> Changes:
        """Everything is fitted to `frame`."""
        changes = Changes(views, [], settings)
        changes.fitted = [changes._picture(i, frame) for i in views.train_cameras]
        return changes

    def copy(self) -> Changes:
        """The same, to look ahead with."""
        return Changes(self.views, [picture.copy() for picture in self.fitted], self.settings)

    def _picture(self, camera: int, frame: int) -> np.ndarray:
        """[h, w, 3] u8, small, over mid-grey."""
        import cv2

        rgb = blend(self.views.view(camera, frame), GREY)
        height, width = rgb.shape[:2]
        scale = min(1.0, self.settings.width / width)
        size = (max(1, round(scale * width)), max(1, round(scale * height)))
        return np.rint(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)

    def advance(self, frame: int) -> list[np.ndarray]:
        """[h, w] bool of each training camera: what `frame` shows otherwise than the fitted pictures, and what is near
        it. The changes count as fitted from now on."""
        import cv2

        masks = []
        for camera, fitted in zip(self.views.train_cameras, self.fitted, strict=True):
            now = self._picture(camera, frame)
            difference = cv2.blur(now.astype(np.float32) - fitted, (3, 3))
            changed = np.abs(difference).max(2) > self.settings.threshold
            fitted[changed] = now[changed]
            masks.append(self._grown(changed))
        return masks

    def outside(self, frame: int, means: np.ndarray) -> np.ndarray:
        """[N] bool: Gaussians at `means` ([N, 3]) that most cameras that have them in the picture have outside of the
        masks of `frame`, where there are masks: whatever may hide them, there is nothing. No picture: outside, too."""
        import cv2

        masks = []
        for camera, fitted in zip(self.views.train_cameras, self.fitted, strict=True):
            alpha = self.views.view(camera, frame).alpha
            if alpha is None:
                return np.zeros(len(means), bool)
            masks.append(self._grown(cv2.resize(alpha, fitted.shape[1::-1], interpolation=cv2.INTER_AREA) > 0))
        return ~self.behind(frame, masks, means, [np.ones(len(means), bool)] * len(masks))

    def behind(self, frame: int, masks: list[np.ndarray], means: np.ndarray, visible: list[np.ndarray]) -> np.ndarray:
        """[N] bool: Gaussians at `means` ([N, 3]) that enough of the cameras that see them have in changed pixels.

        Args:
            masks: of `advance` to `frame`; visible: [N] bool of each training camera.
        """
        seen, hit = np.zeros(len(means), np.int32), np.zeros(len(means), np.int32)
        for camera, mask, clear in zip(self.views.train_cameras, masks, visible, strict=True):
            height, width = mask.shape
            p, depth = project(self.views.camera(camera, frame).resized(width, height), means)
            x, y = np.floor(p).astype(np.int64).T
            on = np.flatnonzero(clear & (depth > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height))
            seen[on] += 1
            hit[on] += mask[y[on], x[on]]
        return (hit > 0) & (hit >= self.settings.seen_share * seen)

    def _grown(self, mask: np.ndarray) -> np.ndarray:
        """[h, w] bool and what is near it."""
        import cv2

        size = 2 * round(self.settings.margin * mask.shape[1]) + 1
        near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        return cv2.dilate(mask.astype(np.uint8), near) > 0
