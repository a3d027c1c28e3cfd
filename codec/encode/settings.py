"""Settings of the encoder, and its hyperparameters by stage. Each is documented once, with unit and reason."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..errors import UsageError
from ..model.gaussians import RANDOM_ACCESS
from ..render.optimizer import AdamSettings

LAYERS_MAX = 16  # spec 4


@dataclass(frozen=True)
class PlanSettings:
    """Stage plan (quantization_plan.py).

    Attributes:
        level_percentiles: of log sensitivity, between which layers are evenly spaced.
        least_sensitivity: share of the mean sensitivity that is added to every Gaussian when layers are made.
        still_layers: layers of a single frame of at least `still_least` Gaussians: a layer has steps of its own. A
            moving group has one layer, since trajectories would lose their neighbours in other layers.
        shift_most: doublings of a layer's step at most.
        prune: a Gaussian is removed if the image without it has an error below this share of the error per Gaussian.
        rebirth: factor on `prune` for Gaussians that the reference left out, to come back.
        faded: a survivor that no longer matters is removed if it was this factor more opaque in the reference.
        few: largest number of Gaussians for which there is time for `more_views`.
        views: number of views from which sensitivity is measured.
        more_views: the same for small groups and single frames.
    """

    level_percentiles: tuple[float, float] = (3, 97)
    least_sensitivity: float = 1e-4
    still_layers: int = 4
    still_least: int = 1000
    shift_most: int = 8
    prune: float = 0.3
    rebirth: float = 8.0
    faded: float = 2.0
    few: int = 20_000
    views: int = 24
    more_views: int = 48


@dataclass(frozen=True)
class CompandingSettings:
    """Curves of log_scales and logit_opacities (companding.py).

    Attributes:
        least: number of Gaussians from which the curves save more than they cost.
        bins: number of bins of the histogram of values.
        tails: percentiles of the values between which the bins lie.
        steepest: how much coarser a piece may be than where the image is most sensitive.
        prior: number of Gaussians of mean sensitivity that each bin counts in addition to its own.
    """

    least: int = 2000
    bins: int = 24
    tails: tuple[float, float] = (0.2, 99.8)
    steepest: float = 32.0
    prior: float = 20.0


@dataclass(frozen=True)
class ScaleExponentSettings:
    """Steps of rotations by decoded sizes (rotation_residuals.py).

    Attributes:
        share: of the sensitivity's octaves that steps follow.
        least: number of Gaussians from which exponents can be fitted.
        prior: share of the mean sensitivity that is added to all: a few views measure one Gaussian poorly.
    """

    share: float = 0.5
    least: int = 100
    prior: float = 0.02


@dataclass(frozen=True)
class RdoSettings:
    """Rate-distortion optimised quantization (rdo.py).

    Attributes:
        bit_price: of a bit, in units of the image's error per Gaussian.
        optimized_price: share of `bit_price` if training had a rate term, which has dropped data not worth its bits.
        floor: share of the mean sensitivity that is added to all Gaussians: a few views measure one Gaussian poorly,
            and errors of the same sign add up.
        zero_bits: bits of a trajectory coefficient that is 0.
        nonzero_bits: bits of a trajectory coefficient that is +-1.
        length_bits: bits of one more temporal frequency.
        passes: over canonical integers, whose contexts depend on each other.
        threshold_range: range of a decision threshold beyond half a step, in steps.
        context_prior: counts that a context takes from all contexts together.
    """

    bit_price: float = 0.05
    optimized_price: float = 0.6
    floor: float = 0.2
    zero_bits: float = 0.5
    nonzero_bits: float = 3.0
    length_bits: float = 0.7
    passes: int = 2
    threshold_range: tuple[float, float] = (-0.4, 9.0)
    context_prior: float = 20.0


@dataclass(frozen=True)
class RoundingSettings:
    """Stage refine: adaptive rounding (adaptive_rounding.py).

    Attributes:
        adam: of the latents; epsilon is in the sum of squared differences by a step: latents with a smaller gradient
            stay, since its square may be 0 in f32.
        inside: least distance, in steps, of a latent's start from the ends of the interval of its integer.
        sizes_until: share of the targets for which sizes move; until then the rotations differ from the coded ones.
        drawn_rate: steps by which the first drawn view moves a latent, times the root of the number of views.
        frame_views: drawn views per frame by which a small group of splats is refined.
        still_views: drawn views of a single frame.
    """

    adam: AdamSettings = field(default_factory=lambda: AdamSettings(eps=1e-6))
    inside: float = 0.02
    sizes_until: float = 0.7
    drawn_rate: float = 0.1
    frame_views: int = 10
    still_views: int = 100


@dataclass(frozen=True)
class RateControlSettings:
    """Quality for each group of a stream with a bit rate (rate_control.py).

    Attributes:
        slope: of log size against quality, on the statue and on trained captures.
        tolerance: of a group's size, as a share.
        tries: at most.
        least_budget: share of the mean budget that a group has at least, whatever the groups before it took.
    """

    slope: float = 0.036
    tolerance: float = 0.02
    tries: int = 6
    least_budget: float = 0.25


@dataclass(frozen=True)
class QualitySearchSettings:
    """Search for the quality by the pictures of a capture (quality_search.py).

    Attributes:
        start: first try.
        lowest, highest: bounds.
        tries: at most.
        finest: quality of very fine steps, at which coding counts as free.
        tolerance: of the excess of the squared error, as a log ratio.
        excess_min: smaller excess is noise.
        frame_pictures: pictures per frame by which a try is refined.
        mask_error_max: difference of alpha at which model and mask contradict each other: such pixels do not count.
        judged: pictures by which a try is judged, at least one per frame.
        seed: of their order.
    """

    start: float = 56.0
    lowest: float = 30.0
    highest: float = 90.0
    finest: float = 74.0
    tries: int = 4
    tolerance: float = 0.15
    excess_min: float = 0.005
    frame_pictures: int = 10
    mask_error_max: float = 0.5
    judged: int = 24
    seed: int = 1


@dataclass(frozen=True)
class EncodeSettings:
    """Settings of the encoder.

    Attributes:
        quality: 0 (small) to 100 (fine); 50 is about 41 dB against the input. None: for a capture, the quality at which
            coding costs `loss`; for splats, 50.
        loss: decibels that coding may cost against the pictures of a capture, if no quality is given.
        bitrate: target of the whole file in bits per second, instead of one quality; None: `quality` is used.
        keep_all: also code Gaussians that are never visible.
        random_access: frames from one independent group to the next at most; the groups between are predicted from it
            if their parents are known and it is cheaper. 0 or 1: every group is independent.
        layers: number of layers of importance in each group, each with its own steps; the first k layers decode without
            the others. None: the number with the smallest size.
        refine: views by which each group is refined; 0: none is. None: as many as usually pay (docs/encoding.md).
        doubt: a predicted group larger than this share of its reference's bytes is coded both ways.
        quality_search, plan, companding, scale_exponents, rdo, rounding, rate_control: hyperparameters of the stages.
    """

    quality: float | None = None
    bitrate: float | None = None
    keep_all: bool = False
    random_access: int = RANDOM_ACCESS
    layers: int | None = None
    refine: int | None = None
    doubt: float = 0.7
    loss: float = 0.1
    quality_search: QualitySearchSettings = field(default_factory=QualitySearchSettings)
    plan: PlanSettings = field(default_factory=PlanSettings)
    companding: CompandingSettings = field(default_factory=CompandingSettings)
    scale_exponents: ScaleExponentSettings = field(default_factory=ScaleExponentSettings)
    rdo: RdoSettings = field(default_factory=RdoSettings)
    rounding: RoundingSettings = field(default_factory=RoundingSettings)
    rate_control: RateControlSettings = field(default_factory=RateControlSettings)

    def __post_init__(self):
        if self.quality is not None and not 0 <= self.quality <= 100:
            raise UsageError(f"--quality {self.quality:g} is out of range, expected 0 (small) to 100 (fine)")
        if self.bitrate is not None and not 0 < self.bitrate < math.inf:
            raise UsageError(f"--bitrate {self.bitrate:g} is out of range, expected finite bits per second above 0")
        if self.random_access < 0:
            raise UsageError(f"--random-access {self.random_access} is out of range, expected 0 frames or more")
        if self.layers is not None and not 1 <= self.layers <= LAYERS_MAX:
            raise UsageError(f"--layers {self.layers} is out of range, expected 1 to {LAYERS_MAX}")
        if self.refine is not None and self.refine < 0:
            raise UsageError(f"--refine {self.refine} is out of range, expected 0 views or more")
