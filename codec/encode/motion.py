"""Motion of a group: coarse nodes that carry their neighbourhood rigidly, then what they leave over per Gaussian.

In: decoded canonical positions and the means of all frames. Out: nodes and integer coefficients of their
trajectories (spec: "Nodes"), as the decoder will blend them. Nodes are sampled farthest-first; each takes the
weighted Kabsch rotation of the Gaussians it carries, then all translations of a frame are solved together, because
blending is linear in them. As many nodes are taken as still reduce the residual enough to pay for themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantization import Steps, trajectory_step
from gscodec.bitstream.transform import dct_basis

NEIGHBORS = 4  # nodes that a Gaussian blends
NODE_COUNTS = (1, 16, 64, 256, 1024)
NODE_BITS = 50.0  # what one more node costs in a group of 20 frames, measured on statue
RIDGE = 1e-3  # pull of a node's translation towards its own Kabsch solution


@dataclass(frozen=True)
class NodeMotion:
    """Quantized nodes and what they do to the Gaussians.

    Attributes:
        positions: [M, 3] u32 on the grid, Morton order.
        coefficients: [K, 6, M] i32, rotation vector then translation.
        rotation_step: radians.
        carried: [T, N, 3] f64, means after blending.
        turned: [T, N, 4] f64, blended rotation of each Gaussian, wxyz.
    """

    positions: np.ndarray
    coefficients: np.ndarray
    rotation_step: float
    carried: np.ndarray
    turned: np.ndarray


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """[count] indices of `points` [N, 3], each the farthest from those before it; starts nearest to the centre."""
    first = int(((points - points.mean(0)) ** 2).sum(1).argmin())
    chosen = [first]
    distance = ((points - points[first]) ** 2).sum(1)
    for _ in range(min(count, len(points)) - 1):
        chosen.append(int(distance.argmax()))
        np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1), out=distance)
    return np.array(chosen)


def rotvec_to_quat(v: np.ndarray) -> np.ndarray:
    """[..., 3] radians -> [..., 4] wxyz."""
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    half = angle / 2
    return np.concatenate([np.cos(half), v * (0.5 * np.sinc(half / np.pi))], -1)


def rotvec_to_matrix(v: np.ndarray) -> np.ndarray:
    """[..., 3] radians -> [..., 3, 3] (Rodrigues)."""
    w, x, y, z = np.moveaxis(rotvec_to_quat(v), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, -1) for r in rows], -2)


def matrix_to_rotvec(R: np.ndarray, near: np.ndarray) -> np.ndarray:
    """[M, 3, 3] -> [M, 3], of the equal rotation vectors the one nearest to `near` [M, 3] (no jumps over time)."""
    from scipy.spatial.transform import Rotation

    v = Rotation.from_matrix(R).as_rotvec()
    angle = np.linalg.norm(v, axis=1, keepdims=True)
    axis = np.where(angle > 1e-9, v / np.maximum(angle, 1e-9), 0)
    turns = np.round(((near * axis).sum(1, keepdims=True) - angle) / (2 * np.pi))
    return v + axis * turns * 2 * np.pi


class Blend:
    """Sparse blending of M nodes over N Gaussians, with the decoder's own neighbours and weights."""

    def __init__(self, grid_positions: np.ndarray, node_positions: np.ndarray):
        from scipy.sparse import csr_matrix

        n, m = len(grid_positions), len(node_positions)
        self.index, self.weights = _native.node_weights(grid_positions, node_positions, NEIGHBORS)
        self.weights = self.weights.astype(np.float64)
        k = self.index.shape[1]
        rows = np.repeat(np.arange(n), k)
        self.matrix = csr_matrix((self.weights.ravel(), (rows, self.index.ravel().astype(np.int64))), (n, m))
        self.transposed = self.matrix.T.tocsr()
        self.mass = np.asarray(self.transposed.sum(1)).ravel() + 1e-9

    def rotate(self, x: np.ndarray, nodes: np.ndarray, R: np.ndarray) -> np.ndarray:
        """[N, 3], the blend of every node's rotation about itself, without translations."""
        # sum_j w (R_j (x - n_j) + n_j) = (sum_j w R_j) x + sum_j w (n_j - R_j n_j)
        m = len(nodes)
        RR = (self.matrix @ R.reshape(m, 9)).reshape(-1, 3, 3)
        offset = self.matrix @ (nodes - np.einsum("mij,mj->mi", R, nodes))
        return np.einsum("nij,nj->ni", RR, x) + offset

    def turn(self, quats: np.ndarray) -> np.ndarray:
        """[N, 4] normalised blend of the node quaternions [M, 4], signs aligned to the nearest node's."""
        near = quats[self.index]  # [N, k, 4]
        sign = np.where((near * near[:, :1]).sum(-1, keepdims=True) < 0, -1, 1)
        q = (near * sign * self.weights[..., None]).sum(1)
        return q / np.linalg.norm(q, axis=1, keepdims=True)


