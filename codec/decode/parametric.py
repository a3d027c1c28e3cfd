"""DecodedGroup -> ParametricGroup: a decoded group in the form that training produces and the encoder takes."""

from __future__ import annotations

import numpy as np

from ..bitstream.color import TO_RGB
from ..bitstream.quantized_group import QuantizedGroup, QuantizedRig, QuantizedTrajectories
from ..model.attributes import BY_NAME
from ..model.gaussians import Gaussians
from ..model.parametric_group import NodeMotion, ParametricGroup
from ..model.rig import RigMotion
from ..model.temporal_transform import dct_basis


def parametric_group(decoded) -> ParametricGroup:
    """The group of a `_native.DecodedGroup` in floats; its frames equal those of the stream within f32.

    Parents are left out: they are indices in the reference, which may be several groups back.
    """
    q: QuantizedGroup = decoded.quantized()
    return ParametricGroup(
        q.frames,
        Gaussians(**decoded.canonical()),
        None if q.nodes is None else _nodes(q, *decoded.blend()),
        {n: _coefficients(n, t) for n, t in q.trajectories.items()},
        None if q.lifetimes is None else q.lifetimes.astype(np.int32),
        turned_harmonics=q.turned_harmonics,
    )


def _nodes(q: QuantizedGroup, neighbors: np.ndarray, weights: np.ndarray) -> NodeMotion:
    places = q.origin + np.float32(q.grid_step) * q.nodes.positions.astype(np.float32)
    basis = dct_basis(q.frames)[: len(q.nodes.coefficients)]
    values = np.einsum("kt,kcm->tmc", basis, q.nodes.coefficients)
    rotations, translations = values[..., :3] * q.nodes.rotation_step, values[..., 3:] * q.nodes.translation_step
    moves, rig = (rotations.astype(np.float32), translations.astype(np.float32)), None
    if q.nodes.rig is not None:
        rig = rig_motion(q.nodes.rig, q.origin, q.grid_step)
        moves = rig.total(places, *moves)
    return NodeMotion(places, *moves, neighbors.astype(np.int32), weights, rig)


def rig_motion(r: QuantizedRig, origin: np.ndarray, grid_step: float) -> RigMotion:
    """Dequantizes the rig of a group with this grid."""
    steps = np.repeat([r.rotation_step, r.translation_step], 3).astype(np.float32)
    joints = np.float32(origin) + np.float32(grid_step) * r.joints.astype(np.float32)
    poses = steps * np.einsum("kt,kcj->tjc", dct_basis(len(r.poses)), r.poses)
    return RigMotion(joints, r.parents, steps * r.bind.astype(np.float32), poses.astype(np.float32), r.weights)


def _coefficients(attribute: str, t: QuantizedTrajectories) -> np.ndarray:
    """[K, C, N] f32, colours in RGB."""
    c = t.coefficients.astype(np.float32) * np.float32(t.step)
    if not BY_NAME[attribute].decorrelated:
        return c
    return (TO_RGB.astype(np.float32) @ c.reshape(len(c), c.shape[1] // 3, 3, c.shape[2])).reshape(c.shape)
