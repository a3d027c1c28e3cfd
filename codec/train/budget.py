"""What a scene needs: points to start from and steps of a keyframe, from the pixels that its pictures show of it.

A preset is a price, the same for all scenes: of a dB in bits (below which screen gradient a Gaussian is not split, and
above which contribution it stays) and in seconds (steps for a small picture). How many Gaussians there are follows from
what is still wrong in the pictures; a larger picture has more of them to place and gets more steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .settings import BudgetSettings
from .views import Views


@dataclass(frozen=True)
class Budget:
    """Of one keyframe.

    Attributes:
        points: to start from, about.
        steps: optimisation steps.
    """

    points: int
    steps: int


def budget_of(views: Views, frame: int, steps: int, settings: BudgetSettings) -> Budget:
    """The budget of `frame`; `steps`: of the preset, for a picture of `pixels`."""
    covered = np.mean([_covered(views, i, frame) for i in views.train_cameras] or [0])
    more = min(max((covered / settings.pixels) ** settings.steps_exponent, 1.0), settings.steps_most)
    return Budget(
        int(np.clip(settings.points_share * covered, settings.points_min, settings.points_max)), round(more * steps)
    )


def _covered(views: Views, camera: int, frame: int) -> int:
    """Pixels of a view that show the subject, or all of them."""
    view = views.view(camera, frame)
    return view.rgb.shape[0] * view.rgb.shape[1] if view.alpha is None else int(np.count_nonzero(view.alpha))