def _fit_frame(blend: Blend, x, nodes, y, near) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors and translations [M, 3] that carry x [N, 3] to y [N, 3]."""
    m = len(nodes)
    cx = blend.transposed @ x / blend.mass[:, None]
    cy = blend.transposed @ y / blend.mass[:, None]
    H = (blend.transposed @ (x[:, :, None] * y[:, None, :]).reshape(-1, 9)).reshape(m, 3, 3)
    H -= blend.mass[:, None, None] * cx[:, :, None] * cy[:, None, :]
    U, S, Vt = np.linalg.svd(H)
    sign = np.ones((m, 3))
    sign[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = np.einsum("mji,mj,mkj->mik", Vt, sign, U)
    R[S[:, 1] < 1e-6 * np.maximum(S[:, 0], 1e-30)] = np.eye(3)  # a line or a point tells no rotation
    return matrix_to_rotvec(R, near), cy - np.einsum("mij,mj->mi", R, cx - nodes) - nodes


def fit_nodes(grid_positions: np.ndarray, x: np.ndarray, means: np.ndarray, count: int, steps: Steps, to_world):
    """Fits `count` nodes and quantizes them.

    Args:
        grid_positions: [N, 3] u32, canonical integers; x: [N, 3] f64, their world positions.
        means: [T, N, 3] targets.
        to_world: grid integers -> world positions.
    """
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    chosen = np.unique(grid_positions[farthest_points(x, count)], axis=0)
    node_grid = chosen[_native.morton_order(chosen)]
    nodes = to_world(node_grid)
    blend = Blend(grid_positions, node_grid)
    frames, m = len(means), len(nodes)
    # An error of one rotation step at the usual distance from a node moves a Gaussian by one translation step.
    lever = np.sqrt(((x - nodes[blend.index[:, 0]]) ** 2).sum(1).mean())
    rotation_step = float(np.float32(min(steps.node_translation / max(lever, 1e-12), 0.1)))
    ridge = identity(m, format="csc").multiply(RIDGE * blend.mass).tocsc()
    solve = splu((blend.transposed @ blend.matrix).tocsc() + ridge).solve
    rotations, translations = np.zeros((2, frames, m, 3))
    near = np.zeros((m, 3))
    for t in range(frames):
        rotations[t], translations[t] = _fit_frame(blend, x, nodes, means[t], near)
        near = rotations[t]
    basis = dct_basis(frames)
    q_rotations = quantize_trajectory(rotations.reshape(frames, -1), basis, rotation_step).reshape(-1, m, 3)
    rotations = np.einsum("kt,kmc->tmc", basis, q_rotations * rotation_step)
    carried = np.empty_like(means)
    for t in range(frames):  # translations make up for the quantized rotations
        carried[t] = blend.rotate(x, nodes, rotvec_to_matrix(rotations[t]))
        left = blend.transposed @ (means[t] - carried[t] - blend.matrix @ translations[t])
        translations[t] += solve(left)
    q_translations = quantize_trajectory(translations.reshape(frames, -1), basis, steps.node_translation)
    q_translations = q_translations.reshape(-1, m, 3)
    translations = np.einsum("kt,kmc->tmc", basis, q_translations * steps.node_translation)
    turned = np.empty((*means.shape[:2], 4))
    for t in range(frames):
        carried[t] += blend.matrix @ translations[t]
        turned[t] = blend.turn(rotvec_to_quat(rotations[t]))
    coefficients = np.concatenate([q_rotations, q_translations], 2).transpose(0, 2, 1)  # [K, 6, M]
    return NodeMotion(node_grid, trim(coefficients), rotation_step, carried, turned)


def quantize_trajectory(values: np.ndarray, basis: np.ndarray, step: float, dead_zone: float = 0.5) -> np.ndarray:
    """[T, ...] floats -> [T, ...] i32 coefficients; |coefficient| < dead_zone * step becomes 0."""
    c = np.tensordot(basis, values, 1) / step
    return (np.sign(c) * np.floor(np.maximum(np.abs(c) + 1 - max(dead_zone, 0.5), 0))).astype(np.int32)


def trim(coefficients: np.ndarray) -> np.ndarray:
    """Drops the trailing all-zero temporal frequencies of [K, ...], keeping at least one."""
    used = np.flatnonzero(coefficients.reshape(len(coefficients), -1).any(1))
    return np.ascontiguousarray(coefficients[: (used[-1] + 1 if len(used) else 1)])


def choose_nodes(grid_positions, x, means, steps: Steps, to_world) -> NodeMotion | None:
    """The number of nodes at which one more costs what it saves; None when the group hardly moves.

    The residual that nodes leave costs about log2(1 + error / step) bits a coefficient, a node `NODE_BITS`.
    """
    best, best_bits = None, _residual_bits(means - x, steps)
    for count in NODE_COUNTS:
        if count * 8 > len(x) and count > 1:
            break
        motion = fit_nodes(grid_positions, x, means, count, steps, to_world)
        bits = _residual_bits(means - motion.carried, steps) + NODE_BITS * len(motion.positions)
        if bits < best_bits:
            best, best_bits = motion, bits
        elif best is not None:
            break
    return best


def _residual_bits(residual: np.ndarray, steps: Steps) -> float:
    """Estimated bits of the residual trajectories [T, N, 3]."""
    frames = len(residual)
    c = np.abs(np.tensordot(dct_basis(frames), residual, 1)) / trajectory_step(steps.means, frames)
    return float(np.log2(1 + np.where(c < 0.6, 0, c)).sum() * 2.5)
