"""Settings of tracking: change detection, deformation graph, frame fit, densification, relocalization, group ends."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ...render.optimizer import AdamSettings
from .learning_rates import LearningRates, keyframe_rates


@dataclass(frozen=True)
class ChangeDetectionSettings:
    """Pixels that have changed, and the Gaussians behind them."""

    width: int = 256  # pixels of the images that are compared; noise averages out
    threshold: float = 6.0  # grey levels, after a mean over 3 x 3: above the noise of sensors; -1: everything changes
    margin: float = 0.02  # of the width, around a change: parts without texture move with it
    seen_share: float = 0.5  # of the cameras that see a Gaussian must see a change there
    far: float = 2.0  # times the distance of the cameras from where their axes meet: farther Gaussians stand still


@dataclass(frozen=True)
class DeformationGraphSettings:
    """Nodes that carry the Gaussians."""

    nodes: int = 256
    still_share: float = 0.25  # of the nodes for Gaussians at rest, if these are as large a share of all
    blended: int = 4  # nodes that carry one Gaussian
    edges: int = 8  # neighbours of a node in the rigidity term
    edge_falloff: float = 1.5  # median edge lengths at which an edge counts half: long ones bridge gaps
    carrier_weight_min: float = 0.1  # blending weight from which a node counts as a carrier of a Gaussian
    lattice: float = 1e-3  # radii, spacing of the lattice on which neighbours and weights are computed
    added_nodes: int = 16  # for Gaussians that are added together
    extent_max: float = 2.0  # of the lattice of the stream along each axis, in extents of the keyframe
    places_max: int = 16  # places that are tried for new nodes to rest


@dataclass(frozen=True)
class MotionFieldSettings:
    """Hash grid and MLP that move the nodes (`motion_field.py`)."""

    tracking: bool = True  # a field of each frame beside the nodes' own variables
    finetune: bool = True  # a field of the whole group beside them
    levels: int = 5
    features: int = 4  # of each level
    log2_table: int = 12  # log2 of the entries of a level, at most
    coarsest: int = 2  # cells along an axis of the first level
    finest: int = 32  # cells of the last level: about the spacing of the nodes
    width: int = 32  # of the two hidden layers
    temporal_frequencies: int = 8  # cosines of the time in the group
    grid_rate: float = 4e-3
    mlp_rate: float = 4e-4
    searched_rates: float = 5.0  # times those, in a frame whose motion a search has found: it may still be far off

    def faster(self, times: float) -> MotionFieldSettings:
        """The same field with `times` the rates, except after a search."""
        rates = {"grid_rate": times * self.grid_rate, "mlp_rate": times * self.mlp_rate}
        return replace(self, **rates, searched_rates=self.searched_rates / times)


@dataclass(frozen=True)
class RoomSettings:
    """Changes for a capture without masks: objects move beside, or before, a large static background."""

    nodes: float = 2.5  # times those of a subject: many Gaussians that seem to move are background behind an object
    motion_steps: float = 0.5  # times those of a subject: fine-tuning gains more in nearly the same time
    finetune_steps: float = 3.0  # times those of a subject
    frequencies: float = 2.0  # times those of a subject: no search finds small fast objects
    rigidity: float = 1 / 3  # times that of a subject
    cut_ratio: float = 5 / 3  # times that of a subject, since few views of a room fit its keyframe far too well
    drift_ratio: float = 3.6  # times that of a subject, for the same reason
    price: float = 2.0  # of a Gaussian, times that of a subject: the few training views gain more by it than others
    opacity_decay: float = 0.003  # of a keyframe: no mask removes floaters before the cameras
    position_noise: float = 3.0  # of a keyframe, for the same reason
    teacher_share: float = 0.5  # times that of a subject: a keyframe has more steps, and its teachers need no detail
    field_in_tracking: bool = False  # it drags resting Gaussians along with moving ones beside them


@dataclass(frozen=True)
class TrackingSettings:
    """Optimisation of one frame from the one before: nodes and the Gaussians' own attributes together."""

    node_rotation_rate: float = 2e-2  # radians
    node_translation_rate: float = 3e-3  # radii
    node_adam: AdamSettings = field(default_factory=lambda: AdamSettings(eps=1e-8))
    # Light changes fast; place and shape are slow, so that the nodes take the motion.
    rates: LearningRates = field(
        default_factory=lambda: keyframe_rates().but(
            means=3e-5, quats=6e-4, log_scales=6e-3, logit_opacities=6e-2, sh0=5e-2, shN=2.5e-3
        )
    )
    rate_decay: float = 0.1  # rates at the last step of a round, times those at the first
    rounds_max: int = 4  # of motion_steps each, until the loss is near that of the frame before
    loss_ratio: float = 1.2  # times the loss of the frame before: near enough
    loss_floor: float = 0.001  # loss added to that bound
    progress_ratio: float = 0.9  # a round that leaves more of the loss than this is the last
    loss_window: int = 20  # steps whose mean is the loss of a round: about every view once
    small_scale: float = 0.5  # of the images in the first half of the first round: large motion, cheap steps
    usual_side: float = 512.0  # pixels of the longer side; larger images are made as small, by powers of 1/2
    searched_scale: float = 0.25  # of the images in the first of two stiff rounds after a search
    # First rounds, if the velocity is unknown or from a search: stiff nodes and slow attributes. Otherwise Gaussians
    # that have moved far take the colours of the surface that they cover.
    stiff_rigidity: float = 8.0  # times `rigidity`
    slow_rates: float = 0.1  # times `rates`, where the velocity is not known
    searched_slow_rates: float = 0.03  # the same, after a search
    mask_factor: float = 3.0  # times mask_lambda: the silhouette does not depend on light
    gradient_quantile: float = 0.995  # of the screen gradients in a keyframe: the reference for densification
    stored_factor: int = 2  # times gaussians_max: all Gaussians of a group, with removed ones
    separate_distance: float = 4.0  # spacings of new Gaussians; farther from all others they get their own nodes
    separate_min: int = 8  # new Gaussians that are worth nodes of their own
    visible_weight: float = 0.05  # blending weight from which a camera sees a Gaussian
    # A node begins to coast, as all its neighbours do, if the mean blending weight of what it and they carry is a small
    # share of the largest that it has had.
    leaving_share: float = 0.6  # largest share where they are now; a node that coasts does so up to this share
    hidden_share: float = 0.15  # largest share where their velocity leads them


