"""Settings of a keyframe: initial points, camera calibration, optimisation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from .learning_rates import LearningRates, keyframe_rates


@dataclass(frozen=True)
class InitializationSettings:
    """Initial points of a keyframe, and their sources."""

    use_points: bool = True  # the sparse points of the capture, where it has some
    use_depth: bool = True  # the depth images of the capture, where it has some
    triangulate: bool = True  # matched features of the cameras, for a capture without points, depth and masks
    match_neighbours: int = 4  # cameras that each camera is matched with
    match_features: int = 8000  # of one image at most
    reprojection_max: float = 1.5  # pixels; a match with a larger error is wrong
    parallax_min: float = 2.0  # degrees between the rays of a point; below it its depth is unknown
    points_share_max: float = 0.7  # of the initial points; sparse points leave out surfaces without texture
    use_plane_sweep: bool = True  # False: a capture without masks starts from random points
    sweep_min_share: float = 0.1  # of initial_points: with fewer, the scene has too little texture for a plane sweep
    surface_opacity: float = 0.5  # of points on a surface that was found
    random_opacity: float = 0.1  # of random points, most of which are nowhere near a surface


@dataclass(frozen=True)
class VisualHullSettings:
    """Visual hull of the masks, and random points where there are no masks."""

    coarse_voxels: int = 64  # along each axis of the first pass
    misses_max: int = 0  # masks outside of which a voxel may lie
    seen_share: float = 0.5  # of the views must see a voxel
    random_depth_min: float = 0.25  # times the distance to where the optical axes meet
    random_depth_max: float = 3.0  # times that distance


@dataclass(frozen=True)
class PlaneSweepSettings:
    """Plane sweep."""

    width: int = 256  # pixels of the images that are compared
    planes: int = 96  # evenly in 1/depth
    near: float = 0.2  # times the distance to where the optical axes meet: first plane
    far: float = 4.0  # times that distance: last plane
    neighbours: int = 4  # cameras that a view is compared with
    scored_neighbours: int = 2  # best neighbours, whose mean is the score: the others may not see the surface
    axis_cosine_min: float = 0.5  # between optical axes of neighbours: 60 degrees
    lone_correlation_min: float = 0.75  # where only one view, from far aside, can be compared
    lone_window: int = 11  # pixels, `window` there: two views agree by chance more often than three
    sides_min: float = 8.0  # windows along the shorter side of such a picture
    unique_min: float = -1.0  # correlation minus that at any other depth; -1: it may be as high there
    lone_unique_min: float = 0.05  # the same for a view without near neighbours: patterns repeat
    other_depth: float = 0.1  # relative difference from which a depth is another one
    upright_planes: int = 6  # directions of upright planes, for a view without near neighbours
    slant_cosine_min: float = 0.15  # between a ray and the normal of a plane
    window: int = 7  # pixels, side of the correlated windows
    correlation_min: float = 0.6  # normalised; below it a depth is dropped
    depth_tolerance: float = 0.03  # relative difference of depth at which two views agree
    contrast_min: float = 2.0  # grey levels, standard deviation in a window: below it a window has no texture

    def of_lone_view(self) -> PlaneSweepSettings:
        """The settings for a view with fewer near neighbours than are scored: one neighbour from any side decides."""
        lone = {"window": self.lone_window, "correlation_min": self.lone_correlation_min}
        lone["unique_min"] = self.lone_unique_min
        return replace(self, axis_cosine_min=-1.0, scored_neighbours=1, **lone)


@dataclass(frozen=True)
class FarShellSettings:
    """Shell of far Gaussians around a scene without masks."""

    points: int = 500  # on the whole sphere; points that no view sees are dropped; 0: no shell
    distance: float = 4.0  # times the distance of the cameras to where their optical axes meet
    opacity: float = 0.95
    width: float = 1.5  # times that of a Gaussian at a point on a surface: they overlap without gaps
    thickness: float = 0.1  # times the width


@dataclass(frozen=True)
class SizeSettings:
    """Bound on the size of every Gaussian where there are no masks: Gaussians that no picture contradicts (black before
    black) would grow into the views between the cameras."""

    share: float = 0.1875  # largest scale over the distance from where the optical axes meet
    near: float = 0.4  # times the distance of the cameras from there: nearer Gaussians count as that far


@dataclass(frozen=True)
class CameraCalibrationSettings:
    """Colour (log gain and offset of each channel) and pose of each training camera, learned with a keyframe; the
    colour also in each frame of a group."""

    exposure_rate: float = 2e-2  # log gain
    offset_unit: float = 0.1  # of 0..1: offsets are learned more slowly than log gains by this factor
    exposure_weight: float = 0.02  # of half the square of both in the loss: shading looks like exposure, too
    frame_weight: float = 0.003  # of a frame's difference from the keyframe, in the loss
    frame_free: float = 0.01  # difference up to which that is quadratic: a Huber loss, so small errors stay below it
    pose_rate: float = 3e-3  # radians, radii
    refine_poses: bool | None = None  # None: if the error is above `pose_error_min`
    pose_error_min: float = 0.75  # pixels, median distance of features from their epipolar lines; good rigs have 0.25


@dataclass(frozen=True)
class BudgetSettings:
    """Budget of a keyframe (`budget.py`)."""

    points_share: float = 0.15  # initial points over the pixels of a picture that show the scene
    points_min: int = 4000
    points_max: int = 40_000
    pixels: float = 50_000.0  # pixels that show the scene, for which a preset's steps are meant
    small_pixels: float = 12_500.0  # half the side of `pixels`: below it a step costs hardly less
    steps_exponent: float = 0.5  # exponent of the pixels in the steps of larger pictures
    steps_most: float = 2.5  # times a preset's steps


@dataclass(frozen=True)
class KeyframeSettings:
    """Optimisation, densification and pruning of a keyframe (Kerbl et al. 2023, shortened).

    Attributes:
        price: share of the error that a Gaussian must remove: decibels for its bits, the same in every scene. Where N
            Gaussians are so few that the mean share 1 / N is larger, the price is 1 / N.
        gradient_unit: screen gradient, in halves of the image, from which a Gaussian is split or cloned if the price is
            1 / N; grows with the root of N times the price.
    """

    price: float = 5.3e-4
    gradient_unit: float = 1.06e-4
    rates: LearningRates = field(default_factory=keyframe_rates)
    means_rate_end: float = 1.6e-5  # radii, at the last step
    rate_decay: float = 0.3  # all other rates at the last step, times those at the first
    teachers: int = 2  # other models of the frame, whose pictures between the cameras it is trained on, too
    teacher_share: float = 1.0  # steps of a teacher, of those of the keyframe
    taught_views: int = 15  # training cameras up to which a capture with masks has teachers
    dropout: float = 0.4  # share of the Gaussians that the last step leaves out, where views are few
    appearance_from: float = 0.3  # share of the steps; poses and SH wait for colours that are about right
    gaussians_share: float = 0.8  # of gaussians_max; the rest is left for tracking
    full_size_from: float = 0.4  # share of the steps; before it pictures are smaller
    coarse_side: float = 192.0  # pixels, of the longer side of the first pictures
    densify_every: int = 50  # steps between rounds of densification or pruning, at least
    densify_share: float = 0.025  # of the steps, between such rounds
    densify_from: float = 0.1  # share of the steps
    densify_until: float = 0.6  # share of the steps
    thin_until: float = 0.8  # share of the steps; after it the image recovers from the removals
    growth: float = 0.12  # share of the Gaussians that one round may add
    thinning: float = 0.25  # share of the Gaussians that one round may remove for their small contribution
    mse_min: float = 1e-8  # mean squared error of an image below which shares of it have no meaning
    harmonics_gain_min: float = 0.02  # a coefficient of SH stays if the error grows by this share without it
    prune_opacity: float = 0.02  # a Gaussian below it is removed
    prune_weight: float = 0.02  # largest blending weight in any view; a Gaussian below it is hidden and removed
    opacity_decay: float = 0.0  # weight of the mean opacity in the loss, for Gaussians at the working distance
    near_power: float = 4.0  # exponent of the nearness of a Gaussian (`Views.nearness`) in that weight
    near_margin: float = 2.0  # width and height of the views in which a Gaussian counts, times those of the pictures
    position_noise: float = 0.0  # of its spread: first move of a transparent Gaussian, decays as the rate of the means
    split_shrink: float = 1.6  # by which the scales of a Gaussian are divided when it is split
    split_offset: float = 0.7  # of a random offset drawn from the Gaussian, for both halves
    clone_offset: float = 0.3  # of such an offset, for the copy

    def of_teacher(self, steps: int) -> int:
        """Steps of each teacher of a keyframe with `steps`."""
        return round(self.teacher_share * steps)

    def in_all(self, steps: int) -> int:
        """Steps of a keyframe with `steps` and of its teachers."""
        return steps + self.teachers * self.of_teacher(steps)
