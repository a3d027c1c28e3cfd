"""Differentiable rasterization for torch: the native kernels on the CPU, gsplat on a CUDA device, one interface.

Same constants on both sides (native/raster/src/constants.rs); `reference.py` is the slow plain version.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..model.camera import Camera
from .workspace import Region, Workspace, call, rgb


@dataclass
class RasterInfo:
    """What is known of each Gaussian besides the picture.

    Attributes:
        radii: [N] f32, pixels, 0 for what is not visible.
        depths: [N] f32, world units along the viewing axis.
        grad2d, max_weight, sum_weight: [N] f32, as in step.RenderLoss; None until backward has run.
    """

    radii: torch.Tensor
    depths: torch.Tensor
    grad2d: torch.Tensor | None = None
    max_weight: torch.Tensor | None = None
    sum_weight: torch.Tensor | None = None


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    logit_opacities: torch.Tensor,
    sh0: torch.Tensor,
    shN: torch.Tensor,
    camera: Camera,
    background=(0.0, 0.0, 0.0),
    *,
    region: Region | None = None,
    workspace: Workspace | None = None,
) -> tuple[torch.Tensor, torch.Tensor, RasterInfo]:
    """Draws Gaussians (3D Gaussian Splatting, Kerbl et al. 2023) with gradients for all six parameters.

    Args:
        means: [N, 3]; quats: [N, 4] wxyz; log_scales: [N, 3]; logit_opacities: [N]; sh0: [N, 3]; shN: [N, K, 3].
        camera: pinhole.
        background: 3 values, no gradient.
        region: (x, y, width, height) of the image to draw; all of it if None.
        workspace: reused buffers (CPU).

    Returns:
        image [H, W, 3] f32, alpha [H, W] f32 and a RasterInfo.

    Raises:
        UsageError: shapes disagree, or the camera has distortion.
    """
    params = (means, quats, log_scales, logit_opacities, sh0, shN)
    if means.device.type == "cuda":
        return _gsplat(params, camera, background, region)
    info = RasterInfo(torch.empty(0), torch.empty(0))
    image, alpha = _Rasterize.apply(camera, rgb(background), region, workspace or Workspace(), info, *params)
    return image, alpha, info


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, background, region, workspace, info, *params):
        arrays = tuple(p.detach().float().contiguous().numpy() for p in params)
        image, alpha = workspace.forward(arrays, camera, background, region, training=True)
        info.radii, info.depths = (torch.from_numpy(a) for a in workspace.native.radii())
        ctx.save_for_backward(*params)
        ctx.picture = (camera, background, region, workspace, info, workspace.calls)
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_image, grad_alpha):
        camera, background, region, workspace, info, drawn = ctx.picture
        params = ctx.saved_tensors
        arrays = tuple(p.detach().float().contiguous().numpy() for p in params)
        if workspace.calls != drawn:  # the workspace has drawn something else since
            workspace.forward(arrays, camera, background, region, training=True)
        grads, statistics = workspace.gradients(arrays)
        pixels = (grad_image.float().contiguous().numpy(), grad_alpha.float().contiguous().numpy())
        call(workspace.native.backward, arrays, *pixels, (grads, statistics))
        info.grad2d, info.max_weight, info.sum_weight = (torch.from_numpy(s.copy()) for s in statistics)
        return (None,) * 5 + tuple(torch.from_numpy(g.copy()).to(p.dtype) for g, p in zip(grads, params, strict=True))


def _gsplat(params, camera: Camera, background, region: Region | None):
    """The same picture from gsplat's CUDA kernels."""
    from gsplat import rasterization

    means, quats, log_scales, logit_opacities, sh0, shN = params
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[shN.shape[1]]
    image, alpha, meta = rasterization(
        means,
        quats,
        log_scales.exp(),
        logit_opacities.sigmoid(),
        torch.cat([sh0[:, None], shN], 1),
        torch.as_tensor(camera.viewmat, dtype=torch.float32, device=means.device)[None],
        torch.as_tensor(camera.K, dtype=torch.float32, device=means.device)[None],
        camera.width,
        camera.height,
        near_plane=0.01,
        eps2d=0.3,
        sh_degree=degree,
        packed=False,
        backgrounds=torch.tensor([rgb(background)], device=means.device),
    )
    x, y, w, h = region or (0, 0, camera.width, camera.height)
    radii = meta["radii"][0].float()
    radii = radii.amax(-1) if radii.ndim == 2 else radii
    return image[0, y : y + h, x : x + w], alpha[0, y : y + h, x : x + w, 0], RasterInfo(radii, meta["depths"][0])
