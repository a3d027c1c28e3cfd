"""State that lasts from group to group: the tracked Gaussians and all that was decided with their keyframe."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
import torch

from ..bitstream.quantization import Steps
from .model import NAMES, Model
from .settings import TrainSettings
from .tracking import Tracker
from .views import Views


@dataclass
class Subject:
    """The Gaussians of a keyframe while they are tracked, from group to group.

    Attributes:
        tracker: holds them as they are in the last frame.
        loss: image loss of their keyframe, the reference for cuts.
        radius: of all Gaussians in the keyframe, world units.
        canonical: Gaussians that all groups since the keyframe refer to; None before the first is fine-tuned.
        parents: [N] index of each Gaussian in the group before.
        steps: quantization steps of all groups since the keyframe; None before the first is fine-tuned.
    """

    tracker: Tracker
    loss: float
    radius: float
    canonical: Model | None = None
    parents: np.ndarray | None = None
    steps: Steps | None = None

    def start_next_group(self, canonical: Model) -> None:
        """Starts the next group from `canonical`, all Gaussians of the last one, without the removed ones."""
        alive = self.tracker.alive
        self.parents = np.flatnonzero(alive.numpy())
        self.tracker.select(alive)
        self.canonical = Model({n: p[alive] for n, p in canonical.params.items()})

    def state(self) -> dict[str, np.ndarray]:
        """Everything as arrays, for a checkpoint; with the calibration of the cameras."""
        canonical = {f"canonical.{n}": p.numpy() for n, p in self.canonical.params.items()}
        exposure, poses = self.tracker.views.exposure, self.tracker.views.extrinsics
        cameras = {"exposure": exposure.values, "extrinsics": poses.values, "center": poses.center}
        whole = {"loss_radius": np.array([self.loss, self.radius]), "parents": self.parents}
        whole["steps"] = np.array([] if self.steps is None else astuple(self.steps))
        return {**whole, **cameras, **canonical, **self.tracker.state()}

    @staticmethod
    def restored(state: dict[str, np.ndarray], views: Views, settings: TrainSettings) -> Subject:
        """Inverse of `state`; also sets the calibration of `views`."""
        canonical = {n: torch.from_numpy(state[f"canonical.{n}"]) for n in NAMES}
        loss, radius = state["loss_radius"].tolist()
        views.exposure.values, views.extrinsics.values = state["exposure"], state["extrinsics"]
        views.extrinsics.set_subject(state["center"], radius)
        steps = Steps(*state["steps"].tolist()) if len(state["steps"]) else None
        tracker = Tracker.restored(state, views, settings)
        return Subject(tracker, loss, radius, Model(canonical), state["parents"], steps)
