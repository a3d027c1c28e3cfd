"""Training budgets. A preset is a set of step counts; everything else is the same for all."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import UsageError
from ..model.gaussians import GOP


@dataclass(frozen=True)
class TrainSettings:
    """Budgets and weights of one training run.

    Attributes:
        gop: most frames in a group.
        keyframe_steps: optimisation steps for a keyframe, which always starts from nothing.
        motion_steps: steps a frame for tracking.
        finetune_steps: steps a frame for the joint fine-tuning of the group.
        gaussians_max: bound on the count; a keyframe has four fifths of it at most, births the rest.
        sh_degree: most that a keyframe may have of spherical harmonics; it keeps what pays.
        ssim_lambda: share of D-SSIM in the image loss (3D Gaussian Splatting: 0.2).
        mask_lambda: weight of the alpha loss where the capture has masks.
        cut_ratio: a frame whose image loss exceeds the keyframe's by this factor starts a group of its own.
        rigidity: weight of the as-rigid-as-possible term.
        rate_lambda: by which share the image loss may rise where bits fall by one.
        quality: quantization the rate term assumes (0 to 100).
        seed: of everything random.
    """

    gop: int = GOP
    keyframe_steps: int = 1500
    motion_steps: int = 200
    finetune_steps: int = 120
    gaussians_max: int = 17500
    initial_points: int = 8000
    sh_degree: int = 1
    ssim_lambda: float = 0.2
    mask_lambda: float = 0.1
    cut_ratio: float = 2.0
    rigidity: float = 0.1
    rate_lambda: float = 0.4
    quality: float = 50.0
    seed: int = 0

    def __post_init__(self):
        if self.gop < 1:
            raise UsageError(f"--gop {self.gop} is out of range, expected at least 1 frame in a group")


PRESETS = {
    "fast": {"keyframe_steps": 700, "motion_steps": 100, "finetune_steps": 40, "gaussians_max": 10000},
    "medium": {},
    "slow": {"keyframe_steps": 4000, "motion_steps": 250, "finetune_steps": 300, "gaussians_max": 31000},
}


def train_settings(preset: str, **changes) -> TrainSettings:
    """Settings of a preset, with changes.

    Raises:
        UsageError: the preset does not exist or a value is out of range.
    """
    if preset not in PRESETS:
        raise UsageError(f"--preset {preset} does not exist, expected one of {', '.join(PRESETS)}")
    return TrainSettings(**{**PRESETS[preset], **changes})
