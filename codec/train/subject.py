"""State that lasts from group to group: the tracked Gaussians and the values fixed with their keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..bitstream.quantization import Steps
from ..model.attributes import ATTRIBUTES
from ..model.rig import Rig
from .model import NAMES, Model
from .settings import TrainSettings
from .tracking import Tracker
from .views import Views


@dataclass
class Subject:
    """The Gaussians of a keyframe while they are tracked, from group to group.

    Attributes:
        tracker: holds the Gaussians as they are in the last frame.
        first: frame of the keyframe.
        loss: image loss of the keyframe.
        radius: of the initial points of the keyframe, without the far shell, world units.
        shown: pixels of the scene in the keyframe's pictures, median of the views.
        canonical: Gaussians that all groups since the keyframe refer to; None before the first is fine-tuned.
        parents: [N] index of each Gaussian in the group before.
        steps: quantization steps of all groups since the keyframe; None before the first is fine-tuned.
    """

    tracker: Tracker
    first: int
    loss: float
    radius: float
    shown: float
    canonical: Model | None = None
    parents: np.ndarray | None = None
    steps: Steps | None = None

    def start_next_group(self, canonical: Model) -> None:
        """Starts the next group from `canonical`, all Gaussians of the last group, without the removed ones."""
        alive = self.tracker.alive
        self.parents = np.flatnonzero(alive.numpy())
        self.tracker.select(alive)
        self.canonical = Model({n: p[alive] for n, p in canonical.params.items()})

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint; with the calibration of the cameras."""
        canonical = {f"canonical.{n}": p.numpy() for n, p in self.canonical.params.items()}
        exposure, poses = self.tracker.views.exposure, self.tracker.views.extrinsics
        cameras = {"exposure": exposure.values, "extrinsics": poses.values, "center": poses.center}
        whole = {"keyframe": np.array([self.first, self.loss, self.radius, self.shown]), "parents": self.parents}
        whole["steps"] = _steps_to_array(self.steps)
        return {**whole, **cameras, **canonical, **self.tracker.state()}

    @staticmethod
    def restored(
        state: dict[str, np.ndarray], views: Views, settings: TrainSettings, rig: Rig | None = None
    ) -> Subject:
        """Inverse of `state`; also sets the calibration of `views`."""
        canonical = {n: torch.from_numpy(state[f"canonical.{n}"]) for n in NAMES}
        first, loss, radius, shown = state["keyframe"].tolist()
        views.exposure.values, views.extrinsics.values = state["exposure"], state["extrinsics"]
        views.extrinsics.set_subject(state["center"], radius)
        steps = _steps_from_array(state["steps"])
        tracker = Tracker.restored(state, views, settings, rig)
        return Subject(tracker, int(first), loss, radius, shown, Model(canonical), state["parents"], steps)


def _steps_to_array(steps: Steps | None) -> np.ndarray:
    """One number for each attribute of the table, and the nodes' step; empty for None."""
    return np.array([] if steps is None else [*(steps[a.name] for a in ATTRIBUTES), steps.node_translation])


def _steps_from_array(values: np.ndarray) -> Steps | None:
    """Inverse of `_steps_to_array`."""
    if not len(values):
        return None
    *own, node = values.tolist()
    return Steps({a.name: v for a, v in zip(ATTRIBUTES, own, strict=True)}, node)
