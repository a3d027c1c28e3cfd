"""Node fit: rest positions and the means of all frames -> the nodes of a deformation graph that carry them.

Nodes are sampled farthest-first; each takes the weighted Kabsch rotation of the Gaussians that it carries, then the
translations of all frames are solved together, since blending is linear in them. Nodes are added while they reduce the
bits of the residual by more than they cost; their number is found on a sample of the Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .. import _native
from ..bitstream.quantization import trajectory_step
from ..farthest_point_sampling import farthest_points
from ..model.node_solve import solve_translations
from ..model.parametric_group import NodeMotion
from ..model.rig import RigMotion
from ..model.rotations import matrix_to_quat, quat_to_matrix, quat_to_rotvec, rotvec_to_quat
from ..model.temporal_transform import dct_basis
from ..threads import each_frame

Predict = Callable[[np.ndarray], RigMotion]  # positions of nodes at rest [M, 3] -> motion that a rig predicts


@dataclass(frozen=True)
class NodeFitSettings:
    """How many nodes a group gets.

    Attributes:
        neighbors: number of nodes that carry one Gaussian.
        counts: numbers of nodes, which are tried in this order.
        node_bits: cost of one more node, bits in a group of 20 frames; measured on a scanned statue.
        sample: number of Gaussians by which the count is chosen.
        least_residual: DCT coefficients below this share of a step are not coded, and cost nothing.
        bits_per_octave: bits of a coefficient for each doubling.
        predicted_node_bits: as `node_bits`, where a rig predicts the motion.
        prior: weight of the rotation that a rig predicts, relative to that of the Gaussians that a node carries.
    """

    neighbors: int = 4
    counts: tuple[int, ...] = (1, 16, 64, 256, 1024)
    node_bits: float = 50.0
    sample: int = 12000
    least_residual: float = 0.6
    bits_per_octave: float = 2.5
    predicted_node_bits: float = 50.0
    prior: float = 1.0


LATTICE_BITS = 20  # bits of the integer lattice on which neighbours and weights are found


def fit_nodes(
    rest: np.ndarray,
    means: np.ndarray,
    step: float,
    settings: NodeFitSettings = NodeFitSettings(),
    predict: Predict | None = None,
) -> NodeMotion | None:
    """The nodes that make a group cheapest; None when it hardly moves.

    The residual that nodes leave costs about log2(1 + error / step) bits a coefficient, a node `node_bits`.

    Args:
        rest: [N, 3] positions at rest, world units.
        means: [T, N, 3] positions in all frames, world units.
        step: quantization step of means, world units.
        predict: motion that a rig predicts; None: no rig.
    """
    node_bits = settings.predicted_node_bits if predict else settings.node_bits
    lattice = _Lattice.around(rest)
    order = _native.morton_order(lattice.integers(rest))
    some = order[:: -(-len(rest) // settings.sample)]  # evenly over the subject
    x, targets = rest[some].astype(np.float64), means[:, some].astype(np.float64)
    counts = [m for m in settings.counts if m == 1 or 8 * m <= len(x)]
    seeds = farthest_points(x, counts[-1])
    best, best_bits, fits = 0, _residual_bits(targets - x, step, settings), {}
    for count in counts:
        fits[count], carried = _fit(lattice, x, targets, x[seeds[:count]], settings, predict)
        price = node_bits * len(fits[count].positions) * len(x) / len(rest)
        bits = _residual_bits(targets - carried, step, settings) + price
        if bits < best_bits:
            best, best_bits = count, bits
        elif best:
            break
    if not best:
        return None
    nodes = fits[best]
    index, share = _native.node_weights(lattice.integers(rest), lattice.integers(nodes.positions), settings.neighbors)
    return replace(nodes, neighbors=index.astype(np.int32), weights=share)


@dataclass(frozen=True)
class _Lattice:
    """Integer lattice over the rest positions: origin [3] and spacing, world units."""

    origin: np.ndarray
    spacing: float

    @staticmethod
    def around(points: np.ndarray) -> _Lattice:
        low = points.min(0).astype(np.float64)
        return _Lattice(low, float((points.max(0) - low).max()) / (2**LATTICE_BITS - 1) or 1.0)

    def integers(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] world -> [N, 3] u32."""
        return np.rint((points - self.origin) / self.spacing).clip(0).astype(np.uint32)


