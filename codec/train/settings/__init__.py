"""Settings of training, one frozen dataclass a stage. A preset is a price of quality in seconds and in bits; the rest
is the same for all.

A function takes the settings of its stage. An ablation is a variant of the settings, made by `dataclasses.replace`.
Units: a radius is that of the subject (`subject_radius`), a grey level is 1/255, "share of the steps" is of the
optimisation steps of the stage. Learning rates are those of Adam, in units of the parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ...errors import UsageError
from ...model.gaussians import GOP
from ...render.optimizer import AdamSettings
from .finetune import EntropyModelSettings, FinetuneSettings, RefinementSettings
from .keyframe import (
    BudgetSettings,
    CameraCalibrationSettings,
    FarShellSettings,
    InitializationSettings,
    KeyframeSettings,
    PlaneSweepSettings,
    SizeSettings,
    VisualHullSettings,
)
from .learning_rates import LearningRates
from .recolor import RecolorSettings
from .tracking import (
    ChangeDetectionSettings,
    DeformationGraphSettings,
    DensificationSettings,
    GroupSettings,
    MotionFieldSettings,
    MotionSearchSettings,
    RelocalizationSettings,
    RoomSettings,
    TrackingSettings,
)

__all__ = [
    "PRESETS",
    "AdamSettings",
    "BudgetSettings",
    "CameraCalibrationSettings",
    "ChangeDetectionSettings",
    "DeformationGraphSettings",
    "DensificationSettings",
    "EntropyModelSettings",
    "FarShellSettings",
    "FinetuneSettings",
    "GroupSettings",
    "InitializationSettings",
    "KeyframeSettings",
    "LearningRates",
    "MotionFieldSettings",
    "MotionSearchSettings",
    "PlaneSweepSettings",
    "RecolorSettings",
    "RefinementSettings",
    "RelocalizationSettings",
    "RoomSettings",
    "SizeSettings",
    "TrackingSettings",
    "TrainSettings",
    "VisualHullSettings",
    "coding_loss",
    "train_settings",
]


@dataclass(frozen=True)
class TrainSettings:
    """Budgets and weights of one training run, and the settings of its stages.

    Attributes:
        gop: largest number of frames in a group.
        keyframe_steps: optimisation steps of a keyframe of small pictures (budget.py).
        motion_steps: steps a frame for tracking, of small pictures.
        finetune_steps: views a frame for the joint fine-tuning of a group, of small pictures.
        gaussians_max: bound on the count of Gaussians, and so on the memory; their number follows from the scene.
        initial_points: of a keyframe, about; None: as the scene needs (budget.py).
        sh_degree: bound on the degree of spherical harmonics; a keyframe keeps them where they lower the error.
        ssim_lambda: share of D-SSIM in the image loss (3D Gaussian Splatting: 0.2).
        mask_lambda: weight of the alpha loss where the capture has masks.
        depth_lambda: weight of the depth loss where the capture has depth images.
        harmonics_lambda: weight of half the square of the harmonics, mean over the Gaussians: they cost bits.
        turned_harmonics: harmonics turn with the nodes; otherwise they stay fixed in the world.
        cut_ratio: a frame whose image loss exceeds that of the frame before by this factor gets a new keyframe.
        rigidity: weight of the as-rigid-as-possible term.
        rate_lambda: relative rise of the image loss that is allowed per relative fall of the bits.
        few_views: training cameras below which views are few, and above which they are many (`of_capture`).
        quality: quantization that the rate term assumes (0 to 100).
        seed: of all random numbers.
        cache_bytes: of decoded pictures held in memory, with no effect on the result.
    """

    gop: int = GOP
    keyframe_steps: int = 1200
    motion_steps: int = 200
    finetune_steps: int = 300
    gaussians_max: int = 120_000
    initial_points: int | None = None
    sh_degree: int = 3
    ssim_lambda: float = 0.2
    mask_lambda: float = 0.1
    depth_lambda: float = 0.1
    harmonics_lambda: float = 0.15
    turned_harmonics: bool = True
    cut_ratio: float = 1.5
    rigidity: float = 0.3
    rate_lambda: float = 0.4
    few_views: float = 10.0
    quality: float = 56.0
    seed: int = 0
    cache_bytes: int = 2 << 30
    adam: AdamSettings = field(default_factory=AdamSettings)
    initialization: InitializationSettings = field(default_factory=InitializationSettings)
    visual_hull: VisualHullSettings = field(default_factory=VisualHullSettings)
    plane_sweep: PlaneSweepSettings = field(default_factory=PlaneSweepSettings)
    far_shell: FarShellSettings = field(default_factory=FarShellSettings)
    sizes: SizeSettings = field(default_factory=SizeSettings)
    calibration: CameraCalibrationSettings = field(default_factory=CameraCalibrationSettings)
    budget: BudgetSettings = field(default_factory=BudgetSettings)
    keyframe: KeyframeSettings = field(default_factory=KeyframeSettings)
    change_detection: ChangeDetectionSettings = field(default_factory=ChangeDetectionSettings)
    graph: DeformationGraphSettings = field(default_factory=DeformationGraphSettings)
    motion_field: MotionFieldSettings = field(default_factory=MotionFieldSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    motion_search: MotionSearchSettings = field(default_factory=MotionSearchSettings)
    densification: DensificationSettings = field(default_factory=DensificationSettings)
    relocalization: RelocalizationSettings = field(default_factory=RelocalizationSettings)
    finetune: FinetuneSettings = field(default_factory=FinetuneSettings)
    entropy_model: EntropyModelSettings = field(default_factory=EntropyModelSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    group: GroupSettings = field(default_factory=GroupSettings)
    room: RoomSettings = field(default_factory=RoomSettings)

    def __post_init__(self):
        if self.gop < 1:
            raise UsageError(f"--gop {self.gop} is out of range, expected at least 1 frame in a group")

    def of_capture(self, capture) -> TrainSettings:
        """The settings for a capture. Few views hardly contradict changes that overfit the pictures of one frame: the
        fewer views, the higher is the price of a bit, and the faster learns the motion field, which moves neighbours
        together. Many views need a weaker harmonics prior, less dropout, and, of a subject, no teachers. A capture
        without masks gets the settings of a room, in which the field would drag resting Gaussians along.
        """
        views = max(1, len(capture.indices("train")))
        few, many, field = max(1.0, self.few_views / views), max(1.0, views / self.few_views), self.motion_field
        settings = replace(self, rate_lambda=few * self.rate_lambda)
        if not capture.has_alpha:
            return settings._of_room()
        k = self.keyframe
        dropout, teachers = k.dropout * min(1.0, self.few_views / views) ** 4, k.teachers * (views <= k.taught_views)
        return replace(
            settings,
            harmonics_lambda=self.harmonics_lambda / many**2,
            keyframe=replace(k, dropout=dropout, teachers=teachers),
            motion_field=field.faster(min(few**2, field.searched_rates)),
        )

    def _of_room(self) -> TrainSettings:
        """The settings for a capture without masks."""
        room, tracked = self.room, self.motion_field.tracking and self.room.field_in_tracking
        return replace(
            self,
            motion_steps=round(room.motion_steps * self.motion_steps),
            finetune_steps=round(room.finetune_steps * self.finetune_steps),
            rigidity=room.rigidity * self.rigidity,
            cut_ratio=room.cut_ratio * self.cut_ratio,
            keyframe=replace(
                self.keyframe,
                price=room.price * self.keyframe.price,
                dropout=0.0,
                teacher_share=room.teacher_share * self.keyframe.teacher_share,
                opacity_decay=room.opacity_decay,
                position_noise=room.position_noise,
            ),
            finetune=self.finetune.with_frequencies(room.frequencies),
            group=replace(self.group, drift_ratio=room.drift_ratio * self.group.drift_ratio),
            graph=replace(self.graph, nodes=round(room.nodes * self.graph.nodes)),
            motion_field=replace(self.motion_field, tracking=tracked),
        )

    def of_fast_motion(self, share: float) -> TrainSettings:
        """The settings of a group in which a search has found the motion of this share of the frames: their light and
        shape change fast, too, and the frames have less in common."""
        f = self.finetune
        steps, canonical = 1 + f.fast_steps * share, 1 + f.fast_canonical * share
        finetune = replace(
            f.with_frequencies(1 + f.fast_frequencies * share),
            canonical_means_rate=canonical * f.canonical_means_rate,
            canonical_rate_share=canonical * f.canonical_rate_share,
            frames_min=f.frames_min / steps,
            warmup=f.fast_warmup * share,
        )
        return replace(self, finetune=finetune, finetune_steps=round(steps * self.finetune_steps))


PRESETS = {
    "fast": {"keyframe_steps": 700, "motion_steps": 130, "finetune_steps": 170},
    "medium": {},
    "slow": {"keyframe_steps": 3500, "finetune_steps": 750},
}
PRICES = {"fast": 8e-4, "medium": KeyframeSettings.price, "slow": 1e-4}  # `KeyframeSettings.price`
LOSS = {"fast": 0.5, "medium": 0.3, "slow": 0.3}  # dB that coding may cost against very fine steps, without a quality
LOSS_OF_ROOM = 0.5  # dB, at least, without masks: training fits few views of a room far better than other views


MOTIONS = {  # --motion
    "field": MotionFieldSettings(),
    "nodes": MotionFieldSettings(tracking=False, finetune=False),
}


def coding_loss(preset: str, capture) -> float:
    """Decibels of the PSNR on the capture's own pictures that coding may cost where no quality is given."""
    return LOSS[preset] if capture.has_alpha else max(LOSS[preset], LOSS_OF_ROOM)


def train_settings(preset: str, quality: float | None = None, *, motion: str = "field", **changes) -> TrainSettings:
    """Settings of a preset, with changes.

    Args:
        motion: "field" (a hash grid and an MLP move the nodes beside their own variables) or "nodes" (these only).
        quality: of the stream; None: it is found when the first group is coded, and training assumes the default.

    Raises:
        UsageError: the preset does not exist or a value is out of range.
    """
    if preset not in PRESETS:
        raise UsageError(f"--preset {preset} does not exist, expected one of {', '.join(PRESETS)}")
    if motion not in MOTIONS:
        raise UsageError(f"--motion {motion} does not exist, expected one of {', '.join(MOTIONS)}")
    if quality is not None:
        changes["quality"] = quality
    recipe = {"keyframe": KeyframeSettings(price=PRICES[preset]), "motion_field": MOTIONS[motion]}
    return TrainSettings(**{**PRESETS[preset], **recipe, **changes})
