"""What the training cameras are told to be and are not: how bright each is, and where it stands.

Both are learned with a keyframe and kept while it is followed. What all cameras share is the scene's own, brightness as
well as place: the mean over the cameras stays 0. Shading looks like exposure as long as colours are not right yet (the
lit side is brighter than they are), and shapes that are not there yet look like motion, so that both are learned late;
cameras that are all right within what that alone makes of them are taken as such.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..model.camera import Camera
from ..model.gaussians import SH_C0, Gaussians
from ..render.backend import Backend
from ..render.optimizer import Adam
from .settings import TrainSettings


class _Learned:
    """A few values of each camera, learned with Adam; 0 where nothing is wrong.

    Args:
        count: cameras of the capture.
        trained: indices of those that are trained on.
        adam: optimiser of the values of each camera.
        rate: learning rate; least: root mean square of the values that are kept by `settle`.

    Attributes:
        values: [C, K] f32.
    """

    def __init__(self, count: int, width: int, trained: list[int], adam: Adam, *, rate: float, least: float):
        self._shape, self._trained, self._rate, self._least = (count, width), trained, rate, least
        self._adam = adam
        self.restart()

    def restart(self) -> None:
        """Nothing is wrong."""
        self.values = np.zeros(self._shape, np.float32)
        self._adam.restart()
        self._settled = False

    def learn(self, camera: int, grad: np.ndarray, fade: float) -> None:
        """One step for one camera; `grad`: [K], of the loss; rate times `fade`."""
        if self._settled:
            return
        name = str(camera)
        self._adam.step({name: self.values[camera]}, {name: grad}, {name: self._rate * fade})
        self.values[self._trained] -= self.values[self._trained].mean(0)

    def settle(self) -> None:
        """Cameras that are hardly wrong are right from now on."""
        if np.sqrt(np.mean(self.values[self._trained] ** 2)) < self._least:
            self.restart()
            self._settled = True


class Exposure(_Learned):
    """Log gains of the channels of each training camera: they multiply its rendered images, and no others."""

    def __init__(self, count: int, trained: list[int], settings: TrainSettings, backend: Backend):
        c = settings.calibration
        super().__init__(count, 3, trained, Adam(backend, settings.adam), rate=c.exposure_rate, least=c.exposure_min)
        self._weight = c.exposure_weight

    def gain(self, camera: int) -> np.ndarray:
        """[3] f32."""
        return np.exp(self.values[camera])

    def seen(self, g: Gaussians, camera: int) -> Gaussians:
        """The Gaussians in the colours that `camera` shows them in."""
        gain, grey = self.gain(camera), 0.5 / SH_C0
        return replace(g, sh0=gain * (g.sh0 + grey) - grey, shN=gain * g.shN)

    def learn(self, camera: int, grad: np.ndarray, fade: float) -> None:
        """As of `_Learned`; `grad`: [3], of the loss by the gains."""
        super().learn(camera, grad * self.gain(camera) + self._weight * self.values[camera], fade)


class Extrinsics(_Learned):
    """By which small rigid motion of the scene each camera sees what the others see: a rotation vector in radians
    about the middle of the subject, then a translation in its radii.
    """

    def __init__(self, count: int, trained: list[int], settings: TrainSettings, backend: Backend):
        c = settings.calibration
        super().__init__(count, 6, trained, Adam(backend, settings.adam), rate=c.pose_rate, least=c.pose_min)
        self.about(np.zeros(3), 1.0)

    def about(self, middle: np.ndarray, radius: float) -> None:
        """Sets the middle ([3]) and the radius of the subject, world units."""
        self.middle, self.radius = middle, radius

    def camera(self, index: int, camera: Camera) -> Camera:
        """`camera` (the view of the capture's camera `index`, or a crop of it) where it really stands."""
        if not self.values[index].any():
            return camera
        return replace(camera, viewmat=camera.viewmat @ self.correction(index))

    def correction(self, index: int) -> np.ndarray:
        """[4, 4] f64, the motion that camera `index` sees."""
        from scipy.spatial.transform import Rotation

        R, t = Rotation.from_rotvec(self.values[index, :3]).as_matrix(), self.radius * self.values[index, 3:]
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = R, self.middle + t - R @ self.middle
        return moved

    def learn(self, camera: int, params: dict, grads: dict, fade: float) -> None:
        """As of `_Learned`, from the loss's gradients by the Gaussians: to first order the motion moves them all."""
        if self._settled:
            return
        means, quats, by_means, by_quats = (x[n].numpy() for x in (params, grads) for n in ("means", "quats"))
        torque = np.cross(means - self.middle, by_means).sum(0)
        w, u = quats[:, :1], quats[:, 1:]  # half of (0, e) times (w, u) is (-e.u, w e + e x u) / 2
        torque += 0.5 * (w * by_quats[:, 1:] - by_quats[:, :1] * u + np.cross(u, by_quats[:, 1:])).sum(0)
        super().learn(camera, np.concatenate([torque, self.radius * by_means.sum(0)]), fade)
