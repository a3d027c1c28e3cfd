"""Settings of a keyframe: initial points, camera calibration, optimisation."""

from __future__ import annotations

from dataclasses import dataclass, field

from .learning_rates import LearningRates, keyframe_rates


@dataclass(frozen=True)
class InitializationSettings:
    """Initial points of a keyframe, and which source they come from."""

    use_plane_sweep: bool = True  # False: a capture without masks starts from random points
    sweep_min_share: float = 0.1  # of initial_points: with fewer, the scene has too little texture for a plane sweep
    surface_opacity: float = 0.5  # of points on a surface that was found
    random_opacity: float = 0.1  # of random points, most of which are nowhere near a surface


@dataclass(frozen=True)
class VisualHullSettings:
    """Visual hull of the masks, and random points where there are no masks."""

    coarse_voxels: int = 64  # along each axis of the first pass
    misses_max: int = 0  # masks that may have a voxel outside
    seen_share: float = 0.5  # of the views must see a voxel
    random_depth_min: float = 0.25  # times the distance to where the optical axes meet
    random_depth_max: float = 3.0  # times that distance


@dataclass(frozen=True)
class PlaneSweepSettings:
    """Plane sweep, and the shell of far points around it."""

    width: int = 256  # pixels of the images that are compared
    planes: int = 96  # evenly in 1/depth
    near: float = 0.2  # times the distance to where the optical axes meet: first plane
    far: float = 4.0  # times that distance: last plane, and the shell
    neighbours: int = 4  # cameras that a view is compared with
    scored_neighbours: int = 2  # best ones, whose mean is the score: the others may not see the surface
    axis_cosine_min: float = 0.5  # between optical axes of neighbours: 60 degrees
    window: int = 7  # pixels, side of the correlated windows
    correlation_min: float = 0.6  # normalised; below it a depth is not believed
    depth_tolerance: float = 0.03  # relative difference of depth at which two views agree
    contrast_min: float = 2.0  # grey levels, standard deviation in a window: below it a window has no texture
    shell_points: int = 500  # on the whole sphere; 0: no shell


@dataclass(frozen=True)
class CameraCalibrationSettings:
    """Exposure (log gain of each channel) and pose of each training camera, learned with a keyframe."""

    exposure_rate: float = 0.02
    exposure_weight: float = 0.02  # of half the square of a log gain in the loss, which keeps gains near 1
    exposure_min: float = 0.05  # root mean square; shading alone, with equal gains, gives 0.01 to 0.05
    pose_rate: float = 5e-3  # radians, radii
    pose_min: float = 1e-2  # root mean square; right poses give 0.001 to 0.009, an error of 0.5 degrees and 5 mm 0.015


@dataclass(frozen=True)
class KeyframeSettings:
    """Optimisation, densification and pruning of a keyframe (Kerbl et al. 2023, shortened)."""

    rates: LearningRates = field(default_factory=keyframe_rates)
    means_rate_end: float = 1.6e-5  # radii, at the last step
    rate_decay: float = 0.1  # all other rates at the last step, times those at the first
    appearance_from: float = 0.3  # share of the steps; exposure, poses and SH wait for colours that are about right
    gaussians_share: float = 0.8  # of gaussians_max; the rest is left for densification while tracking
    densify_every: int = 100  # steps between rounds of densification or pruning
    densify_from: float = 0.1  # share of the steps
    densify_until: float = 0.6  # share of the steps
    thin_until: float = 0.8  # share of the steps; after it the image recovers from what was removed
    growth: float = 0.12  # share of the Gaussians that one round may add
    thinning: float = 0.25  # share of the Gaussians that one round may remove for their small contribution
    contribution_min: float = 5.0  # increase of the error without a Gaussian, in shares of the error per Gaussian
    mse_min: float = 1e-8  # mean squared error of an image below which shares of it mean nothing
    harmonics_gain_min: float = 0.1  # SH stay if the error grows by this share without them; their bits buy 0.04
    prune_opacity: float = 0.02  # a Gaussian below it is removed
    prune_weight: float = 0.02  # largest blending weight in any view; a Gaussian below it is hidden and removed
    split_shrink: float = 1.6  # by which the scales of a Gaussian are divided when it is split
    split_offset: float = 0.7  # of a random offset drawn from the Gaussian, for both halves
    clone_offset: float = 0.3  # of the same, for the copy
