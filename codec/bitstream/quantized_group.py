"""QuantizedGroup: the integers of a group, as the native coder takes them and the native decoder gives them back.

gsv::group::Group and its header mirror it field by field; a test compares both. Clauses are those of spec/gsv.md.
Arrays are planar here, interleaved in Rust. All arrays are in stream order: layer after layer; in each layer first the
survivors of the reference, then the Gaussians that the group codes itself, in Morton order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class QuantizedChannels:
    """Canonical integers of one attribute (clause 8).

    Attributes:
        values: [C, N] i32, multiples of 2^shift of their layer.
        steps: [C] f32, quantization steps in units of the companded value (quats: see `scale_exponents`).
        offsets: [C] f32, value of integer 0.
        companding: [C, 10] f32, for each channel the start, the width of a piece, and 8 slopes (clause 13.1); only
            log_scales and logit_opacities may have it. None: values are uniform.
    """

    values: np.ndarray
    steps: np.ndarray
    offsets: np.ndarray
    companding: np.ndarray | None = None


@dataclass(frozen=True)
class QuantizedTrajectories:
    """Temporal DCT coefficients of one attribute (clause 11).

    Attributes:
        coefficients: [K, C, N] i32, lowest frequency first.
        step: quantization step in the attribute's units (colours: of Y, Co, Cg).
    """

    coefficients: np.ndarray
    step: float


@dataclass(frozen=True)
class QuantizedRig:
    """Rig that predicts the motion of the nodes: J joints with parents, and their poses (clauses 11.1, 11.2).

    Attributes:
        joints: [J, 3] i32 positions in the rest pose of the skeleton, in grid steps from the origin of the grid.
        parents: [J] u8, parent of each joint, which precedes it; a root has its own index.
        bind: [J, 6] i32, pose in which the group rests: rotation vector and translation of each joint, in steps.
        weights: [M, J] u8, 0 to 64, weight of each joint for each node; all 0: the rig does not move the node.
        poses: [T, 6, J] i32 temporal DCT coefficients of the poses of the joints.
        rotation_step: radians.
        translation_step: world units.
    """

    joints: np.ndarray
    parents: np.ndarray
    bind: np.ndarray
    weights: np.ndarray
    poses: np.ndarray
    rotation_step: float
    translation_step: float


@dataclass(frozen=True)
class QuantizedNodes:
    """Nodes of the deformation graph (clause 12).

    Attributes:
        positions: [M, 3] u32 on the grid, in Morton order.
        coefficients: [K, 6, M] i32 temporal DCT coefficients of rotation vector, then translation; with a rig, of their
            residual to its prediction.
        rotation_step: radians.
        translation_step: world units.
        neighbors: number of nodes that carry one Gaussian.
        rig: predicts the motion; None: no prediction.
    """

    positions: np.ndarray
    coefficients: np.ndarray
    rotation_step: float
    translation_step: float
    neighbors: int
    rig: QuantizedRig | None = None


@dataclass(frozen=True)
class QuantizedGroup:
    """N Gaussians over T frames in integers (clauses 4 to 12).

    Attributes:
        frames: T.
        origin: [3] f32, origin of the grid, world units.
        grid_step: spacing of the grid, world units.
        grid_bits: bits of a coordinate.
        positions: [N, 3] u32 on the grid.
        channels: attribute -> canonical integers, all attributes but means; shN only where the SH degree is above 0.
        trajectories: attribute -> coefficients; a missing attribute does not change over time.
        nodes: deformation graph; None: there is none.
        lifetimes: [N, 2] u16, the frames [t0, t1) in which each Gaussian is shown; None: all frames.
        layers: [L] number of Gaussians in each layer; None: one layer.
        shifts: [L, 1 + A] number of low bits that a layer leaves out, of positions and of each attribute of `channels`,
            in the order of the attribute table; None: 0.
        corrections: [L, 2] f32, added to log_scales and logit_opacities while the next layers are missing; None: 0.
        scale_exponents: [3, 3] i32, exponents in 1/32: fall of the steps of quats with the decoded sizes (clause 13.1).
        tile_side_log2: a tile has up to 4^tile_side_log2 Gaussians (clause 7.2); predicted: as in the reference.
        reference: distance in groups back to the group that this one is predicted from; 0: independent.
        parents: [N] i32, index of each Gaussian in the reference, -1 for a birth; None if `reference` is 0.
        turned_harmonics: the higher bands of SH rotate with the nodes (clause 13.4); predicted: as in the reference.
    """

    frames: int
    origin: np.ndarray
    grid_step: float
    grid_bits: int
    positions: np.ndarray
    channels: Mapping[str, QuantizedChannels]
    trajectories: Mapping[str, QuantizedTrajectories] = field(default_factory=dict)
    nodes: QuantizedNodes | None = None
    lifetimes: np.ndarray | None = None
    layers: tuple[int, ...] | None = None
    shifts: np.ndarray | None = None
    corrections: np.ndarray | None = None
    scale_exponents: np.ndarray = field(default_factory=lambda: np.zeros((3, 3), np.int32))
    tile_side_log2: int = 6
    reference: int = 0
    parents: np.ndarray | None = None
    turned_harmonics: bool = False

    def __len__(self) -> int:
        return len(self.positions)
