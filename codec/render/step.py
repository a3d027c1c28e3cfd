"""The image side of one training step in one native call: draw a view, compare, differentiate.

Parameters + camera + 8-bit picture -> loss, gradients and what densification and pruning want to know. Nothing of the
size of an image goes through torch, which is what makes a step cheap on a CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import UsageError
from ..model.camera import Camera
from .workspace import PARAMETERS, STATISTICS, Region, Workspace, call, rgb, view


@dataclass(frozen=True)
class RenderLoss:
    """Result of `render_loss`. Arrays belong to the workspace and are overwritten by its next call.

    Attributes:
        loss: (1 - ssim_lambda) * l1 + ssim_lambda * (1 - ssim) + mask_lambda * mask.
        l1, mse, ssim, mask: the terms; means over pixels (and channels). psnr = -10 log10(mse).
        grads: by parameter name, shapes of the parameters; tensors where the parameter was a tensor.
        grad2d: [N] f32, norm of the gradient by the projected mean in units of half the image (3DGS's densification
            measure).
        max_weight, sum_weight: [N] f32, largest and summed blending weight alpha * transmittance (for pruning).
        pixels: of the image, of all crops together.
        radii: [N] f32, pixels, 0 for what is not visible.
        grad_gain: [3] f64, gradient of `gain`.
    """

    loss: float
    l1: float
    mse: float
    ssim: float
    mask: float
    pixels: int
    grads: dict
    grad2d: np.ndarray
    max_weight: np.ndarray
    sum_weight: np.ndarray
    radii: np.ndarray
    grad_gain: np.ndarray

    @property
    def visible(self) -> np.ndarray:
        """[N] bool"""
        return self.radii > 0


@dataclass(frozen=True)
class Crop:
    """A view, or a part of one, and what it should look like; see `render_loss`."""

    camera: Camera
    target_rgb: np.ndarray
    target_alpha: np.ndarray | None = None
    background: Sequence[float] = (0.0, 0.0, 0.0)
    gain: Sequence[float] | None = None
    weight: np.ndarray | None = None
    region: Region | None = None

    def part(self) -> Region:
        """The region; all of the picture if none is given."""
        return self.region or (0, 0, self.camera.width, self.camera.height)

    def native(self) -> tuple:
        """As the native side takes it."""
        target = (self.target_rgb, self.target_alpha, self.weight)
        return (
            view(self.camera, self.part()),
            (rgb(self.background), None if self.gain is None else rgb(self.gain)),
            tuple(None if t is None else np.ascontiguousarray(t) for t in target),
        )


def render_loss(
    params: dict,
    camera: Camera,
    target_rgb: np.ndarray,
    target_alpha: np.ndarray | None = None,
    background=(0.0, 0.0, 0.0),
    ssim_lambda: float = 0.2,
    mask_lambda: float = 0.0,
    workspace: Workspace | None = None,
    *,
    gain=None,
    weight: np.ndarray | None = None,
    region: Region | None = None,
) -> RenderLoss:
    """Loss of one view and its gradients.

    Args:
        params: PARAMETERS -> numpy or torch CPU arrays, f32, contiguous.
        camera: pinhole camera of the picture.
        target_rgb: [H, W, 3] u8, unassociated colour.
        target_alpha: [H, W] u8; the target is composited on `background` with it. None: opaque, and no mask term.
        background: 3 floats in [0, 1]; draw a random one each step when there are masks.
        ssim_lambda: share of 1 - SSIM in the image loss.
        mask_lambda: weight of mean |alpha - target_alpha|.
        workspace: reused from step to step; a new one if None.
        gain: 3 floats, exposure of this camera, multiplies what the Gaussians send (not the background).
        weight: [H, W] f32, weights of pixels in the image loss (a weighted mean).
        region: (x, y, width, height), the part of the picture to train on; all of it if None.

    Raises:
        UsageError: shapes disagree, or the camera has distortion.
    """
    crop = Crop(camera, target_rgb, target_alpha, background, gain, weight, region)
    result = render_batch(params, [crop], ssim_lambda, mask_lambda, workspace)
    return replace(result, grad_gain=result.grad_gain[0])


def render_batch(
    params: dict,
    crops: Sequence[Crop],
    ssim_lambda: float = 0.2,
    mask_lambda: float = 0.0,
    workspace: Workspace | None = None,
) -> RenderLoss:
    """Loss of several crops, of one view or of many, and its gradients: what `render_loss` gives for each, added up.

    Of the result, loss, grads, grad2d and sum_weight are sums over the crops, max_weight and radii the largest; l1,
    mse, ssim and mask are means, and grad_gain is [crops, 3].

    Raises:
        UsageError: shapes disagree, a camera has distortion, or there are no crops.
    """
    if not crops:
        raise UsageError("a batch has at least one crop, got none")
    workspace = workspace or Workspace()
    arrays = tuple(_numpy(params[name]) for name in PARAMETERS)
    grads, statistics = workspace.gradients(arrays)
    workspace.calls += 1
    native = [crop.native() for crop in crops]
    values, radii = call(workspace.native.step, arrays, native, (ssim_lambda, mask_lambda), (grads, statistics))
    losses, gain = np.array([v[:5] for v in values]), np.array([v[5] for v in values])
    named = {k: _like(g, params[k]) for k, g in zip(PARAMETERS, grads, strict=True)}
    statistics = dict(zip(STATISTICS, statistics, strict=True))
    loss, means = float(losses[:, 0].sum()), losses[:, 1:].mean(0).tolist()
    pixels = sum(crop.part()[2] * crop.part()[3] for crop in crops)
    return RenderLoss(loss, *means, pixels=pixels, grads=named, radii=radii, grad_gain=gain, **statistics)


def _numpy(array) -> np.ndarray:
    """A tensor's memory as numpy, without importing torch."""
    return np.ascontiguousarray(array.detach().numpy() if hasattr(array, "detach") else array, np.float32)


def _like(grad: np.ndarray, param):
    if not hasattr(param, "detach"):
        return grad
    import torch

    return torch.from_numpy(grad)
