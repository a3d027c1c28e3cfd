"""Motion of a group: coarse nodes that carry their neighbourhood rigidly, then what they leave over per Gaussian.

In: decoded canonical positions and the means of all frames. Out: nodes and integer coefficients of their
trajectories (spec: "Nodes"), as the decoder will blend them. Nodes are sampled farthest-first; each takes the
weighted Kabsch rotation of the Gaussians it carries, then the translations of all frames are solved together, because
blending is linear in them. As many nodes are taken as still reduce the residual enough to pay for themselves.
Their number is found on a sample of the Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import _native
from ..bitstream.quantization import trajectory_step
from ..bitstream.transform import dct_basis
from ..farthest_point_sampling import farthest_points
from ..model.gaussians import Nodes as GivenNodes
from . import rdo
from .parallel import each_frame

NEIGHBORS = 4  # nodes that a Gaussian blends
NODE_COUNTS = (1, 16, 64, 256, 1024)
NODE_BITS = 50.0  # what one more node costs in a group of 20 frames, measured on statue
RIDGE = 1e-3  # pull of a node's translation towards its own Kabsch solution
SAMPLE = 12000  # Gaussians that tell how many nodes to take


@dataclass(frozen=True)
class Nodes:
    """Quantized nodes.

    Attributes:
        positions: [M, 3] u32 on the grid, Morton order.
        places: [M, 3] f64, the same in the world.
        coefficients: [K, 6, M] i32, rotation vector then translation.
        rotation_step: radians; translation_step: world units.
    """

    positions: np.ndarray
    places: np.ndarray
    coefficients: np.ndarray
    rotation_step: float
    translation_step: float

    def motion(self, frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Decoded rotation vectors and translations, [T, M, 3] each."""
        basis = dct_basis(frames)[: len(self.coefficients)]
        values = np.einsum("kt,kcm->tmc", basis, self.coefficients)
        return values[..., :3] * self.rotation_step, values[..., 3:] * self.translation_step


@dataclass(frozen=True)
class NodeMotion:
    """What nodes do to the Gaussians: `carried` [T, N, 3] f32, means after blending; `turned` [T, N, 4] f32,
    blended rotation of each Gaussian, wxyz."""

    carried: np.ndarray
    turned: np.ndarray


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

    def __init__(self, grid_positions: np.ndarray, node_positions: np.ndarray, dtype=np.float64):
        from scipy.sparse import csr_matrix

        n, m = len(grid_positions), len(node_positions)
        self.index, self.weights = _native.node_weights(grid_positions, node_positions, NEIGHBORS)
        k = self.index.shape[1]
        starts = np.arange(n + 1, dtype=np.int32) * k
        parts = (self.weights.ravel().astype(dtype), self.index.ravel().astype(np.int32), starts)
        self.matrix = csr_matrix(parts, (n, m))

    def rotate(self, x: np.ndarray, nodes: np.ndarray, R: np.ndarray) -> np.ndarray:
        """[N, 3], the blend of every node's rotation about itself, without translations."""
        # sum_j w (R_j (x - n_j) + n_j) = (sum_j w R_j) x + sum_j w (n_j - R_j n_j)
        m = len(nodes)
        offset = nodes - np.einsum("mij,mj->mi", R, nodes)
        both = self.matrix @ np.concatenate([R.reshape(m, 9), offset], 1).astype(self.matrix.dtype)
        return (both[:, :9].reshape(-1, 3, 3) @ x[:, :, None])[..., 0] + both[:, 9:]

    def turn(self, quats: np.ndarray) -> np.ndarray:
        """[N, 4] normalised blend of the node quaternions [M, 4], signs aligned to the nearest node's."""
        quats = quats.astype(self.matrix.dtype)
        if ((quats @ quats.T) >= 0).all():  # the usual case: no node turns far from another
            q = self.matrix @ quats
        else:
            near = quats[self.index]  # [N, k, 4]
            sign = np.where((near * near[:, :1]).sum(-1, keepdims=True) < 0, -1, 1)
            q = (near * sign * self.weights[..., None]).sum(1)
        return q / np.sqrt((q * q).sum(1, keepdims=True))