def _fit(lattice, x, means, places, settings, predict) -> tuple[NodeMotion, np.ndarray]:
    """Nodes at `places` [M, 3] for Gaussians that rest at x [N, 3] f64 and are at `means` [T, N, 3], and the positions
    [T, N, 3] to which they carry x."""
    from scipy.sparse import csr_matrix

    on_lattice = np.unique(lattice.integers(places), axis=0)
    nodes = lattice.origin + lattice.spacing * on_lattice
    index, share = _native.node_weights(lattice.integers(x), on_lattice, settings.neighbors)
    n, (frames, m) = len(x), (len(means), len(nodes))
    starts = np.arange(n + 1, dtype=np.int32) * index.shape[1]
    blend = csr_matrix((share.ravel().astype(np.float64), index.ravel().astype(np.int32), starts), (n, m))
    transposed = blend.T.tocsr()
    mass = np.asarray(transposed.sum(1)).ravel() + 1e-9
    rig, prior, shifts = None, [None] * frames, None
    if predict:
        rig = predict(nodes)
        shifts, prior = _prior(rig, nodes, settings.prior)
    fits = each_frame(lambda t: _fit_frame(transposed, mass, x, nodes, means[t], prior[t]), frames)
    rotations, near = np.zeros((frames, m, 3)), np.zeros((m, 3))
    for t, (quats, _) in enumerate(fits):
        near = rotations[t] = quat_to_rotvec(quats, near)
    translations = np.stack([shift for _, shift in fits])
    if predict:
        translations = np.where(rig.weights.any(1)[:, None], shifts, translations)
    translations = solve_translations((nodes, rotations, translations), x, means, (index, share))
    f32 = lambda a: a.astype(np.float32)  # noqa: E731
    motion = NodeMotion(f32(nodes), f32(rotations), f32(translations), index.astype(np.int32), share, rig)
    return motion, _carried(motion, x)


def _carried(motion: NodeMotion, x: np.ndarray) -> np.ndarray:
    """[T, N, 3], positions to which the nodes carry x [N, 3]."""
    rotations, positions = rotvec_to_quat(motion.rotations), motion.positions + motion.translations
    rest, weights = x.astype(np.float32), (motion.neighbors.astype(np.uint32), motion.weights)
    at = [(motion.positions, *nodes) for nodes in zip(rotations, positions, strict=True)]
    return np.stack([_native.blend_rigid(nodes, rest, *weights)[0] for nodes in at])


def _fit_frame(transposed, mass, x, nodes, y, prior=None) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [M, 4] wxyz about the nodes and translations [M, 3] that carry x [N, 3] to y [N, 3] (Kabsch 1976).

    `prior`: weights [M] and matrices [M, 3, 3] of expected rotations.
    """
    m = len(nodes)
    cx = transposed @ x / mass[:, None]
    cy = transposed @ y / mass[:, None]
    H = (transposed @ (x[:, :, None] * y[:, None, :]).reshape(-1, 9)).reshape(m, 3, 3)
    H -= mass[:, None, None] * cx[:, :, None] * cy[:, None, :]
    if prior is not None:
        spread = transposed @ (x * x).sum(1) - mass * (cx * cx).sum(1)
        H += (prior[0] * spread / 3)[:, None, None] * prior[1].transpose(0, 2, 1)
    U, S, Vt = np.linalg.svd(H)
    sign = np.ones((m, 3))
    sign[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = np.einsum("mji,mj,mkj->mik", Vt, sign, U)
    R[S[:, 1] < 1e-6 * np.maximum(S[:, 0], 1e-30)] = np.eye(3)  # a line or a point has no rotation
    return matrix_to_quat(R), cy - np.einsum("mij,mj->mi", R, cx - nodes) - nodes


def _prior(rig: RigMotion, nodes: np.ndarray, weight: float) -> tuple[np.ndarray, list]:
    """Prediction of a rig for `nodes`: translations [T, M, 3], and for each frame the prior of `_fit_frame`."""
    places, turned = rig.at(nodes)
    own = weight * rig.weights.any(1)
    return places - nodes, [(own, quat_to_matrix(q.astype(np.float64))) for q in turned]


def _residual_bits(residual: np.ndarray, step: float, settings: NodeFitSettings) -> float:
    """Estimated bits of the residual trajectories [T, N, 3]."""
    frames = len(residual)
    c = np.abs(dct_basis(frames) @ residual.reshape(frames, -1)) / trajectory_step(step, frames)
    return float(np.log2(1 + c[c >= settings.least_residual]).sum() * settings.bits_per_octave)