@dataclass(frozen=True)
class MotionSearchSettings:
    """Search for a subject that has moved out of reach of the gradient (`motion_search.py`)."""

    side: float = 64.0  # pixels, of the longer side of the pictures that are compared
    views: int = 8  # as far apart as possible
    ratio: float = 2.0  # loss at constant velocity over that of the frame before, from which there is a search
    jump_ratio: float = 6.0  # the same, from which a motion is a jump that ends the group
    turn: float = 0.6  # radians, rotation of the starts
    steps: int = 25  # from each start
    rate: float = 0.05  # radians, radii
    rate_decay: float = 0.1  # rate at the last step, times that at the first
    parts: int = 8  # rigid bodies of the second search
    reach: float = 4.0  # times the median distance of moving Gaussians from their middle: farther is background
    gain: float = 0.9  # a motion is taken if its loss is this share of the best one so far
    limb_ratio: float = 2.0  # times the loss of the frame before, from which limbs are searched for
    limb_rounds: int = 2  # of that search, each with cells of its own
    cells: int = 24  # small parts, of which the lost ones make the limbs
    link: float = 1.3  # spacings of the Gaussians within which lost cells are of one limb
    limbs_max: int = 4  # in one round
    directions: int = 48  # to which a limb is turned
    limb_turn: float = 2.0  # radians, of the farthest direction
    limb_starts: int = 4  # directions from which the gradient goes on
    gain_min: float = 0.45  # times the loss of the frame before: fall of the loss that a search must reach


@dataclass(frozen=True)
class DensificationSettings:
    """Gaussians that a tracked frame adds."""

    max_share: float = 0.1  # of the Gaussians, in one frame; 0: none is added
    spawn_min: int = 8  # fewer are not worth a unit in the stream
    steps: int = 100  # optimisation steps of the new Gaussians among the others
    gradient_min: float = 2.0  # screen gradient of a parent, times that of the keyframe
    child_opacity: float = 0.3
    error_min: float = 40.0  # grey levels: the Gaussians do not show this pixel at all
    opening: int = 3  # pixels at the size of change detection: edges are thinner than missing parts
    error_share_min: float = 0.001  # of the image in half of the views; an error in fewer views is a highlight


@dataclass(frozen=True)
class RelocalizationSettings:
    """Search for Gaussians that have moved out of reach of the gradient."""

    error_ratio: float = 1.002  # times the error without them; hidden Gaussians cause no error, and are not lost
    points: int = 1000  # of the plane sweep at most
    places: int = 8  # centres that are tried
    mean_shift_rounds: int = 5
    radius_quantile: float = 0.9  # of the distances from their centre: radius of the mean shift


@dataclass(frozen=True)
class GroupSettings:
    """Where a group ends early."""

    drift_ratio: float = 2.3  # image loss over the keyframe's, from which there is a new keyframe
    drift_steps: int = 1200  # of a keyframe, for which that ratio is meant: with more it fits its own pictures better
    drift_exponent: float = 0.75  # of the steps of a keyframe, in that ratio
    drift_share: float = 0.25  # frames left, over those that the keyframe has lasted, from which a drift gets a new one
    cut_loss_floor: float = 0.002  # loss added to both bounds: clean images fit far better than needed, no cut for it
    shown_ratio: float = 2.0  # pixels of the scene over the keyframe's, in half of the views: it lacks too much
    changed_fraction_max: float = 0.1  # of the Gaussians, that begin to change in one frame
    changed_frames_min: int = 4  # frames that a group has before `changed_fraction_max` or a jump may end it
