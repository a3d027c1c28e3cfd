"""Device interface: all operations that training, camera calibration and sensitivity measurement need from a device.

`cpu.CpuBackend` is the only implementation. A caller makes one backend, passes it along and uses it from one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..model.camera import Camera

STATISTICS = ("grad2d", "max_weight")

TURNS = "turns"  # rotations [N, 4] wxyz of shN
Params = Mapping[str, np.ndarray]  # PARAMETERS -> numpy arrays or torch CPU tensors, f32, contiguous; optionally TURNS
PixelGradient = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
PendingLoss = Callable[[], "RenderLoss"]


@dataclass(frozen=True)
class TargetView:
    """A view and its target image.

    Attributes:
        camera: pinhole camera.
        target_rgb: [H, W, 3] u8, unassociated colour.
        target_alpha: [H, W] u8; the target is composited on `background` with it. None: opaque, and no mask term.
        background: 3 floats in [0, 1]; a random one in each step if there are masks.
        exposure: gain and offset of this camera, 3 floats each, for the Gaussians and not for the background.
        target_depth: [H, W] f32, world units along the optical axis, 0 where it is unknown. None: no depth term.
    """

    camera: Camera
    target_rgb: np.ndarray
    target_alpha: np.ndarray | None = None
    background: Sequence[float] = (0.0, 0.0, 0.0)
    exposure: tuple[Sequence[float], Sequence[float]] | None = None
    target_depth: np.ndarray | None = None


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss.

    Attributes:
        ssim: share of D-SSIM in the image loss.
        mask, depth: weights of the terms that are added to it.
    """

    ssim: float = 0.2
    mask: float = 0.0
    depth: float = 0.0


@dataclass(frozen=True)
class RenderLoss:
    """Loss of a batch of views and its gradients. Arrays belong to the backend; its next call overwrites them.

    Attributes:
        loss: image_loss plus the terms of mask and depth with their `LossWeights`, summed over the views.
        image_loss: (1 - w) * l1 + w * (1 - ssim) with w = `LossWeights.ssim`, summed over the views.
        l1, mse, ssim, mask, depth: the terms; means over pixels (and channels) and views. psnr = -10 log10(mse). The
            depth term is |sum of weights * (depth - target)| / target, 0 where the target is unknown.
        pixels: number in all views together.
        grads: by parameter name, in the shapes of the parameters; tensors where the parameter was a tensor.
        grad2d: [N] f32, norm of the gradient by the projected mean in units of half the image (the densification
            measure of 3D Gaussian Splatting), summed over the views.
        max_weight: [N] f32, largest blending weight alpha * transmittance.
        radii: [N] f32, pixels, largest over the views; 0 for a Gaussian that is not visible.
        grad_exposure: [views, 2, 3] f64, gradient by the gain and the offset of each view.
    """

    loss: float
    image_loss: float
    l1: float
    mse: float
    ssim: float
    mask: float
    depth: float
    pixels: int
    grads: dict
    grad2d: np.ndarray
    max_weight: np.ndarray
    radii: np.ndarray
    grad_exposure: np.ndarray


class Backend(Protocol):
    """Rendering with gradients, and the optimiser step. All methods raise UsageError where shapes disagree or a camera
    has distortion, and LimitError where there are too many Gaussians or pixels."""

    def render(self, params: Params, camera: Camera, background: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Image [H, W, 3] f32 over `background` and alpha [H, W] f32."""

    def render_depth(self, params: Params, camera: Camera) -> np.ndarray:
        """[H, W] f32 expected depth along the optical axis, world units, with the weights of blending; 0 where nothing
        is drawn."""

    def photometric_loss(self, params: Params, views: Sequence[TargetView], weights: LossWeights) -> RenderLoss:
        """Loss of Gaussians against the targets of `views`, and its gradients."""

    def photometric_loss_value(self, params: Params, views: Sequence[TargetView], weights: LossWeights) -> float:
        """`RenderLoss.loss` of `photometric_loss`, without gradients."""

    def start_photometric_loss(self, params: Params, views: Sequence[TargetView], weights: LossWeights) -> PendingLoss:
        """Starts `photometric_loss` of the current Gaussians, in parallel to the caller.

        Returns:
            A function that waits for the result, which stays valid until the second start after this one.
        """

    def backpropagate(
        self, params: Params, camera: Camera, background: Sequence[float], pixel_gradient: PixelGradient
    ) -> dict[str, np.ndarray]:
        """Gradients by the parameters for a gradient by the pixels.

        Args:
            pixel_gradient: image [H, W, 3] and alpha [H, W] as rendered -> the gradients by them, f32, same shapes.

        Returns:
            PARAMETERS -> f32 in the shapes of the parameters; arrays of the backend, overwritten by its next call.
        """

    def adam(
        self,
        arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        *,
        rate: float,
        betas: tuple[float, float],
        eps: float,
        step: int,
    ) -> None:
        """One step of Adam in place.

        Args:
            arrays: parameter, gradient, first and second moment; f32, contiguous, one shape.
            step: number of this step of the parameter, from 1.
        """

    def trajectory_sum(self, coefficients: np.ndarray, at: np.ndarray, dead_zone: float) -> np.ndarray:
        """Sum over k of at[k] * rounded(coefficients[k]), [N, C] f32, as in a decoder.

        Args:
            coefficients: [K, N, C] f32, in quantization steps.
            at: [K] factors of the coefficients.
            dead_zone: steps beyond half a step, below which a coefficient is 0.
        """

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
        """One step of Adam on coefficients, in place. The gradient has two parts: by their sum at a frame, straight
        through the rounding; and by their bits: Laplace code lengths with uniform noise in place of rounding.

        Args:
            arrays: f32 coefficients [K, N, C], gradient [N, C] by the sum, first moment [K, N, C], and second moment
                [N, C], shared by the K coefficients.
            at: [K], as in `trajectory_sum`.
            price: loss of one bit, Laplace scales [K], and at least N * C + K - 1 uniform values in -0.5 .. 0.5.
            step: number of this step of the coefficients, from 1.

        Returns:
            [K, 2] f64: bits of each coefficient and their derivative by the log of its scale; 0 without a price.
        """
