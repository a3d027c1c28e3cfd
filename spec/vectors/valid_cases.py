"""The valid conformance vectors: of each its name, what it is about, and the bytes.

In: groups made by groups.py. Out: VALID; a case makes its file when it is called.
"""

from dataclasses import replace

from files import (
    CAMERA,
    PLACED,
    alternating,
    groups_file,
    ignored_fields,
    major_brand_only,
    other_mdat_sizes,
    other_track,
    scene_file,
    sound_file,
    truncated,
    truncated_after_sample,
    truncated_to_end,
    two_tracks,
    unknown_boxes,
)
from groups import (
    coarser,
    companded,
    duplicates,
    extremes,
    layered,
    make_group,
    predicted,
    rigged,
    tied_nodes,
    tiled,
)
from units import add_unknown_units, predicted_file, units_file

MOTION = {"nodes": 12, "trajectories": {"means": 4, "quats": 3, "logit_opacities": 2, "sh0": 20}}

REFERENCE = make_group(120, 4, nodes=5, trajectories={"means": 2, "sh0": 2}, lifetimes=True)
FULL = make_group(160, 6, seed=4, nodes=8, trajectories={"means": 3, "quats": 6, "sh0": 1}, lifetimes=True)
TILED = tiled(make_group(1100, 3, seed=8, nodes=4, trajectories={"means": 2, "sh0": 1}, lifetimes=True))
MANY = make_group(1100, 4, seed=9, nodes=4, trajectories={"means": 2, "quats": 2}, lifetimes=True)
TILED_LAYERS = layered(tiled(make_group(900, 2, seed=5, trajectories={"means": 2})), [[0, 1], [2]])
UNCHANGED = predicted(REFERENCE, FULL, deaths=lambda i: False, births=0)
SHIFTS = [[0, 0, 0, 0, 0], [1, 2, 3, 0, 4], [3, 15, 1, 2, 3]]
COMPANDED = companded(
    coarser(layered(make_group(90, 3, spread=40, trajectories={"log_scales": 2}), [[0], [1], [2]]), SHIFTS)
)
RIGGED = rigged(make_group(120, 7, seed=6, nodes=14, trajectories={"means": 2}))
WHOLE_RIG = make_group(90, 3, seed=7, nodes=5)
LAYERED = layered(make_group(100, 3, nodes=4, trajectories={"means": 2}), [[0], [1, 2], [3, 4, 5]])

