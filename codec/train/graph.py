"""The node graph of a subject: a few hundred control points whose rigid motions carry all Gaussians.

HiFi4G's coarse deformation graph, and what the stream's nodes are (spec 13.2 and 13.3: same neighbours, same weights):
tracking optimises the nodes, so a smooth motion is smooth by construction and cheap to code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gscodec import _native
from gscodec.sampling import farthest_points

NODES = 256  # 1000 track as well
STILL_SHARE = 0.25  # of the nodes, for what does not move yet, if that is as large a share of the Gaussians
BLENDED = 4  # nodes that carry one Gaussian
EDGES = 8  # neighbours of a node in the rigidity term
HELD = 0.1  # weight from which a node has a hold on a Gaussian
GRID = 1e-3  # of the radius: the lattice on which neighbours and weights are computed


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
    """[N, 4] unit wxyz -> [N, 3] radians, of the equal ones the nearest to `near` (no jumps over time)."""
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


@dataclass
class Pose:
    """Where the nodes are (`nodes` [M, 3]), how far they `turned` since the keyframe ([M, 4]), and their last step."""

    nodes: torch.Tensor
    turned: torch.Tensor
    turn: torch.Tensor  # [M, 3] rotation vector of the last step
    move: torch.Tensor  # [M, 3]

    @staticmethod
    def rest(graph: NodeGraph) -> Pose:
        """The keyframe's."""
        zero = torch.zeros_like(graph.nodes)
        return Pose(graph.nodes, rotvec_to_quat(zero), zero, zero)


class _Weighted(torch.autograd.Function):
    """Sparse weights [N, M] times rows [M, C]; scipy's product takes a tenth of the time of gathering rows in torch."""

    @staticmethod
    def forward(ctx, rows, weights, transposed):
        ctx.transposed = transposed
        return torch.from_numpy(weights @ rows.detach().numpy())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        return torch.from_numpy(ctx.transposed @ grad.numpy()), None, None


class NodeGraph:
    """Nodes of a keyframe and the weights by which they carry its Gaussians.

    Args:
        means: [N, 3] positions in the keyframe.
        low, step: [3] and world units, origin and spacing of the lattice; chosen: [M, 3] u32, nodes on it.

    Attributes:
        means: as given.
        nodes: [M, 3] positions of the nodes in the keyframe.
    """

    def __init__(self, means: torch.Tensor, low: torch.Tensor, step: float, chosen: np.ndarray):
        from scipy.spatial import cKDTree

        self.lattice = (low, step, chosen)
        self.nodes = low + step * torch.from_numpy(chosen.astype(np.float32))
        self.means, self._blend = means[:0], None
        self.extend(means)
        m, k = len(chosen), min(EDGES, len(chosen) - 1)
        near = cKDTree(self.nodes.numpy()).query(self.nodes.numpy(), k + 1)[1].reshape(m, -1)[:, 1:]
        self._edges = torch.from_numpy(near.astype(np.int64))
        length = (self.nodes[self._edges] - self.nodes[:, None]).norm(dim=2, keepdim=True)
        middle = length.median() if k else torch.ones(())
        hold = torch.exp2(-((length / (1.5 * middle)) ** 2))  # long edges bridge gaps: they hold less
        self._hold = hold * GRID / step

    @staticmethod
    def of(means: torch.Tensor, radius: float, moving: torch.Tensor, count: int = NODES) -> NodeGraph:
        """Nodes for Gaussians at `means` [N, 3], most of them where `moving` ([N] bool); `radius` of these."""
        low, step = means.min(0).values, GRID * radius
        grid = torch.round((means - low) / step).numpy().astype(np.uint32)
        if (~moving).float().mean() < STILL_SHARE:  # nodes that stay among others that move would hold them
            moving = torch.ones_like(moving)
        still = int(STILL_SHARE * count) if (~moving).any() else 0
        some = [np.zeros((0, 3), np.uint32)]
        for mask, most in ((moving, count - still), (~moving, still)):
            if mask.any() and most:
                some.append(grid[mask.numpy()][farthest_points(means[mask].numpy(), most)])
        chosen = np.unique(np.concatenate(some), axis=0)
        return NodeGraph(means, low, step, chosen[_native.morton_order(chosen)])

    def extend(self, means: torch.Tensor) -> None:
        """More Gaussians to carry, at [K, 3] in the keyframe."""
        from scipy.sparse import csr_matrix, vstack

        low, step, chosen = self.lattice
        grid = torch.round((means - low) / step).clamp(min=0).numpy().astype(np.uint32)
        index, weight = _native.node_weights(grid, chosen, BLENDED)
        parts = (
            weight.astype(np.float32).ravel(),
            index.astype(np.int32).ravel(),
            index.shape[1] * np.arange(len(grid) + 1),
        )
        rows = csr_matrix(parts, (len(grid), len(chosen)))
        self._blend = rows if self._blend is None else vstack([self._blend, rows], format="csr")  # [N, M]
        self._gather = self._blend.T.tocsr()
        self.means = torch.cat([self.means, means])

    def carried_back(self, means: torch.Tensor, pose: Pose) -> torch.Tensor:
        """[K, 3] positions in the keyframe of points at `means` in `pose`, by the motion of the nearest node."""
        from scipy.spatial import cKDTree

        nearest = torch.from_numpy(cKDTree(pose.nodes.numpy()).query(means.numpy())[1])
        back = quat_to_matrix(quat_conjugate(pose.turned[nearest]))
        return self.nodes[nearest] + torch.einsum("kij,kj->ki", back, means - pose.nodes[nearest])

    def __len__(self) -> int:
        return len(self.nodes)

    def carry(self, x: torch.Tensor, pose: Pose) -> tuple[torch.Tensor, torch.Tensor]:
        """Points of the keyframe moved by the nodes' rigid motions, blended (spec 13.3).

        Args:
            x: [N, 3], in the keyframe.

        Returns:
            means [N, 3] and the blended rotation [N, 4] unit wxyz.
        """
        R = quat_to_matrix(pose.turned)
        offset = pose.nodes - torch.einsum("mij,mj->mi", R, self.nodes)
        rows = torch.cat([R.flatten(1), offset, pose.turned], 1)
        blend = _Weighted.apply(rows, self._blend, self._gather)
        means = (blend[:, :9].view(-1, 3, 3) * x[:, None]).sum(2) + blend[:, 9:12]
        return means, torch.nn.functional.normalize(blend[:, 12:], dim=1)

    def carriers(self, chosen: torch.Tensor) -> torch.Tensor:
        """[M] bool: nodes that carry a Gaussian of `chosen` ([N] bool) with a weight of more than `HELD`."""
        weights = self._gather[:, chosen.numpy()]
        return torch.from_numpy((weights > HELD).getnnz(axis=1) > 0)

    def rigidity(self, pose: Pose) -> torch.Tensor:
        """Mean weighted length by which the edges between nodes miss their rotated selves (Sorkine and Alexa 2007)."""
        if self._edges.numel() == 0:
            return pose.nodes.sum() * 0
        edge = self.nodes[self._edges] - self.nodes[:, None]
        turned = torch.einsum("mij,mkj->mki", quat_to_matrix(pose.turned), edge)
        missed = turned - (pose.nodes[self._edges] - pose.nodes[:, None])
        return (self._hold * missed).square().sum(2).add(1e-12).sqrt().mean()
