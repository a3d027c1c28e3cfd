"""Image loss of training, (1 - lambda) L1 + lambda (1 - SSIM): native forward and backward, and the plain reference.

SSIM (Wang et al. 2004) as 3D Gaussian Splatting uses it: 11 x 11 Gaussian window of sigma 1.5, zeros outside.
"""

from __future__ import annotations

import torch

from .. import _native
from ..errors import UsageError


def image_loss(
    image: torch.Tensor, target: torch.Tensor, ssim_lambda: float = 0.2, weight: torch.Tensor | None = None
) -> torch.Tensor:
    """Scalar loss with a gradient for `image`.

    Args:
        image, target: [H, W, 3] f32 in [0, 1].
        ssim_lambda: share of 1 - SSIM.
        weight: [H, W] f32; the mean over pixels becomes a weighted mean.

    Raises:
        UsageError: shapes disagree.
    """
    return _ImageLoss.apply(image, target, float(ssim_lambda), weight)


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, ssim_lambda, weight):
        if image.ndim != 3 or image.shape[2] != 3:
            raise UsageError(f"image has shape {tuple(image.shape)}, expected [H, W, 3]")
        arrays = [None if t is None else t.detach().float().contiguous().numpy() for t in (image, target, weight)]
        try:
            loss, *_, grad = _native.image_loss(*arrays, ssim_lambda)
        except ValueError as e:
            raise UsageError(f"image loss: {e}") from None
        ctx.save_for_backward(torch.from_numpy(grad).reshape(image.shape))
        return image.new_tensor(loss)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_loss):
        (grad,) = ctx.saved_tensors
        return grad * grad_loss, None, None, None


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """[H, W, 3] each -> [H, W, 3] SSIM of each pixel and channel; plain torch, any float dtype."""
    d = torch.arange(-5, 6, dtype=image.dtype)
    window = torch.exp(-d * d / (2 * 1.5**2))
    window = window / window.sum()

    def blur(x):  # [3, 1, H, W]
        x = torch.nn.functional.conv2d(x, window.view(1, 1, -1, 1), padding=(5, 0))
        return torch.nn.functional.conv2d(x, window.view(1, 1, 1, -1), padding=(0, 5))

    x, y = (t.permute(2, 0, 1)[:, None] for t in (image, target))
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    s = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return s[:, 0].permute(1, 2, 0)


def image_loss_reference(image, target, ssim_lambda=0.2, weight=None) -> torch.Tensor:
    """`image_loss` in plain torch."""
    value = (1 - ssim_lambda) * (image - target).abs() + ssim_lambda * (1 - ssim_map(image, target))
    if weight is None:
        return value.mean()
    return (value * weight[..., None]).sum() / (3 * weight.sum())
