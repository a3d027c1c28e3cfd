"""Calibration of the training cameras: colour and pose of each, learned with a keyframe and kept while it is tracked.
Fine-tuning learns the colour again for each frame, since the colour of the keyframe may not hold there.

The mean over the cameras stays 0: a change that all cameras share cannot be told from a change of the scene's
brightness or place. Colour is learned from the first step on (as in Dynamic 3D Gaussians), so that Gaussians never
learn the differences between cameras. Poses are learned late, because missing shapes look like pose errors, and only
where matched features show that the poses are wrong.
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
    """A few values of each camera, learned with Adam; 0 is the calibration of the capture.

    Args:
        count: cameras of the capture.
        width: values of each camera.
        trained: indices of the training cameras.
        adam: optimiser of the values.
        rate: learning rate.

    Attributes:
        values: [C, K] f32.
    """

    def __init__(self, count: int, width: int, trained: list[int], adam: Adam, *, rate: float):
        self._shape, self._trained, self._rate, self._adam = (count, width), trained, rate, adam
        self.reset()

    def reset(self) -> None:
        """Sets all values to 0."""
        self.values = np.zeros(self._shape, np.float32)
        self._adam.restart()

    def _step(self, values: np.ndarray, name: str, camera: int, grad: np.ndarray, decay: float) -> None:
        """One step of `values` ([C, K]) for one camera.

        Args:
            name: of `values` in the optimiser.
            grad: [K], gradient of the loss.
            decay: multiplies the learning rate.
        """
        name = f"{name} {camera}"
        self._adam.step({name: values[camera]}, {name: grad}, {name: self._rate * decay})
        values[self._trained] -= values[self._trained].mean(0)


class Exposure(_Learned):
    """Exposure of each training camera: gain and offset of each channel, applied only to images rendered for this
    camera.

    Values: log gains, then offsets in units of `offset_unit`, since few cameras differ in their black level. `values`
    are those of the keyframe, later those of the last frame of a group; frames without own values use them.
    """

    def __init__(self, count: int, trained: list[int], settings: TrainSettings, backend: Backend):
        c = settings.calibration
        super().__init__(count, 6, trained, Adam(backend, settings.adam), rate=c.exposure_rate)
        self._weight, self._unit = c.exposure_weight, np.float32(c.offset_unit)
        self._frame_weight, self._frame_free = c.frame_weight, np.float32(c.frame_free)

    def reset(self) -> None:
        """Sets all values to 0, in all frames."""
        super().reset()
        self._of_frame: dict[int, np.ndarray] = {}

    def of(self, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """[3] f32 gain and [3] f32 offset of camera `camera` at `frame`."""
        values = self._of_frame.get(frame, self.values)[camera]
        return np.exp(values[:3]), self._unit * values[3:]

    def applied_to(self, g: Gaussians, camera: int, frame: int) -> Gaussians:
        """The Gaussians with the exposure of `camera` at `frame` in their colours."""
        (gain, offset), grey = self.of(camera, frame), 0.5 / SH_C0
        return replace(g, sh0=gain * (g.sh0 + grey) - grey + offset / SH_C0, shN=gain * g.shN)

    def learn(self, camera: int, grad: np.ndarray, decay: float) -> None:
        """One step of the keyframe's values for one camera.

        Args:
            grad: [2, 3], gradients of the loss by the gain and the offset.
            decay: multiplies the learning rate.
        """
        values = self.values
        own = self._by_values(values[camera], grad)
        self._step(values, "keyframe", camera, own + self._weight * values[camera], decay)

    def learn_in(self, frame: int, camera: int, grad: np.ndarray, decay: float) -> None:
        """One step of one frame's values for one camera; a Huber term holds them near the values before the group."""
        values = self._of_frame.setdefault(frame, self.values.copy())
        own = self._by_values(values[camera], grad)
        away = self._frame_weight * ((values[camera] - self.values[camera]) / self._frame_free).clip(-1, 1)
        self._step(values, str(frame), camera, own + away, decay)

    def go_on(self, frame: int) -> None:
        """Later frames start from the values of `frame`, the last one of a group."""
        self.values = self._of_frame.get(frame, self.values).copy()

    def _by_values(self, values: np.ndarray, grad: np.ndarray) -> np.ndarray:
        """[6], gradient of the loss by the values of a camera."""
        gain, offset = grad
        return np.concatenate([gain * np.exp(values[:3]), offset * self._unit])


class Extrinsics(_Learned):
    """Correction of each camera's pose: a small rigid motion of the scene, applied before the view matrix.

    Values: rotation vector about the center of the subject in radians, then translation in radii of the subject.

    Attributes:
        learns: whether poses are refined; if not, `learn` does nothing.
    """

    def __init__(self, count: int, trained: list[int], settings: TrainSettings, backend: Backend):
        c = settings.calibration
        super().__init__(count, 6, trained, Adam(backend, settings.adam), rate=c.pose_rate)
        self.set_subject(np.zeros(3), 1.0)
        self.learns = False

    def set_subject(self, center: np.ndarray, radius: float) -> None:
        """Sets the center ([3]) and the radius of the subject, world units."""
        self.center, self.radius = center, radius

    def camera(self, index: int, camera: Camera) -> Camera:
        """`camera` (camera `index` of the capture, or a crop of it) in its corrected pose."""
        if not self.values[index].any():
            return camera
        return replace(camera, viewmat=camera.viewmat @ self.correction(index))

    def correction(self, index: int) -> np.ndarray:
        """[4, 4] f64, the rigid motion of the scene for camera `index`."""
        from scipy.spatial.transform import Rotation

        R, t = Rotation.from_rotvec(self.values[index, :3]).as_matrix(), self.radius * self.values[index, 3:]
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = R, self.center + t - R @ self.center
        return moved

    def learn(self, camera: int, params: dict, grads: dict, decay: float) -> None:
        """One step for one camera, from the gradients by the Gaussians `params`, all of which move, to first order.

        Args:
            decay: multiplies the learning rate.
        """
        if not self.learns:
            return
        means, quats, by_means, by_quats = (x[n].numpy() for x in (params, grads) for n in ("means", "quats"))
        torque = np.cross(means - self.center, by_means).sum(0)
        w, u = quats[:, :1], quats[:, 1:]  # half of (0, e) times (w, u) is (-e.u, w e + e x u) / 2
        torque += 0.5 * (w * by_quats[:, 1:] - by_quats[:, :1] * u + np.cross(u, by_quats[:, 1:])).sum(0)
        self._step(self.values, "pose", camera, np.concatenate([torque, self.radius * by_means.sum(0)]), decay)