VALID = {  # name: (what it is about, bytes)
    "single_frame": ("one group of one frame", lambda: groups_file(make_group(300, 1))),
    "motion": ("20 frames, nodes and trajectories", lambda: groups_file(make_group(250, 20, **MOTION))),
    "one_frame_motion": (
        "T = 1 with nodes, trajectories and lifetimes",
        lambda: groups_file(make_group(50, 1, nodes=5, trajectories={"means": 1, "log_scales": 1}, lifetimes=True)),
    ),
    "no_gaussians": ("N = 0", lambda: groups_file(make_group(0, 3))),
    "no_gaussians_all_units": (
        "N = 0 with nodes, trajectories and lifetimes",
        lambda: groups_file(make_group(0, 3, nodes=3, trajectories={"means": 2}, lifetimes=True)),
    ),
    "one_gaussian": ("N = 1, M = 1, finest grid", lambda: groups_file(make_group(1, 4, bits=21, nodes=1, neighbors=8))),
    "coarsest_grid": ("grid_bits = 1", lambda: groups_file(make_group(64, 2, bits=1, nodes=8))),
    "tiles": ("five tiles of 16 x 16, the last one partly filled", lambda: groups_file(TILED)),
    "tiles_predicted": (
        "a predicted group in tiles: one of the reference has died out, one has no deaths, births in two tiles",
        lambda: predicted_file(
            TILED, predicted(TILED, MANY, deaths=lambda i: i < 256 or (i >= 512 and i % 7 == 0), births=300)
        ),
    ),
    "tiles_layers": ("layers in tiles", lambda: groups_file(TILED_LAYERS)),
    "tiles_same": (
        "predicted groups in tiles without motion: tiles without streams",
        lambda: predicted_file(
            TILED,
            replace(
                predicted(TILED, MANY, deaths=lambda i: False, births=0), trajectories={}, lifetimes=None, nodes=None
            ),
        ),
    ),
    "duplicates": ("many Gaussians on one grid point", lambda: groups_file(duplicates())),
    "tied_nodes": ("nodes at equal distance and on one point", lambda: groups_file(tied_nodes())),
    "few_nodes": ("fewer nodes than neighbours", lambda: groups_file(make_group(40, 6, nodes=3, neighbors=8))),
    "sh_degree_1": ("sh_degree 1", lambda: groups_file(make_group(80, 2, sh_degree=1), sh_degree=1)),
    "sh_degree_2": (
        "sh_degree 2, harmonics that turn with the nodes",
        lambda: groups_file(replace(make_group(80, 2, sh_degree=2, nodes=4), turned_harmonics=True), sh_degree=2),
    ),
    "sh_degree_3": (
        "sh_degree 3 with trajectories of shN",
        lambda: groups_file(make_group(80, 8, sh_degree=3, trajectories={"shN": 2}), sh_degree=3),
    ),
    "lifetimes": ("cut lifetimes, T no power of two", lambda: groups_file(make_group(300, 37, lifetimes=True))),
    "most_frames": (
        "T = 64, all coefficients of every trajectory",
        lambda: groups_file(make_group(20, 64, nodes=6, trajectories={"means": 64, "log_scales": 64}, lifetimes=True)),
    ),
    "extremes": ("values of +-2^24, corners of the grid, extreme steps", lambda: groups_file(extremes())),
    "several_groups": (
        "groups of 5, 1 and 7 frames",
        lambda: groups_file(make_group(50, 5), make_group(60, 1, seed=2), make_group(70, 7, seed=3, nodes=4)),
    ),
    "frame_rate": (
        "29.97 frames per second",
        lambda: groups_file(make_group(30, 3), fps=(30000, 1001)),
    ),
    "cameras": (
        "reference cameras, other gsvC fields",
        lambda: groups_file(
            make_group(30, 2),
            cameras=[CAMERA, CAMERA | {"name": ""}],
            level=4,
            metres_per_unit=0.01,
            up="-z",
            background=[1.0, 0.5, 0.25],
        ),
    ),
    "unfinished": ("no sidx", lambda: groups_file(make_group(30, 2), make_group(30, 2, seed=2), finish=False)),
    "unknown_boxes": ("unknown boxes between all others", unknown_boxes),
    "other_mdat_sizes": ("mdat with largesize, and with size 0", other_mdat_sizes),
    "unknown_units": ("unknown unit types, also in later layers", lambda: units_file(add_unknown_units)),
    "truncated": ("the file ends in the second sample", truncated),
    "truncated_after_sample": ("the file ends in an mdat, after the sample", truncated_after_sample),
    "truncated_to_end": ("the sample of an mdat of size 0 ends after the file", truncated_to_end),
    "ignored_fields": ("reserved fields, minor_version and vvhd hold something else", ignored_fields),
    "other_track": ("an audio track, and all other ways to place and time a sample", other_track),
    "major_brand_only": ("gsv1 is the major brand, but no compatible one", major_brand_only),
    "predicted": (
        "a predicted group with deaths and births, nodes, trajectories, lifetimes",
        lambda: predicted_file(REFERENCE, predicted(REFERENCE, FULL)),
    ),
    "predicted_same": (
        "predicted groups without deaths and births, one of them two groups from its reference",
        lambda: predicted_file(REFERENCE, UNCHANGED, replace(UNCHANGED, reference=2)),
    ),
    "predicted_births_only": (
        "every Gaussian of the reference dies",
        lambda: predicted_file(REFERENCE, predicted(REFERENCE, FULL, deaths=lambda i: True)),
    ),
    "predicted_nothing_left": (
        "every Gaussian dies, none is born",
        lambda: predicted_file(REFERENCE, predicted(REFERENCE, FULL, deaths=lambda i: True, births=0)),
    ),
    "predicted_sh": (
        "a predicted group of sh_degree 2",
        lambda: predicted_file(
            make_group(60, 2, sh_degree=2),
            predicted(make_group(60, 2, sh_degree=2), make_group(90, 3, seed=5, sh_degree=2, trajectories={"shN": 2})),
            sh_degree=2,
        ),
    ),
    "layers": (
        "three layers with nodes, trajectories, lifetimes, of which the second is empty",
        lambda: groups_file(layered(FULL, [[0, 2], [], [1, 3, 4]])),
    ),
    "layer_corrections": (
        "corrections of opacity and scale; only that of the last layer counts",
        lambda: groups_file(layered(FULL, [[0], [1, 2]], [[0.5, 1.0], [0.25, -2.0]])),
    ),
    "layers_most": (
        "16 layers of few Gaussians",
        lambda: groups_file(layered(make_group(40, 2, trajectories={"means": 2}), [[k] for k in range(16)])),
    ),
    "layers_predicted": (
        "a predicted group with layers, births in each",
        lambda: predicted_file(LAYERED, predicted(LAYERED, FULL, births=4)),
    ),
    "layer_shifts": (
        "layers that leave out low bits",
        lambda: groups_file(coarser(layered(FULL, [[0, 2], [1], [3, 4]]), SHIFTS)),
    ),
    "companding": (
        "companding, with layers that leave out low bits and a trajectory on top, and a group predicted from it",
        lambda: predicted_file(COMPANDED, predicted(COMPANDED, FULL, births=0)),
    ),
    "rig": ("a rig of two roots, with nodes that it does not move", lambda: groups_file(RIGGED)),
    "rig_predicted": (
        "a rig of one joint, of one frame, and groups with and without a rig predicted from it",
        lambda: predicted_file(
            rigged(make_group(40, 1, nodes=3), joints=1),
            predicted(make_group(40, 1, nodes=3), rigged(make_group(50, 5, seed=3, nodes=6), joints=9)),
            predicted(make_group(40, 1, nodes=3), replace(WHOLE_RIG), back=2),
        ),
    ),
    "sound": ("an audio track of Opus, in the first of two groups", sound_file),
    "sound_aac": ("an audio track of AAC", lambda: sound_file(b"mp4a", b"esds", finish=False)),
    "sound_unknown": ("an audio track that is neither AAC nor Opus", lambda: sound_file(b"fLaC", b"dfLa")),
    "tracks": ("two tracks of other frame rates and degrees, one placed and played without end", two_tracks),
    "tracks_in_turn": (
        "the fragments of two tracks in turn, without an index",
        lambda: two_tracks(finish=False, change=alternating),
    ),
    "tracks_hidden": (
        "three tracks: a hidden one, one that ends before the last, one without groups",
        lambda: scene_file(
            ([make_group(30, 2)], {"placement": PLACED | {"hidden": True}}),
            ([make_group(20, 3, seed=2)], {"placement": PLACED | {"offset": 1, "repeats": 2}}),
            ([], {}),
        ),
    ),
    "track_named": (
        "one track with a name",
        lambda: scene_file(([make_group(30, 2)], {"placement": PLACED | {"offset": 2}})),
    ),
    "no_groups": ("a stream without groups yet", lambda: groups_file(finish=False)),
}
