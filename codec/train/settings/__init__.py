"""Settings of training, one frozen dataclass a stage. A preset is a set of step counts; the rest is the same for all.

A function takes the settings of its stage. An ablation is a variant of the settings, made by `dataclasses.replace`.
Units: a radius is that of the subject (`subject_radius`), a grey level is 1/255, "share of the steps" is of the
optimisation steps of the stage. Learning rates are those of Adam, in units of the parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ...errors import UsageError
from ...model.gaussians import GOP
from ...render.optimizer import AdamSettings
from .finetune import EntropyModelSettings, FinetuneSettings, RefinementSettings
from .keyframe import (
    CameraCalibrationSettings,
    InitializationSettings,
    KeyframeSettings,
    PlaneSweepSettings,
    VisualHullSettings,
)
from .learning_rates import LearningRates
from .tracking import (
    ChangeDetectionSettings,
    DeformationGraphSettings,
    DensificationSettings,
    GroupSettings,
    RelocalizationSettings,
    TrackingSettings,
)

__all__ = [
    "PRESETS",
    "AdamSettings",
    "CameraCalibrationSettings",
    "ChangeDetectionSettings",
    "DeformationGraphSettings",
    "DensificationSettings",
    "EntropyModelSettings",
    "FinetuneSettings",
    "GroupSettings",
    "InitializationSettings",
    "KeyframeSettings",
    "LearningRates",
    "PlaneSweepSettings",
    "RefinementSettings",
    "RelocalizationSettings",
    "TrackingSettings",
    "TrainSettings",
    "VisualHullSettings",
    "train_settings",
]


@dataclass(frozen=True)
class TrainSettings:
    """Budgets and weights of one training run, and the settings of its stages.

    Attributes:
        gop: most frames in a group.
        keyframe_steps: optimisation steps of a keyframe.
        motion_steps: steps a frame for tracking.
        finetune_steps: steps a frame for the joint fine-tuning of a group.
        gaussians_max: bound on the count of Gaussians.
        initial_points: of a keyframe, about.
        sh_degree: bound on the degree of spherical harmonics; a keyframe keeps them where they lower the error.
        ssim_lambda: share of D-SSIM in the image loss (3D Gaussian Splatting: 0.2).
        mask_lambda: weight of the alpha loss where the capture has masks.
        cut_ratio: a frame whose image loss exceeds the keyframe's by this factor starts a group of its own.
        rigidity: weight of the as-rigid-as-possible term.
        rate_lambda: share by which the image loss may rise where bits fall by one share.
        quality: quantization that the rate term assumes (0 to 100).
        seed: of every random number.
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
    adam: AdamSettings = field(default_factory=AdamSettings)
    initialization: InitializationSettings = field(default_factory=InitializationSettings)
    visual_hull: VisualHullSettings = field(default_factory=VisualHullSettings)
    plane_sweep: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    calibration: CameraCalibrationSettings = field(default_factory=CameraCalibrationSettings)
    keyframe: KeyframeSettings = field(default_factory=KeyframeSettings)
    change_detection: ChangeDetectionSettings = field(default_factory=ChangeDetectionSettings)
    graph: DeformationGraphSettings = field(default_factory=DeformationGraphSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    densification: DensificationSettings = field(default_factory=DensificationSettings)
    relocalization: RelocalizationSettings = field(default_factory=RelocalizationSettings)
    finetune: FinetuneSettings = field(default_factory=FinetuneSettings)
    entropy_model: EntropyModelSettings = field(default_factory=EntropyModelSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    group: GroupSettings = field(default_factory=GroupSettings)

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