def _fit_frame(transposed, mass, x, nodes, y) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [M, 3, 3] and translations [M, 3] that carry x [N, 3] to y [N, 3]."""
    m = len(nodes)
    cx = transposed @ x / mass[:, None]
    cy = transposed @ y / mass[:, None]
    H = (transposed @ (x[:, :, None] * y[:, None, :]).reshape(-1, 9)).reshape(m, 3, 3)
    H -= mass[:, None, None] * cx[:, :, None] * cy[:, None, :]
    U, S, Vt = np.linalg.svd(H)
    sign = np.ones((m, 3))
    sign[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = np.einsum("mji,mj,mkj->mik", Vt, sign, U)
    R[S[:, 1] < 1e-6 * np.maximum(S[:, 0], 1e-30)] = np.eye(3)  # a line or a point tells no rotation
    return R, cy - np.einsum("mij,mj->mi", R, cx - nodes) - nodes


def fit_nodes(grid_positions: np.ndarray, x: np.ndarray, means: np.ndarray, seeds: np.ndarray, step: float, to_world):
    """Fits a node at each of the grid points `seeds` [M, 3] and quantizes them.

    Args:
        grid_positions: [N, 3] u32, canonical integers; x: [N, 3] f64, their world positions.
        means: [T, N, 3] targets.
        step: of the translations, world units; to_world: grid integers -> world positions.

    Returns:
        Nodes and [T, N, 3], where they carry x.
    """
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    chosen = np.unique(seeds, axis=0)
    node_grid = chosen[_native.morton_order(chosen)]
    nodes = to_world(node_grid)
    blend = Blend(grid_positions, node_grid)
    transposed = blend.matrix.T.tocsr()
    mass = np.asarray(transposed.sum(1)).ravel() + 1e-9
    frames, m = len(means), len(nodes)
    rotation_step = _rotation_step(step, np.linalg.norm(x - nodes[blend.index[:, 0]], axis=1))
    fits = each_frame(lambda t: _fit_frame(transposed, mass, x, nodes, means[t]), frames)
    translations = np.stack([shift for _, shift in fits])
    rotations, near = np.zeros((frames, m, 3)), np.zeros((m, 3))
    for t, (R, _) in enumerate(fits):
        near = rotations[t] = matrix_to_rotvec(R, near)
    basis = dct_basis(frames)
    q_rotations = quantize_trajectory(rotations, basis, rotation_step)
    rotations = np.tensordot(basis.T, q_rotations * rotation_step, 1)
    rotated = np.stack(each_frame(lambda t: blend.rotate(x, nodes, rotvec_to_matrix(rotations[t])), frames))
    # Translations make up for the quantized rotations: one solution for all frames and axes.
    flat = lambda a: np.moveaxis(a, 0, 1).reshape(a.shape[1], -1)  # noqa: E731
    left = flat(means - rotated) - blend.matrix @ flat(translations)
    ridge = identity(m, format="csc").multiply(RIDGE * mass).tocsc()
    solved = splu((transposed @ blend.matrix).tocsc() + ridge).solve(transposed @ left)
    translations += np.moveaxis(solved.reshape(m, frames, 3), 1, 0)
    q_translations = quantize_trajectory(translations, basis, step)
    coefficients = np.concatenate([q_rotations, q_translations], 2).transpose(0, 2, 1)  # [K, 6, M]
    fitted = Nodes(node_grid, nodes, trim(coefficients), rotation_step, step)
    translations = flat(np.tensordot(basis.T, q_translations * step, 1))
    moved = (blend.matrix @ translations).reshape(-1, frames, 3)
    return fitted, rotated + np.moveaxis(moved, 1, 0)


def given_nodes(
    given: GivenNodes, grid_positions: np.ndarray, step: float, grid, weights: np.ndarray, price: float
) -> Nodes:
    """The nodes that a trainer knows, quantized.

    Args:
        grid_positions: [N, 3], of the Gaussians in the pose in which the nodes rest.
        step: of the translations, world units; grid: the lattice of positions.
        weights: [N, 3] sensitivities of means. price: of a bit.
    """
    from scipy.spatial import cKDTree

    positions, first = np.unique(grid.to_integers(given.positions), axis=0, return_index=True)
    order = _native.morton_order(positions)
    positions, first = positions[order], first[order]
    places, x = grid.to_world(positions), grid.to_world(grid_positions)
    rotation_step = _rotation_step(step, cKDTree(places).query(x)[0])
    moved = given.translations[:, first] + (given.positions[first] - places)  # the node is at rest on the grid
    index, share = _native.node_weights(grid_positions, positions, NEIGHBORS)
    heard = share.astype(np.float64) ** 2 * weights.mean(1, keepdims=True)
    away = ((x[:, None] - places[index]) ** 2).sum(2)
    shifts, turns = (
        np.bincount(index.ravel(), w.ravel(), len(places))[:, None].repeat(3, 1) for w in (heard, heard * away * 2 / 3)
    )
    parts = (
        rdo.trajectory(given.rotations[:, first], turns, rotation_step, price),
        rdo.trajectory(moved, shifts, step, price),
    )
    used = max(map(len, parts))
    coefficients = np.concatenate([np.pad(p, ((0, used - len(p)), (0, 0), (0, 0))) for p in parts], 1)
    return Nodes(positions, places, coefficients, rotation_step, step)


def _rotation_step(step: float, distance: np.ndarray) -> float:
    """Radians: an error of one rotation step at the usual distance from a node moves a Gaussian by one `step`."""
    lever = np.sqrt((distance**2).mean()) if len(distance) else 0.0
    return float(np.float32(min(step / max(lever, 1e-12), 0.1)))


def carry(nodes: Nodes, grid_positions: np.ndarray, x: np.ndarray, frames: int) -> NodeMotion:
    """What `nodes` do to all Gaussians: grid positions [N, 3] u32, world positions x [N, 3]."""
    blend = Blend(grid_positions, nodes.positions, np.float32)
    x = x.astype(np.float32)
    carried, turned = np.empty((frames, len(x), 3), np.float32), np.empty((frames, len(x), 4), np.float32)
    rotations, shifts = nodes.motion(frames)

    def move(t: int):
        # The shift belongs to the offset: both are blended alike.
        R = rotvec_to_matrix(rotations[t])
        carried[t] = blend.rotate(x, nodes.places, R) + blend.matrix @ shifts[t].astype(np.float32)
        turned[t] = blend.turn(rotvec_to_quat(rotations[t]))

    each_frame(move, frames)
    return NodeMotion(carried, turned)


def quantize_trajectory(values: np.ndarray, basis: np.ndarray, step: float) -> np.ndarray:
    """[T, ...] floats -> [T, ...] i32 coefficients."""
    return np.rint(np.tensordot(basis, values, 1) / step).astype(np.int32)


def trim(coefficients: np.ndarray) -> np.ndarray:
    """Drops the trailing all-zero temporal frequencies of [K, ...], keeping at least one."""
    used = np.flatnonzero(coefficients.reshape(len(coefficients), -1).any(1))
    return np.ascontiguousarray(coefficients[: (used[-1] + 1 if len(used) else 1)])


def choose_nodes(grid_positions, x, means, step: float, node_step: float, to_world) -> Nodes | None:
    """The number of nodes at which one more costs what it saves; None when the group hardly moves.

    The residual that nodes leave costs about log2(1 + error / step) bits a coefficient, a node `NODE_BITS`.
    """
    some = slice(None, None, -(-len(x) // SAMPLE))  # in Morton order: evenly over the subject
    grid_some, x_some, targets = grid_positions[some], x[some], means[:, some].astype(np.float64)
    counts = [m for m in NODE_COUNTS if m == 1 or 8 * m <= len(x_some)]
    seeds = grid_some[farthest_points(x_some, counts[-1])]
    best, best_bits = 0, _residual_bits(targets - x_some, step)
    for count in counts:
        nodes, carried = fit_nodes(grid_some, x_some, targets, seeds[:count], node_step, to_world)
        bits = _residual_bits(targets - carried, step) + NODE_BITS * len(nodes.positions) * len(x_some) / len(x)
        if bits < best_bits:
            best, best_bits = count, bits
        elif best:
            break
    if not best:
        return None
    return fit_nodes(grid_positions, x, means, seeds[:best], node_step, to_world)[0]


def _residual_bits(residual: np.ndarray, step: float) -> float:
    """Estimated bits of the residual trajectories [T, N, 3]."""
    frames = len(residual)
    c = np.abs(dct_basis(frames) @ residual.reshape(frames, -1)) / trajectory_step(step, frames)
    return float(np.log2(1 + c[c >= 0.6]).sum() * 2.5)
