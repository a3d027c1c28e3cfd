"""A coded group with a rig -> the same in other poses: only the unit of poses and the bounds of tiles are new.

The residual motion of the nodes stays: it is coded in the local frame that the rig moves, and follows it.
"""

from __future__ import annotations

import numpy as np

from .. import _native
from ..decode.stream import Stream
from ..errors import UsageError
from ..model.rig import Rig
from .quantize_rig import quantize_poses


def reposed(stream: Stream, i: int, rig: Rig) -> bytes:
    """The payload of group `i` of a stream in the poses of `rig`, of as many frames.

    Raises:
        UsageError: the group has no rig, or one with other joints.
    """
    g, q = stream.groups[i], stream.group(i).quantized()
    own = q.nodes and q.nodes.rig
    where = f"{stream.name}: the group of frame {g['start_frame']}"
    if own is None:
        raise UsageError(f"{where} has no rig and cannot be posed; encode the stream with --rig")
    if not np.array_equal(own.parents, rig.parents):
        raise UsageError(
            f"{where} has a rig of {len(own.parents)} joints, and the poses are of {len(rig.parents)}; expected the "
            f"same joints and parents"
        )
    back = _native.reference_of(stream.payload(i))
    reference = stream.group(i - back) if back else None
    poses = quantize_poses(rig.poses, own.rotation_step, own.translation_step)
    return _native.repose(stream.payload(i), stream.config["level"], poses, reference)
