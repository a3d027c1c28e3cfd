"""The native rasterizer with its buffers, shared by `image` and `cpu`. Needs no torch.

A workspace keeps its buffers from call to call. Make one per thread of control and use it for all views.
"""

from __future__ import annotations

import numpy as np

from .. import _native
from ..errors import LimitError, UsageError
from ..model.camera import Camera
from ..model.gaussians import PARAMETERS
from .backend import STATISTICS


def simd_levels() -> list[str]:
    """The instruction sets that this machine can use, fastest first; "scalar" is the plain reference."""
    return list(_native.simd_levels())


class Workspace:
    """A native rasterizer, and the arrays that its gradients are written to.

    Args:
        threads: 0 for all cores. Results do not depend on it.
        simd: "auto" or one of `simd_levels()`.

    Raises:
        UsageError: this machine does not have that instruction set.
    """

    def __init__(self, threads: int = 0, simd: str = "auto"):
        try:
            self.native = _native.Rasterizer(threads, simd)
        except ValueError as e:
            raise UsageError(str(e)) from None
        self._grads: tuple[dict[str, np.ndarray], ...] = ({}, {})

    @property
    def simd(self) -> str:
        return self.native.simd

    @property
    def memory(self) -> int:
        """Bytes of the native buffers."""
        return self.native.memory

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds of the last passes: project, bin, blend, loss, backward_tiles, backward_project."""
        return dict(self.native.timings())

    def forward(self, params, camera: Camera, background, training: bool = False):
        """Renders `params`, the six arrays in the order of PARAMETERS, then TURNS or nothing.

        Returns:
            image [H, W, 3] f32 and alpha [H, W] f32, new arrays.
        """
        image, alpha = call(self.native.forward, params, view(camera), rgb(background), training)
        return image.reshape(camera.height, camera.width, 3), alpha.reshape(camera.height, camera.width)

    def depth(self, params, camera: Camera) -> np.ndarray:
        """[H, W] f32 expected depth of `params` along the optical axis, world units; 0 where nothing is drawn."""
        total, alpha = call(self.native.depth, params, view(camera))
        return (total / np.maximum(alpha, 1e-6)).reshape(camera.height, camera.width)

    def draw(self, params, camera: Camera, background) -> np.ndarray:
        """Renders `params`; returns [H, W, 3] uint8, rounded."""
        flat = call(self.native.draw, params, view(camera), rgb(background))
        return flat.reshape(camera.height, camera.width, 3)

    def gradients(self, params) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Arrays in the shapes of `params`, without TURNS, and two statistics [N]. Two sets alternate from call to call
        while the shapes stay, so that the arrays of the step before can still be read."""
        self._grads = self._grads[::-1]
        grads = self._grads[0]
        n = len(params[0])
        shapes = {name: p.shape for name, p in zip(PARAMETERS, params[: len(PARAMETERS)], strict=True)}
        shapes |= {name: (n,) for name in STATISTICS}
        for name, shape in shapes.items():
            if name not in grads or grads[name].shape != shape:
                grads[name] = np.zeros(shape, np.float32)
        return tuple(grads[k] for k in PARAMETERS), tuple(grads[k] for k in STATISTICS)


def view(camera: Camera) -> dict:
    """A camera in the form of the native side.

    Raises:
        UsageError: the camera has distortion or skew.
    """
    K, m = np.asarray(camera.K, np.float64), np.asarray(camera.viewmat, np.float64)
    if np.any(np.asarray(camera.distortion)) or K[0, 1] != 0:
        raise UsageError(
            f"camera {camera.name} has lens distortion or skew; undistort the images and render a pinhole camera"
        )
    return {
        "size": [camera.width, camera.height],
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "viewmat": m[:3].tolist(),
        "near": float(camera.near),
        "low_pass": float(camera.low_pass),
    }


def host_array(array) -> np.ndarray:
    """A numpy array, or the memory of a torch CPU tensor as one; torch is not imported."""
    return array.detach().numpy() if hasattr(array, "detach") else array


def rgb(colour) -> list[float]:
    """Three floats from a sequence or a tensor."""
    values = [float(v) for v in colour]
    if len(values) != 3:
        raise UsageError(f"a colour has 3 values, got {len(values)}")
    return values


def call(function, *args):
    """Calls into the native side.

    Raises:
        UsageError: wrong arguments.
        LimitError: too many Gaussians, pixels, or Gaussian-tile pairs.
    """
    try:
        return function(*args)
    except OverflowError as e:
        raise LimitError(f"rasterizer: {e}") from None
    except ValueError as e:
        raise UsageError(f"rasterizer: {e}") from None
