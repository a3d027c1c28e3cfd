"""ParametricGroup: training and fit/ (from splats of other tools) produce it, encoding takes it, decoding returns it.

One set of N Gaussians for T frames. Frame t = the canonical Gaussians, carried rigidly by the nodes of a deformation
graph (HiFi4G), plus residual trajectories in a temporal DCT. Evaluation is native and the same for all four uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from .. import _native
from ..errors import CaptureError
from .camera import Calibration
from .gaussians import Gaussians, shown_at
from .rig import RigMotion
from .temporal_transform import dct_basis


@dataclass(frozen=True)
class NodeMotion:
    """Coarse motion of a group: M control points with a rigid motion per frame (HiFi4G's ED graph, DualGS's joints).

    Attributes:
        positions: [M, 3] f32, each node at rest, world units.
        rotations: [T, M, 3] f32, rotation vector in radians from rest to frame t, about the node.
        translations: [T, M, 3] f32, displacement of the node from rest, world units.
        neighbors: [N, k] int32, nodes that carry each Gaussian, k >= 1.
        weights: [N, k] f32, blending weights of their motions; each row sums to 1.
        rig: predicts the motion, so that the stream codes only the residual; None: no prediction. Rotations and
            translations are the whole motion in either case.
    """

    positions: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    neighbors: np.ndarray
    weights: np.ndarray
    rig: RigMotion | None = None

    def take(self, index: np.ndarray) -> NodeMotion:
        """The same nodes for the Gaussians at `index` ([n] int)."""
        return replace(self, neighbors=self.neighbors[index], weights=self.weights[index])


def checked_parents(parents: np.ndarray, count: int, before: int) -> np.ndarray:
    """Returns the parents of a group of `count` Gaussians if they fit the `before` Gaussians of the group before.

    Raises:
        CaptureError: two Gaussians have the same parent, or a parent does not exist.
    """
    parents = np.asarray(parents)
    known = parents[parents >= 0]
    if parents.shape != (count,) or len(np.unique(known)) < len(known) or known.max(initial=-1) >= before:
        raise CaptureError(
            f"parents of a group: expected, for each of its {count} Gaussians, another one of the {before} of the "
            f"group before, or -1"
        )
    return parents


@dataclass(frozen=True)
class ParametricGroup:
    """N Gaussians over T >= 1 consecutive frames; index i is the same Gaussian in all of them.

    Attributes:
        frame_count: T.
        canonical: N Gaussians at rest. A Gaussian with a parent rests where its parent does.
        nodes: coarse motion; None: only trajectories move Gaussians.
        trajectories: attribute -> [K, C, N] f32, 1 <= K <= T orthonormal DCT-II coefficients over the T frames, in the
            attribute's units, lowest frequency first; missing ones are 0. means, log_scales, logit_opacities (C = 1),
            sh0 (RGB) and shN (C = 3 coefficients, RGB fastest) are added to the canonical value; means after the nodes.
            quats (C = 3): x, y, z of a unit quaternion; the carried rotation is multiplied by it from the left.
        lifetimes: [N, 2] int32, the frames [t0, t1) of the group in which Gaussian i is shown; None: all frames.
        parents: [N] int32, index in the group before of the Gaussian that each one continues, -1 for a new one; no two
            have the same parent. None: unknown, as in the first group.
        calibration: of the capture's cameras, learned in training; None: there is no capture.
        rate_optimized: training had a rate term, which has dropped data that is not worth its bits.
        ended: why the group is shorter than allowed: "cut" (the next frame cannot be tracked), "drift" (the next frame
            cannot be tracked well enough, since the keyframe is too far away), "more" (the next frame shows much that
            the keyframe did not show), "change" (many resting Gaussians begin to change), "jump" (moving objects are
            suddenly elsewhere), "empty" (nothing is visible before the next frame); an empty string: it is not shorter.
        turned_harmonics: shN rotates with the nodes; otherwise it is fixed to the world axes.
    """

    frame_count: int
    canonical: Gaussians
    nodes: NodeMotion | None = None
    trajectories: Mapping[str, np.ndarray] = field(default_factory=dict)
    lifetimes: np.ndarray | None = None
    parents: np.ndarray | None = None
    calibration: Calibration | None = None
    rate_optimized: bool = False
    ended: str = ""
    turned_harmonics: bool = False

    def __len__(self) -> int:
        return self.frame_count

    def __getstate__(self) -> dict:
        """For pickle: the fields, without the native evaluator."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def frame(self, t: int) -> Gaussians:
        """All N Gaussians at frame `t` of the group, also those outside their lifetimes.

        Raises:
            IndexError: `t` is not in the group.
        """
        if not 0 <= t < self.frame_count:
            raise IndexError(f"frame {t} of a group of {self.frame_count}")
        return Gaussians(**self._evaluator.frame(t))

    def visible(self, t: int) -> Gaussians:
        """The Gaussians that frame `t` of the group shows."""
        return shown_at(self.frame(t), self.lifetimes, t)

    def carried(self) -> tuple[np.ndarray, np.ndarray]:
        """Motion by the nodes alone: means [T, N, 3] f32 and rotations [T, N, 4] f32 wxyz that carry the Gaussians."""
        return self._evaluator.carried()

    def harmonics_turns(self) -> np.ndarray | None:
        """Rotations [T, N, 4] f32 wxyz of shN in each frame; None: shN is not rotated."""
        turns = self.turned_harmonics and self.nodes is not None and self.canonical.sh_degree > 0
        return self.carried()[1] if turns else None

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Means [T, N, 3] f32 and quaternions [T, N, 4] f32 wxyz of all frames."""
        return self._evaluator.moved()

    def take(self, index: np.ndarray) -> ParametricGroup:
        """The Gaussians at `index` ([n] int), in that order."""
        pick = lambda a: None if a is None else a[index]  # noqa: E731
        return ParametricGroup(
            self.frame_count,
            self.canonical.take(index),
            self.nodes and self.nodes.take(index),
            {n: np.ascontiguousarray(c[:, :, index]) for n, c in self.trajectories.items()},
            pick(self.lifetimes),
            pick(self.parents),
            self.calibration,
            self.rate_optimized,
            self.ended,
            self.turned_harmonics,
        )

    @cached_property
    def _evaluator(self):
        f32 = lambda a: np.ascontiguousarray(a, np.float32)  # noqa: E731
        nodes, g = None, self.canonical
        if self.nodes is not None:
            motion = np.concatenate([self.nodes.rotations, self.nodes.translations], 2)
            coefficients = np.tensordot(dct_basis(self.frame_count), motion, 1).transpose(0, 2, 1)
            weights = np.ascontiguousarray(self.nodes.neighbors, np.uint32), f32(self.nodes.weights)
            nodes = (f32(self.nodes.positions), f32(coefficients), *weights)
        arrays = tuple(f32(getattr(g, f.name)) for f in fields(g))
        trajectories = [(n, f32(c)) for n, c in self.trajectories.items()]
        return _native.ParametricEvaluator(self.frame_count, arrays, nodes, trajectories, self.turned_harmonics)
