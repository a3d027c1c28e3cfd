"""The backend of the CPU: the native rasterizer, its fused training step, and the native Adam.

One native call renders, compares and differentiates, so that nothing of the size of an image goes through torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from .. import _native
from ..errors import UsageError
from ..model.camera import Camera
from ..model.gaussians import PARAMETERS
from .backend import STATISTICS, TURNS, LossWeights, Params, PendingLoss, PixelGradient, RenderLoss, TargetView
from .workspace import Workspace, call, host_array, rgb, view

IMAGE_ALONE = LossWeights()


class CpuBackend:
    """Implements `Backend`.

    Args:
        threads: 0 for all cores. Results do not depend on it.
        simd: "auto" or one of `workspace.simd_levels()`.

    Raises:
        UsageError: this machine does not have that instruction set.
    """

    def __init__(self, threads: int = 0, simd: str = "auto"):
        self.workspace = Workspace(threads, simd)
        self._worker = ThreadPoolExecutor(1, "render")

    def render(self, params: Params, camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """See `Backend`."""
        return self.workspace.forward(_arrays(params), camera, background)

    def render_depth(self, params: Params, camera: Camera) -> np.ndarray:
        """See `Backend`."""
        return self.workspace.depth(_arrays(params), camera)

    def photometric_loss(
        self, params: Params, views: Sequence[TargetView], weights: LossWeights = IMAGE_ALONE
    ) -> RenderLoss:
        """See `Backend`.

        Raises:
            UsageError: shapes disagree, a camera has distortion, or there are no views.
        """
        return self._photometric_loss(params, _arrays(params), views, weights)

    def start_photometric_loss(
        self, params: Params, views: Sequence[TargetView], weights: LossWeights = IMAGE_ALONE
    ) -> PendingLoss:
        """See `Backend`."""
        arrays = tuple(a.copy() for a in _arrays(params))
        return self._worker.submit(self._photometric_loss, params, arrays, views, weights).result

    def photometric_loss_value(
        self, params: Params, views: Sequence[TargetView], weights: LossWeights = IMAGE_ALONE
    ) -> float:
        """See `Backend`. Raises as `photometric_loss`."""
        values, _ = self._step(_arrays(params), views, weights, None)
        return float(np.array([v[0] for v in values]).sum())

    def _photometric_loss(
        self, params: Params, arrays: tuple[np.ndarray, ...], views: Sequence[TargetView], weights: LossWeights
    ) -> RenderLoss:
        """`photometric_loss` of the `arrays`; the gradients have the types (array or tensor) of `params`."""
        grads, statistics = out = self.workspace.gradients(arrays)
        values, radii = self._step(arrays, views, weights, out)
        losses, exposure = np.array([v[:6] for v in values]), np.array([v[6:] for v in values])
        loss, means = float(losses[:, 0].sum()), losses[:, 1:].mean(0).tolist()
        others = float((losses[:, 4:6] @ (weights.mask, weights.depth)).sum())
        return RenderLoss(
            loss,
            loss - others,
            *means,
            pixels=sum(v.camera.width * v.camera.height for v in views),
            grads={k: _like(g, params[k]) for k, g in zip(PARAMETERS, grads, strict=True)},
            radii=radii,
            grad_exposure=exposure,
            **dict(zip(STATISTICS, statistics, strict=True)),
        )

    def _step(
        self, arrays: tuple[np.ndarray, ...], views: Sequence[TargetView], weights: LossWeights, out: tuple | None
    ) -> tuple[list, np.ndarray]:
        """Losses and exposure gradients of each view, and radii [N]; `out`: gradients and statistics to fill."""
        if not views:
            raise UsageError("a batch has at least one view, got none")
        lambdas = (weights.ssim, weights.mask, weights.depth)
        return call(self.workspace.native.step, arrays, [_native_view(v) for v in views], lambdas, out)

    def backpropagate(
        self, params: Params, camera: Camera, background: Sequence[float], pixel_gradient: PixelGradient
    ) -> dict[str, np.ndarray]:
        """See `Backend`."""
        arrays = _arrays(params)
        image, alpha = self.workspace.forward(arrays, camera, background, training=True)
        pixels = tuple(np.ascontiguousarray(g, np.float32) for g in pixel_gradient(image, alpha))
        grads, statistics = self.workspace.gradients(arrays)
        for a in grads + statistics:
            a.fill(0)
        call(self.workspace.native.backward, arrays, *pixels, (grads, statistics))
        return dict(zip(PARAMETERS, grads, strict=True))

    def adam(
        self,
        arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        *,
        rate: float,
        betas: tuple[float, float],
        eps: float,
        step: int,
    ) -> None:
        """See `Backend`."""
        call(_native.adam, arrays, rate, betas, eps, step)

    def trajectory_sum(self, coefficients: np.ndarray, at: np.ndarray, dead_zone: float) -> np.ndarray:
        """See `Backend`."""
        out = np.empty(coefficients.shape[1:], np.float32)
        call(_native.trajectory_sum, coefficients, at.tolist(), dead_zone, out)
        return out

    def trajectory_step(
        self,
        arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        at: np.ndarray,
        price: tuple[float, np.ndarray, np.ndarray] | None,
        *,
        rate: float,
        betas: tuple[float, float],
        eps: float,
        step: int,
    ) -> np.ndarray:
        """See `Backend`."""
        native = None if price is None else (price[0], price[1].tolist(), price[2])
        return np.array(call(_native.trajectory_step, arrays, at.tolist(), native, rate, betas, eps, step))


def _arrays(params: Params) -> tuple[np.ndarray, ...]:
    """The arrays in the order of PARAMETERS, then TURNS if present."""
    names = (*PARAMETERS, TURNS) if TURNS in params else PARAMETERS
    return tuple(np.ascontiguousarray(host_array(params[name]), np.float32) for name in names)


def _native_view(v: TargetView) -> tuple:
    """A view and its target in the form of the native side."""
    target = (v.target_rgb, v.target_alpha, v.target_depth)
    return (
        view(v.camera),
        (rgb(v.background), None if v.exposure is None else tuple(map(rgb, v.exposure))),
        tuple(None if t is None else np.ascontiguousarray(t) for t in target),
    )


def _like(grad: np.ndarray, param):
    """`grad` as a tensor where `param` is one."""
    if not hasattr(param, "detach"):
        return grad
    import torch

    return torch.from_numpy(grad)
