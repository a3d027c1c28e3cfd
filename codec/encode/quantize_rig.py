"""A rig in floats -> its integers. The prediction from them, on which nodes build, is decode/parametric.rig_motion."""

from __future__ import annotations

import numpy as np

from ..bitstream.quantized_group import QuantizedRig
from ..model.rig import RigMotion
from ..model.temporal_transform import dct_basis
from .quantization_plan import Grid

ARM = 0.25  # of the extent of the skeleton: arm at which one rotation step moves a node by one translation step
ROTATION_STEP_MOST = 0.05  # radians
JOINT_STEP = 1.4  # of the step of the nodes, which code the residual of the joints
MAX_VALUE = 2**24


def quantize_rig(rig: RigMotion, grid: Grid, step: float) -> QuantizedRig:
    """Quantizes the rig of a group on `grid`; `step`: step of node translations, world units."""
    step = float(np.float32(JOINT_STEP * step))
    extent = float(np.ptp(rig.joints, axis=0).max(initial=0.0))
    rotation_step = float(np.float32(min(step / max(ARM * extent, 1e-12), ROTATION_STEP_MOST)))
    steps = np.repeat([rotation_step, step], 3)
    joints = (rig.joints.astype(np.float64) - grid.origin) / grid.step
    return QuantizedRig(
        joints=_integers(joints),
        parents=np.asarray(rig.parents, np.uint8),
        bind=_integers(rig.bind / steps),
        weights=np.asarray(rig.weights, np.uint8),
        poses=quantize_poses(rig.poses, rotation_step, step),
        rotation_step=rotation_step,
        translation_step=step,
    )


def quantize_poses(poses: np.ndarray, rotation_step: float, translation_step: float) -> np.ndarray:
    """[T, 6, J] i32 DCT coefficients of poses [T, J, 6]."""
    scaled = poses / np.repeat([rotation_step, translation_step], 3)
    return _integers(np.tensordot(dct_basis(len(poses)), scaled, 1).transpose(0, 2, 1))


def _integers(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), -MAX_VALUE, MAX_VALUE).astype(np.int32)
