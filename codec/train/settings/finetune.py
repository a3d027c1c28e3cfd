"""Settings of the joint fine-tuning of a group, and of its entropy model."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

from ...model.attributes import BY_NAME, FREQUENCIES_OF
from ...model.gaussians import Gaussians
from ...render.optimizer import AdamSettings


def temporal_frequencies() -> dict[str, int]:
    """Attribute -> temporal frequencies (DCT) that its residuals may use in a group of `FREQUENCIES_OF` frames. A
    longer group uses more in proportion, a shorter one as many as it has. A missing attribute is constant."""
    table = {f.name: BY_NAME[f.name].temporal_frequencies for f in fields(Gaussians)}
    return {name: count for name, count in table.items() if count}


@dataclass(frozen=True)
class FinetuneSettings:
    """Joint optimisation of a group: canonical attributes and residual coefficients."""

    frequencies: dict[str, int] = field(default_factory=temporal_frequencies)
    frequencies_frames: int = FREQUENCIES_OF  # frames that `frequencies` is for
    fast_frequencies: float = 1.0  # added frequencies, times the usual, if all frames are `Tracker.searched`
    fast_steps: float = 4.0  # added steps a frame there, times the usual: frames have less in common
    fast_canonical: float = 1.0  # added rates of canonical attributes there, times the usual
    fast_warmup: float = 0.1  # share of the steps in which rates rise there: full rates would undo the tracked motion
    warmup: float = 0.0  # the same in other groups: the first steps undo tracked motion, but also free it
    free_min: float = 0.5  # quantization steps: a resting Gaussian with a larger initial coefficient stays free
    dead_zone: float = 0.1  # quantization steps beyond half of one, below which a coefficient is not coded
    shrinkage: float = 2.0  # quantization steps by which the coefficients of a predicted group start nearer to 0
    coefficient_rate: float = 0.1  # quantization steps
    log_scale_start: float = -1.0  # log of a Laplace scale, quantization steps
    log_scale_rate: float = 0.02
    coefficient_adam: AdamSettings = field(default_factory=lambda: AdamSettings(eps=1e-8))
    node_rotation_rate: float = 2e-3  # radians; 0: the nodes move as they were tracked
    node_translation_rate: float = 3e-4  # radii
    canonical_means_rate: float = 3.2e-4  # radii
    canonical_rate_share: float = 1.0  # of the keyframe's rates, for all other canonical attributes
    canonical_bit_weight: float = 4.0  # of a canonical bit, in bits of residuals
    canonical_noise: bool = True  # uniform noise in place of quantization, on canonical attributes
    rate_decay: float = 0.05  # rates at the last step, times those at the first
    topology_at: float = 0.3  # share of the steps at which Gaussians are removed and added
    topology_views: int = 4  # times that each camera must have been drawn before
    short_life: float = 0.2  # share of the frames; a Gaussian that lives shorter takes proportionally smaller steps
    views: int = 2  # of one frame, in one step: they share the other costs of a step
    frames_min: float = 20.0  # a shorter group after a keyframe has the steps of this many frames
    growth: float = 0.1  # share of the Gaussians that may be added at `topology_at`
    residual_share: float = 0.115  # residual bits of a frame over canonical bits: more of them make no bit cheaper
    rate_every: int = 8  # steps from one rate term to the next: it needs all coefficients; its weight grows by as much
    canonical_rate_every: int = 24  # steps for which the gradient of the canonical bits, and their noise, are held
    loss_smoothing: float = 0.05  # share of one step in the running mean of the loss

    def with_frequencies(self, times: float) -> FinetuneSettings:
        """The same settings with `times` as many frequencies."""
        return replace(self, frequencies={n: round(times * count) for n, count in self.frequencies.items()})


@dataclass(frozen=True)
class EntropyModelSettings:
    """Laplace model of canonical integers, in quantization steps."""

    spread_min: float = 0.5  # added to the mean difference of a value's neighbours
    scale_min: float = 0.05  # of the Laplace distribution


@dataclass(frozen=True)
class RefinementSettings:
    """Refinement of the integers of a coded group against the pictures of the capture (`refinement.py`).

    Attributes:
        passes: times that each training picture of a frame is used.
        frame_pictures: pictures of a frame at most.
        reach: quantization steps by which the first picture moves a value, times the root of the number of pictures,
            for one pixel per Gaussian; grows with the root of the pixels per Gaussian, since few pixels are soon
            overfitted.
        reach_max: bound on the grown `reach`.
        cache_bytes: of pictures held in memory.
    """

    passes: int = 4
    frame_pictures: int = 80
    reach: float = 0.03
    reach_max: float = 1.0
    cache_bytes: int = 1 << 30
