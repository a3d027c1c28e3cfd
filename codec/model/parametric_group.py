"""ParametricGroup: training and fit/ make it, encoding takes it, decoding gives it back.

One set of N Gaussians for T frames. Frame t = the canonical Gaussians, carried rigidly by the nodes of a deformation
graph (HiFi4G), plus residual trajectories in a temporal DCT. Evaluation is native and the same for all four uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from .camera import Calibration
from .gaussians import Gaussians


@dataclass(frozen=True)
class NodeMotion:
    """Coarse motion of a group: M control points, each a rigid motion per frame (HiFi4G's ED graph, DualGS's joints).

    Attributes:
        positions: [M, 3] f32, each node at rest, world units.
        rotations: [T, M, 3] f32, rotation vector in radians from rest to frame t, about the node.
        translations: [T, M, 3] f32, displacement of the node from rest, world units.
        neighbors: [N, k] int32, nodes that carry each Gaussian, k >= 1.
        weights: [N, k] f32, by which their motions are blended; each row sums to 1.
    """

    positions: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    neighbors: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class ParametricGroup:
    """N Gaussians over T >= 1 consecutive frames; index i is the same Gaussian in all of them.

    Attributes:
        frame_count: T.
        canonical: N Gaussians at rest. A Gaussian with a parent rests where its parent does.
        nodes: coarse motion; None: nothing but the trajectories moves.
        trajectories: attribute -> [K, C, N] f32, 1 <= K <= T orthonormal DCT-II coefficients over the T frames, in the
            attribute's units, lowest frequency first; what is missing is 0. means, log_scales, logit_opacities (C = 1),
            sh0 (RGB) and shN (C = 3 coefficients, RGB fastest) are added to the canonical value; means after the nodes.
            quats (C = 3): x, y, z of the unit quaternion that the carried rotation is multiplied by from the left.
        lifetimes: [N, 2] int32, the frames [t0, t1) of the group in which Gaussian i is shown; None: all frames.
        parents: [N] int32, index in the group before of the Gaussian that each one continues, -1 for a new one; no two
            have the same parent. None: nothing is known, as in the first group.
        calibration: what training learned of the capture's cameras; None: there is no capture.
        rate_optimized: training had a rate term, which has dropped what is not worth its bits.
    """

    frame_count: int
    canonical: Gaussians
    nodes: NodeMotion | None = None
    trajectories: Mapping[str, np.ndarray] = field(default_factory=dict)
    lifetimes: np.ndarray | None = None
    parents: np.ndarray | None = None
    calibration: Calibration | None = None
    rate_optimized: bool = False
