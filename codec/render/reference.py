"""The rasterizer and the image loss as plain torch, for tests: the native kernels are compared with them, forward and
backward.

Written from the definition: every pixel visits every Gaussian in depth order, with full matrices, and culls only the
Gaussians that the definition culls. The precision is that of the inputs.
"""

from __future__ import annotations

import torch

from ..model.camera import Camera

# The normative constants; the same as in native/raster/src/constants.rs.
FOV_MARGIN = 0.3  # of half the field of view
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_STOP = 1e-4


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """[N, 4] wxyz of any length -> [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(r, 1) for r in rows], 1)


def sh_basis(d: torch.Tensor, k: int) -> torch.Tensor:
    """[N, 3] unit directions -> [N, k] real spherical harmonics above Y_00, in 3DGS's order and signs."""
    x, y, z = d.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    terms = [-0.4886025119 * y, 0.4886025119 * z, -0.4886025119 * x]
    terms += [1.0925484306 * x * y, -1.0925484306 * y * z, 0.3153915653 * (2 * zz - xx - yy)]
    terms += [-1.0925484306 * x * z, 0.5462742153 * (xx - yy)]
    terms += [-0.5900435899 * y * (3 * xx - yy), 2.8906114426 * x * y * z, -0.4570457995 * y * (4 * zz - xx - yy)]
    terms += [0.3731763326 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570457995 * x * (4 * zz - xx - yy)]
    terms += [1.4453057213 * z * (xx - yy), -0.5900435899 * x * (xx - 3 * yy)]
    return torch.stack(terms[:k], 1) if k else d.new_zeros(len(d), 0)


def project(means, quats, log_scales, camera: Camera):
    """Means and inverse covariances on the image, and depths: [N, 2], [N, 2, 2], [N]."""
    K, viewmat = (torch.as_tensor(m, dtype=means.dtype) for m in (camera.K, camera.viewmat))
    R = viewmat[:3, :3]
    p = means @ R.T + viewmat[:3, 3]  # [N, 3]
    z = p[:, 2]
    focal, center = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    size = torch.tensor([camera.width, camera.height], dtype=means.dtype)
    margin = FOV_MARGIN * 0.5 * size / focal
    slope = p[:, :2] / z[:, None]
    slope = torch.maximum(torch.minimum(slope, (size - center) / focal + margin), -center / focal - margin)
    J = means.new_zeros(len(means), 2, 3)
    J[:, 0, 0], J[:, 1, 1] = focal[0] / z, focal[1] / z
    J[:, :, 2] = -focal * slope / z[:, None]
    M = rotation_matrices(quats) * log_scales.exp()[:, None]
    T = J @ R @ M
    cov = T @ T.transpose(1, 2) + camera.low_pass * torch.eye(2, dtype=means.dtype)
    return p[:, :2] / z[:, None] * focal + center, torch.linalg.inv(cov), z


def rasterize_reference(
    means, quats, log_scales, logit_opacities, sh0, shN, camera: Camera, background=(0.0, 0.0, 0.0)
):
    """Draws Gaussians (3D Gaussian Splatting, Kerbl et al. 2023), any float dtype.

    Returns:
        image [H, W, 3], alpha [H, W], weights [N] (summed blending weight).
    """
    mean2d, conic, depth = project(means, quats, log_scales, camera)
    eye = torch.as_tensor(camera.center, dtype=means.dtype)
    direction = torch.nn.functional.normalize(means - eye, dim=1)
    colour = 0.5 + 0.28209479177387814 * sh0 + (sh_basis(direction, shN.shape[1])[:, :, None] * shN).sum(1)
    colour = colour.clamp_min(0)
    y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([x, y], -1).to(means.dtype) + 0.5  # [H, W, 2]
    T = means.new_ones(camera.height, camera.width)
    open_ = torch.ones_like(T, dtype=torch.bool)
    image = means.new_zeros(camera.height, camera.width, 3)
    weights = means.new_zeros(len(means))
    for i in torch.argsort(depth, stable=True).tolist():
        if depth[i] < camera.near:
            continue
        d = pixels - mean2d[i]
        power = 0.5 * torch.einsum("hwi,ij,hwj->hw", d, conic[i], d)
        alpha = (torch.sigmoid(logit_opacities[i]) * torch.exp(-power)).clamp_max(ALPHA_MAX)
        hit = alpha >= ALPHA_MIN
        after = T * (1 - alpha)
        draw = open_ & hit & (after >= TRANSMITTANCE_STOP)
        open_ = open_ & ~(hit & (after < TRANSMITTANCE_STOP))
        w = torch.where(draw, alpha * T, 0)
        image = image + w[..., None] * colour[i]
        weights = weights + torch.nn.functional.one_hot(torch.tensor(i), len(means)) * w.detach().sum()
        T = torch.where(draw, after, T)
    return image + T[..., None] * torch.as_tensor(background, dtype=means.dtype), 1 - T, weights


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """[H, W, 3] each -> [H, W, 3] SSIM of each pixel and channel (Wang et al. 2004), any float dtype.

    As 3D Gaussian Splatting uses it: 11 x 11 Gaussian window of sigma 1.5, zeros outside of the image.
    """
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


def image_loss_reference(image, target, ssim_lambda=0.2) -> torch.Tensor:
    """Image loss of training, (1 - ssim_lambda) L1 + ssim_lambda (1 - SSIM)."""
    return ((1 - ssim_lambda) * (image - target).abs() + ssim_lambda * (1 - ssim_map(image, target))).mean()
