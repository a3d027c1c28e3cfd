"""Calibration of the training cameras: colour and pose of each, learned with a keyframe and kept while it is tracked.
Fine-tuning learns the colour anew for each frame, where a keyframe's no longer holds.

The mean over the cameras stays 0, since the brightness and the place of the scene cannot be told from that of all
cameras together. Colour is learned from the first step on (as in Dynamic 3D Gaussians), so that Gaussians never take up
what differs between cameras. Poses are learned late, since with missing shapes errors look like a wrong pose, and only
where matched features say that they are off.
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
    """A few values of each camera, learned with Adam; 0 is what the capture says.

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
            name: of `values`.
            grad: [K], gradient of the loss.
            decay: multiplies the learning rate.
        """
        name = f"{name} {camera}"
        self._adam.step({name: values[camera]}, {name: grad}, {name: self._rate * decay})
        values[self._trained] -= values[self._trained].mean(0)


class Exposure(_Learned):
    """Colour of each training camera: gains and offsets of the channels of its rendered images, and of no others.

    Values: log gains, then offsets in units of `offset_unit`: few cameras differ in their black. They are those of the
    keyframe, then those of the last frame of a group, and hold for frames that have none of their own.
    """

    def __init__(self, count: int, trained: list[int], settings: TrainSettings, backend: Backend):
        c = settings.calibration
        super().__init__(count, 6, trained, Adam(backend, settings.adam), rate=c.exposure_rate)
        self._weight, self._unit = c.exposure_weight, np.float32(c.offset_unit)
        self._frame_weight, self._frame_free = c.frame_weight, np.float32(c.frame_free)

    def reset(self) -> None:
        """As of `_Learned`, in all frames."""
        super().reset()
        self._of_frame: dict[int, np.ndarray] = {}

    def of(self, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """[3] f32 gain and [3] f32 offset of camera `camera` at `frame`."""
        values = self._of_frame.get(frame, self.values)[camera]
        return np.exp(values[:3]), self._unit * values[3:]

    def applied_to(self, g: Gaussians, camera: int, frame: int) -> Gaussians:
        """The Gaussians in the colours that `camera` has at `frame`."""
        (gain, offset), grey = self.of(camera, frame), 0.5 / SH_C0
        return replace(g, sh0=gain * (g.sh0 + grey) - grey + offset / SH_C0, shN=gain * g.shN)

    def learn(self, camera: int, grad: np.ndarray, decay: float) -> None:
        """One step for one camera and the keyframe.

        Args:
            grad: [2, 3], gradients of the loss by the gain and the offset.
            decay: multiplies the learning rate.
        """
        values = self.values
        own = self._by_values(values[camera], grad)
        self._step(values, "keyframe", camera, own + self._weight * values[camera], decay)

    def learn_in(self, frame: int, camera: int, grad: np.ndarray, decay: float) -> None:
        """The same for one frame of a group, which is held near what was before the group."""
        values = self._of_frame.setdefault(frame, self.values.copy())
        own = self._by_values(values[camera], grad)
        away = self._frame_weight * ((values[camera] - self.values[camera]) / self._frame_free).clip(-1, 1)
        self._step(values, str(frame), camera, own + away, decay)

    def go_on(self, frame: int) -> None:
        """Later frames begin as `frame`, the last one of a group."""
        self.values = self._of_frame.get(frame, self.values).copy()

    def _by_values(self, values: np.ndarray, grad: np.ndarray) -> np.ndarray:
        """[6], the gradient by the values of a camera."""
        gain, offset = grad
        return np.concatenate([gain * np.exp(values[:3]), offset * self._unit])


class Extrinsics(_Learned):
    """Correction of each camera's pose, as a small rigid motion of the scene before it.

    Values: rotation vector about the center of the subject in radians, then translation in radii of the subject.

    Attributes:
        learns: whether the calibration is off and `learn` does anything.
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
        """[4, 4] f64, the motion that camera `index` sees."""
        from scipy.spatial.transform import Rotation

        R, t = Rotation.from_rotvec(self.values[index, :3]).as_matrix(), self.radius * self.values[index, 3:]
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = R, self.center + t - R @ self.center
        return moved

    def learn(self, camera: int, params: dict, grads: dict, decay: float) -> None:
        """One step for one camera, from the gradients by the Gaussians `params`: the motion moves all, to first order.

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
