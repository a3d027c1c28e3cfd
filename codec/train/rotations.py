"""Quaternions (wxyz), rotation vectors and matrices as differentiable torch functions."""

from __future__ import annotations

import torch


def quat_multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product, [N, 4] wxyz."""
    aw, au, bw, bu = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (au * bu).sum(1, keepdim=True)
    return torch.cat([w, aw * bu + bw * au + torch.linalg.cross(au, bu, dim=-1)], 1)


def quat_conjugate(q: torch.Tensor) -> torch.Tensor:
    """Inverse of unit wxyz quaternions, [N, 4]."""
    return q * torch.tensor([1.0, -1.0, -1.0, -1.0])


def rotvec_to_quat(v: torch.Tensor) -> torch.Tensor:
    """[N, 3] radians -> [N, 4] wxyz, smooth at zero."""
    half = (v.square().sum(1, keepdim=True) + 1e-16).sqrt() / 2
    return torch.cat([torch.cos(half), v * 0.5 * torch.sinc(half / torch.pi)], 1)


def quat_to_rotvec(q: torch.Tensor, near: torch.Tensor | None = None) -> torch.Tensor:
    """[N, 4] unit wxyz -> [N, 3] radians, of the equal ones the nearest to `near` (continuous over time)."""
    q = q * torch.where(q[:, :1] < 0, -1.0, 1.0)
    sine = q[:, 1:].norm(dim=1, keepdim=True)
    axis = q[:, 1:] / sine.clamp(min=1e-12)
    angle = 2 * torch.atan2(sine, q[:, :1])
    if near is not None:
        angle = angle + 2 * torch.pi * torch.round(((near * axis).sum(1, keepdim=True) - angle) / (2 * torch.pi))
    return axis * angle


def quat_to_matrix(q: torch.Tensor) -> torch.Tensor:
    """[N, 4] unit wxyz -> [N, 3, 3]."""
    w, x, y, z = q.unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def rotate(quats: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Vectors [N, 3] rotated by quaternions [N, 4] wxyz of any length."""
    q = torch.nn.functional.normalize(quats, dim=-1)
    w, u = q[:, :1], q[:, 1:]
    cross = torch.linalg.cross(u, v, dim=-1)
    return v + 2 * (w * cross + torch.linalg.cross(u, cross, dim=-1))
