"""QuantizedGroup: the integers of a group, as the native coder takes them and the native decoder gives them back.

Mirrored field by field by gsv::group::Group and its header; a test compares both. Clauses are those of spec/gsv.md.
Planar arrays here, interleaved ones in Rust. All arrays are in the order of the stream: layer after layer, in each the
survivors of the reference, then what the group codes itself in Morton order.
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
    """What predicts the motion of the nodes: J joints with parents, and their poses (clauses 11.1, 11.2).

    Attributes:
        joints: [J, 3] i32 places in the pose of rest of the skeleton, in grid steps from the origin of the grid.
        parents: [J] u8, parent of each joint, before it; its own index: a root.
        bind: [J, 6] i32, the pose in which the group rests: rotation vector, translation of each joint, in steps.
        weights: [M, J] u8, 0 to 64: which joints move each node; all 0: the rig does not move it.
        poses: [T, 6, J] i32 temporal DCT coefficients of the poses of the joints.
        rotation_step: radians. translation_step: world units.
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
        coefficients: [K, 6, M] i32 temporal DCT coefficients: rotation vector, then translation; behind what the rig
            predicts.
        rotation_step: radians. translation_step: world units.
        neighbors: nodes that carry one Gaussian.
        rig: predicts the motion; None: nothing does.
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
        origin: [3] f32, world units, where the grid begins; grid_step: its spacing; grid_bits: bits of a coordinate.
        positions: [N, 3] u32 on the grid.
        channels: attribute -> canonical integers, all attributes but means; shN only where the SH degree is above 0.
        trajectories: attribute -> coefficients; an attribute that is missing does not change over time.
        nodes: deformation graph; None: there is none.
        lifetimes: [N, 2] u16, the frames [t0, t1) in which each Gaussian is shown; None: all frames.
        layers: [L] Gaussians of each layer; None: one layer.
        shifts: [L, 1 + A] low bits that a layer leaves out, of positions and of each attribute in the order of
            `channels` in the table; None: none.
        corrections: [L, 2] f32, added to log_scales and logit_opacities while the layers behind are missing; None: 0.
        scale_exponents: [3, 3] i32, how the steps of quats fall with the decoded sizes (clause 13.1), in 1/32.
        tile_side_log2: a tile has up to 4^tile_side_log2 Gaussians (clause 7.2); predicted: as in the reference.
        reference: how many groups back the group is that this one is predicted from; 0: independent.
        parents: [N] i32, index of each Gaussian in that group, -1 for a birth; None where `reference` is 0.
        turned_harmonics: the higher bands of SH turn with the nodes (clause 13.4); predicted: as in the reference.
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
