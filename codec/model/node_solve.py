"""Node translations by least squares: blending is linear in them, so one factorization solves all frames and axes."""

from __future__ import annotations

import numpy as np

from .. import _native
from ..threads import each_frame
from .rotations import rotvec_to_quat

RIDGE = 1e-3  # pull of a translation towards its start value, as a share of the node's mass


def solve_translations(
    nodes: tuple[np.ndarray, np.ndarray, np.ndarray], rest: np.ndarray, means: np.ndarray, blend: tuple
) -> np.ndarray:
    """[T, M, 3] f64 translations of the nodes that carry the Gaussians nearest to `means`.

    Args:
        nodes: positions [M, 3], rotation vectors [T, M, 3], and start values of the translations [T, M, 3].
        rest: [N, 3] positions of the Gaussians at rest.
        means: [T, N, 3] positions of the Gaussians in each frame.
        blend: neighbors [N, k] and weights [N, k].
    """
    from scipy.sparse import csr_matrix, identity
    from scipy.sparse.linalg import splu

    positions, rotations, start = nodes
    n, (frames, m) = len(rest), rotations.shape[:2]
    index, share = (np.ascontiguousarray(a, t) for a, t in zip(blend, (np.uint32, np.float32), strict=True))
    starts = np.arange(n + 1, dtype=np.int32) * index.shape[1]
    B = csr_matrix((share.ravel(), index.ravel().astype(np.int32), starts), (n, m))  # [N, M] f32
    x = rest.astype(np.float32)

    def left(t: int) -> np.ndarray:
        at = (positions, rotvec_to_quat(rotations[t]), positions + start[t])
        nodes = tuple(np.ascontiguousarray(a, np.float32) for a in at)
        return B.T @ (means[t] - _native.blend_rigid(nodes, x, index, share)[0])

    missing = np.stack(each_frame(left, frames), 1).astype(np.float64).reshape(m, frames * 3)
    normal = (B.T @ B).astype(np.float64)
    mass = np.asarray(B.sum(0)).ravel().astype(np.float64) + 1e-9
    ridge = identity(m, format="csc").multiply(RIDGE * mass)
    solved = splu((normal + ridge).tocsc()).solve(missing)
    return start + np.moveaxis(solved.reshape(m, frames, 3), 1, 0)
