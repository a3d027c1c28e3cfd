"""Budget of a keyframe: its initial points and optimisation steps, from the pixels that show the scene.

A preset is a price, the same for all scenes: of a dB in bits (the screen gradient below which a Gaussian is not split,
the contribution above which it stays) and in seconds (steps for a small picture). The number of Gaussians follows from
the remaining error of the pictures. A larger picture needs more Gaussians, so its keyframe gets more steps. Very small
pictures get more steps, too, in every frame, so that as many pixels are seen: there a step costs hardly less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .settings import BudgetSettings, TrainSettings
from .views import Views


@dataclass(frozen=True)
class Budget:
    """Budget of one keyframe.

    Attributes:
        points: initial points, about.
        steps: optimisation steps.
    """

    points: int
    steps: int


def keyframe_budget(views: Views, frame: int, settings: TrainSettings) -> Budget:
    """The budget of the keyframe `frame`."""
    b, covered = settings.budget, float(np.mean(views.covered(frame)))
    points = settings.initial_points or int(np.clip(b.points_share * covered, b.points_min, b.points_max))
    return Budget(points, round(_larger(covered, b) * _smaller(covered, b) * settings.keyframe_steps))


def with_frame_budget(settings: TrainSettings, views: Views, frame: int) -> TrainSettings:
    """Settings with the steps of a tracked frame and with the drift bound for the steps of its keyframe. A large
    picture has fewer steps a frame: each costs more, and all frames of a group refine the same Gaussians."""
    covered, g = float(np.mean(views.covered(frame))), settings.group
    larger = _larger(covered, settings.budget)
    fit = max(1.0, larger * settings.keyframe_steps / g.drift_steps) ** g.drift_exponent
    group, share = replace(g, drift_ratio=fit * g.drift_ratio), _smaller(covered, settings.budget) / larger
    of_size = lambda steps: max(1, round(share * steps))  # noqa: E731
    densification = replace(settings.densification, steps=of_size(settings.densification.steps))
    frame = {"motion_steps": of_size(settings.motion_steps), "finetune_steps": of_size(settings.finetune_steps)}
    return replace(settings, densification=densification, group=group, **frame)


def _larger(covered: float, settings: BudgetSettings) -> float:
    """Factor of the steps for pictures with more than `pixels` pixels of the scene, 1 for others."""
    return float(np.clip((covered / settings.pixels) ** settings.steps_exponent, 1.0, settings.steps_most))


def _smaller(covered: float, settings: BudgetSettings) -> float:
    """Factor of the steps for pictures so small that a step costs hardly less, 1 for others and for empty pictures."""
    return float(np.clip(settings.small_pixels / covered, 1.0, settings.steps_most)) if covered else 1.0
