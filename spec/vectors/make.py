"""Conformance vectors: the list of cases, and the program that writes valid/, invalid/ and manifest.json from it.

    python spec/vectors/make.py

VALID and INVALID drive both this regenerator and tests/test_conformance.py. The hashes in the manifest (clause 16 of
gsv.md) are those of the reference decoder.
"""

import json
import struct
import sys
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
sys.path.insert(0, str(HERE.parent))
import reference_decoder as reference  # noqa: E402
from files import (  # noqa: E402
    CAMERA,
    PLACED,
    alternating,
    before_mdat,
    box,
    f32,
    groups_file,
    ignored_fields,
    major_brand_only,
    make_file,
    many_tracks,
    no_mdat,
    other_mdat_sizes,
    other_track,
    scene_file,
    second_moof,
    second_trun,
    sound_file,
    sound_patched,
    tracks_patched,
    truncated,
    truncated_after_sample,
    truncated_to_end,
    two_tracks,
    u32,
    unknown_boxes,
)
from groups import (  # noqa: E402
    coarser,
    companded,
    duplicates,
    encode,
    extremes,
    layered,
    make_group,
    predicted,
    rigged,
    tied_nodes,
    tiled,
)
from units import (  # noqa: E402
    HEADER,
    TILE,
    add_unknown_units,
    change_predicted,
    change_stream,
    change_tile,
    change_unit,
    change_unit_of_predicted,
    find_unit,
    header,
    insert,
    layers_file,
    other_deaths,
    other_top,
    pack_header,
    patched,
    payload_file,
    poke_duration,
    poke_time,
    predicted_file,
    remove_unit,
    rig_unit,
    rigged_file,
    traj,
    unit_dict,
    units_file,
)

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

WEIGHT_OF_MINUS_5 = (
    "003ffffffa45729ac39a60504848b82d6946f5638a611e5dd76e86ec8c7e4a9e226b5b9443a7dfde35e1b86916"
    "62c043b14ac18959c5381b46c5db2e00e3e0867444cc3c48c85f48bd12084e2c19ced2006bdc0e9bf36dc5f48a"
    "92f3187f2ed13ae17ea947ae0935bee1f6cdb1c675c1c3f2d32d2662354820823cfde6f1c26b30f90ec7"
)

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
        "sh_degree 2, SH turn",
        lambda: groups_file(make_group(80, 2, sh_degree=2, nodes=4), sh_degree=2, sh_frame="body"),
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

NAN, INF = float("nan"), float("inf")
B, L = "BitstreamError", "LimitError"

INVALID = {  # name: (error, part of the message of both decoders, bytes)
    # Container
    "container_empty": (B, "moov", lambda: b""),
    "container_text": (B, "ftyp", lambda: b"This is not a volumetric video, it only has a friendly name.\n"),
    "container_magic": (B, "ftyp", other_top(lambda p: [(b"ftyp", box(b"ftyp", b"isom\0\0\0\0isommp42")), *p[1:]])),
    "container_no_moov": (B, "moov", other_top(lambda p: p[:1])),
    "container_no_ftyp": (B, "ftyp", other_top(lambda p: p[1:])),
    "container_handler": (B, "volv", patched(b"hdlr", 8, b"vide")),
    "container_entry": (B, "gsv1", patched(b"stsd", 12, b"avc1")),
    "container_no_config": (B, "gsvC", patched(b"gsvC", -4, b"none")),
    "container_small_box": (B, "size", patched(b"moof", -8, u32(4))),
    "container_zero_size": (B, "size", patched(b"moof", -8, u32(0))),
    "container_huge_header_box": (L, "moof", patched(b"moof", -8, u32(2**24 + 9))),
    "container_nested_size": (B, "bytes", patched(b"traf", -8, u32(10**6))),
    "container_two_samples": (B, "sample", patched(b"trun", 4, u32(2))),
    "container_second_trun": (B, "trun", lambda: second_trun(groups_file(make_group(30, 2), finish=False), 0)),
    "container_outside_mdat": (B, "mdat", patched(b"trun", 8, u32(4))),
    "container_no_mdat": (B, "mdat", no_mdat),
    "container_second_moov": (B, "moov", other_top(lambda p: [*p[:2], *p[1:]])),
    "container_second_moof": (B, "mdat", second_moof),
    "container_timescale": (B, "timescale", patched(b"mdhd", 12, u32(0))),
    "container_sample_size": (B, "mdat", patched(b"trun", 16, u32(2**24))),
    "container_no_frames": (B, "duration", patched(b"trun", 12, u32(0))),
    "config_version": (B, "version", patched(b"gsvC", 0, b"\1")),
    "config_level_0": (L, "level", patched(b"gsvC", 1, b"\0")),
    "config_level_5": (L, "level", patched(b"gsvC", 1, b"\5")),
    "config_frame_duration": (B, "frame_duration", patched(b"gsvC", 2, u32(0))),
    "config_metres_nan": (B, "metres_per_unit", patched(b"gsvC", 6, f32(NAN))),
    "config_metres_0": (B, "metres_per_unit", patched(b"gsvC", 6, f32(0))),
    "config_up_axis": (B, "up_axis", patched(b"gsvC", 10, b"\6")),
    "config_color_space": (B, "color_space", patched(b"gsvC", 11, b"\1")),
    "config_background": (B, "background", patched(b"gsvC", 12, f32(1.5))),
    "config_sh_degree": (B, "sh_degree", patched(b"gsvC", 24, b"\4")),
    "config_sh_frame": (B, "sh_frame", patched(b"gsvC", 25, b"\2")),
    "config_camera_count": (B, "63 more", patched(b"gsvC", 26, b"\xff\xff")),
    "config_camera_name": (B, "camera name", patched(b"gsvC", 29, b"\xff\xff")),
    "config_camera_width": (B, "pixel", patched(b"gsvC", 29 + len(CAMERA["name"].encode()), u32(0))),
    "config_camera_near": (B, "near", patched(b"gsvC", 29 + len(CAMERA["name"].encode()) + 76, f32(0))),
    "config_camera_nan": (B, "finite", patched(b"gsvC", 37 + len(CAMERA["name"].encode()), f32(NAN))),
    "config_sh_degree_low": (B, "degree", lambda: groups_file(make_group(40, 2, sh_degree=1), sh_degree=0)),
    "duration_no_frames": (B, "duration", lambda: poke_duration(1001, 1000)),
    "time_no_frames": (B, "time", lambda: poke_time(1001, 500)),
    "sound_timescale": (B, "timescale", sound_patched(b"mdhd", 12, u32(0))),
    "sound_no_decoder": (B, "dOps", lambda: sound_file(decoder=b"esds", finish=False)),
    "sound_entry": (L, "4096", lambda: sound_file(entry=box(b"free", bytes(4096)), finish=False)),
    "sound_edits": (B, "one edit", sound_patched(b"elst", 4, u32(2), 0)),
    "sound_edit_empty": (B, "one edit", sound_patched(b"elst", 12, u32(2**32 - 1), 0)),
    "sound_many_samples": (L, "65536", sound_patched(b"trun", 4, u32(65537))),
    "sound_samples_missing": (B, "4 more", sound_patched(b"trun", 4, u32(4))),
    "sound_second_trun": (B, "trun", lambda: second_trun(sound_file(finish=False), 0)),
    "sound_sample_empty": (B, "at least one byte", sound_patched(b"trun", 16, u32(0))),
    "sound_elsewhere": (B, "where the group starts", sound_patched(b"trun", 8, u32(4))),
    "sound_too_long": (B, "where the group starts", sound_patched(b"trun", 16, u32(2**32 - 1))),
    "sound_outside_mdat": (B, "mdat", before_mdat),
    "tracks_many": (L, "65 tracks", many_tracks),
    "tracks_same_id": (B, "track_ID", tracks_patched(12, u32(1), b"tkhd", 1)),
    "track_name": (B, "track names in UTF-8", tracks_patched(2, b"\xff")),
    "track_name_long": (B, "more", tracks_patched(1, b"\xff")),
    "track_keys_missing": (B, "more", tracks_patched(2 + 9 + 8, b"\0\3")),
    "track_keys_order": (B, "order of their times", tracks_patched(2 + 9 + 10 + 36, struct.pack(">i", -300))),
    "track_rotation_nan": (B, "finite", tracks_patched(2 + 9 + 14, f32(NAN))),
    "track_rotation_long": (B, "squared length", tracks_patched(2 + 9 + 14, f32(1.01))),
    "track_translation": (B, "translation", tracks_patched(2 + 9 + 30, f32(INF))),
    "track_scale_0": (B, "scale", tracks_patched(2 + 9 + 42, f32(0))),
    # Units
    "unit_none": (B, "4 more", lambda: payload_file(lambda p: b"")),
    "unit_crc": (B, "CRC", change_unit(TILE, damage=1)),
    "unit_payload_damaged": (B, "CRC", lambda: payload_file(lambda p: p[:-1] + bytes([p[-1] ^ 64]))),
    "unit_header_crc": (B, "CRC", change_unit(0, damage=1 << 31)),
    "unit_truncated": (B, "unit 3", lambda: payload_file(lambda p: p[:-1])),
    "unit_left_over": (B, "end of the group", lambda: payload_file(lambda p: p + b"\0")),
    "unit_size": (B, "4294967295 more", change_unit(3, size=2**32 - 1)),
    "unit_header_length": (B, "4294967295 more", lambda: payload_file(lambda p: b"\xff" * 4 + p[4:])),
    "unit_header_twice": (B, "group_header", insert(unit_dict(0))),
    "unit_twice": (B, "one unit of each", lambda: units_file(lambda u: u.append(dict(find_unit(u, 2))))),
    "unit_tile_twice": (B, "one unit of each", lambda: units_file(lambda u: u.append(dict(find_unit(u, TILE))))),
    "unit_layer_order": (B, "layers", insert(unit_dict(200, layer=2), unit_dict(201, layer=1))),
    "unit_layer_unannounced": (B, "announces", insert(unit_dict(TILE, layer=1))),
    "unit_tile_unannounced": (B, "announces", insert(unit_dict(TILE, index=1))),
    "unit_unannounced_nodes": (B, "announces", header(flags=16, node_count=0)),
    "unit_no_tile": (B, "tile 0", remove_unit(TILE)),
    "unit_no_nodes": (B, "node_positions", remove_unit(2)),
    "unit_no_node_trajectories": (B, "node_trajectories", remove_unit(3)),
    "unit_node_index": (B, "index of 0", change_unit(2, index=1)),
    "unit_rig_unannounced": (B, "announces", insert(unit_dict(5))),
    "unit_no_rig": (B, "a unit rig", lambda: rigged_file(lambda u: u.remove(find_unit(u, 5)))),
    "unit_no_joint_poses": (B, "a unit joint_poses", lambda: rigged_file(lambda u: u.remove(find_unit(u, 6)))),
    "unit_rig_index": (B, "index of 0", rig_unit(5, index=1)),
    "unit_joint_poses_twice": (
        B,
        "one unit of each",
        lambda: rigged_file(lambda u: u.append(dict(find_unit(u, 6)))),
    ),
    "unit_layer_correction_attribute": (B, "layer_correction", insert(unit_dict(4, index=3, payload=f32(1)))),
    "unit_layer_correction_nan": (B, "finite", insert(unit_dict(4, index=4, payload=f32(NAN)))),
    "unit_layer_correction_long": (B, "layer_correction", insert(unit_dict(4, index=4, payload=f32(1) + b"\0"))),
    "unit_directory_cut": (B, "4 more", change_unit(0, payload=b"\0\4\0")),
    # Tiles
    "tile_empty": (B, "size of a stream", change_tile(lambda p: b"")),
    "tile_size_long": (B, "at most 5 bytes", change_tile(lambda p: b"\x80" * 5 + p)),
    "tile_size": (B, "more bytes of a stream", change_tile(lambda p: b"\x83\xff\x7f" + p[1:])),
    "tile_cut": (B, "tile", change_tile(lambda p: p[:12])),
    "tile_left_over": (
        B,
        "end of the tile",
        lambda: predicted_file(
            TILED,
            replace(predicted(TILED, MANY, deaths=lambda i: False, births=0), trajectories={}, lifetimes=None),
            edit=lambda units: find_unit(units, TILE).update(payload=b"\0"),
        ),
    ),
    # Group header
    "predicted_first": (B, "before it", lambda: make_file([(encode(UNCHANGED, encode(REFERENCE)), 6, False)])),
    "predicted_sync": (B, "sync", lambda: predicted_file(REFERENCE, UNCHANGED, sync=True)),
    "predicted_from_predicted": (
        B,
        "independent group",
        lambda: predicted_file(REFERENCE, UNCHANGED, UNCHANGED),
    ),
    "predicted_reference_0": (B, "reference", change_predicted(lambda h: h[:3] + b"\0\0" + h[5:])),
    "predicted_layer_count": (B, "layers", change_predicted(lambda h: h[:5] + b"\2" + h[6:])),
    "predicted_many_births": (B, "births", change_predicted(lambda h: h[:10] + u32(10**6) + h[14:])),
    "predicted_many_survivors": (B, "survivors", change_predicted(lambda h: h[:6] + u32(250) + u32(0) + h[14:])),
    "predicted_few_survivors": (
        B,
        "more survivors",
        change_predicted(lambda h: h[:-25] + bytes([h[-25] - 1]) + h[-24:]),
    ),
    "predicted_tile_survivors": (B, "at most", change_predicted(lambda h: h[:-25] + bytes([h[-25] + 1]) + h[-24:])),
    "predicted_deaths_count": (B, "survivors", change_unit_of_predicted(TILE, 0, other_deaths)),
    "predicted_no_births": (B, "tile 1", change_unit_of_predicted(TILE, 1, lambda units, u: units.remove(u))),
    "layer_no_tile": (B, "tile 0 of layer 1", lambda: layers_file(lambda u: u.remove(find_unit(u, TILE, 0, 1)))),
    "layer_unannounced": (B, "announces", lambda: layers_file(lambda u: u.append(unit_dict(TILE, layer=3)))),
    "header_companding_width": (
        B,
        "width",
        header(flags=2, companding=[(0.0, 0.1), (0.0, 0.0), (0.0, 0.1), (0.0, 0.1)]),
    ),
    "header_companding_low": (B, "low", header(flags=2, companding=[(0.0, 0.1), (0.0, 0.1), (0.0, 0.1), (INF, 0.1)])),
    "header_companding_cut": (B, "8 more", header(flags=2, bounds=())),
    "predicted_companding": (B, "flags", change_predicted(lambda h: h[:2] + bytes([h[2] | 2]) + h[3:])),
    "header_flags": (B, "flags", header(flags=64)),
    "header_flag_of_draft_7": (B, "flags", header(flags=4)),
    "header_shift": (B, "shift", header(flags=8, shifts=[0, 16, 0, 0, 0])),
    "header_shift_positions": (B, "shift", header(flags=8, shifts=[HEADER["grid_bits"], 0, 0, 0, 0])),
    "predicted_shifts": (B, "flags", change_predicted(lambda h: h[:2] + bytes([h[2] | 8]) + h[3:])),
    "header_layers": (B, "layers", header(layer_count=17, layer_counts=[40] * 17)),
    "header_layers_missing": (B, "tile 0 of layer 1", header(flags=16, layer_count=2, layer_counts=[40, 40])),
    "header_no_layers": (B, "layer", header(layer_count=0, layer_counts=[])),
    "header_frames_0": (B, "frames", header(frames=0)),
    "header_frames_mismatch": (B, "frames", lambda: units_file(lambda u: None, frames=5)),
    "header_origin_nan": (B, "origin", header(origin=(0.0, NAN, 0.0))),
    "header_grid_step_0": (B, "grid_step", header(grid_step=0.0)),
    "header_grid_step_negative": (B, "grid_step", header(grid_step=-0.1)),
    "header_grid_bits_0": (B, "grid_bits", header(grid_bits=0)),
    "header_grid_bits_22": (B, "grid_bits", header(grid_bits=22)),
    "header_sh_degree": (B, "sh_degree", header(sh_degree=4)),
    "header_tile_side_small": (B, "tile_side_log2", header(tile_side_log2=3)),
    "header_tile_side_large": (B, "tile_side_log2", header(tile_side_log2=8)),
    "header_bounds": (B, "bounds", header(bounds=(0, 9, 0, 255, 8, 256))),
    "header_bounds_cut": (B, "2 more", header(layer_counts=[40], bounds=(0,) * 5)),
    "header_attribute_count": (B, "attributes", header(channels=HEADER["channels"][:3])),
    "header_attribute_order": (B, "attribute", header(channels=[HEADER["channels"][i] for i in (1, 0, 2, 3)])),
    "header_step_nan": (B, "step", header(channels=[(2, [(NAN, 0.0)] * 3), *HEADER["channels"][1:]])),
    "header_step_0": (B, "step", header(channels=[(2, [(0.0, 0.0)] * 3), *HEADER["channels"][1:]])),
    "header_offset_infinite": (B, "offset", header(channels=[(2, [(0.1, INF)] * 3), *HEADER["channels"][1:]])),
    "header_trajectory_order": (B, "attribute", traj((5, 2, 0.1), (1, 2, 0.1))),
    "header_trajectory_twice": (B, "attribute", traj((1, 2, 0.1), (1, 2, 0.1))),
    "header_trajectory_none": (B, "attribute", traj((0, 2, 0.1))),
    "header_trajectory_shn": (B, "attribute", traj((1, 2, 0.1), (6, 2, 0.1))),
    "header_trajectory_attribute": (B, "attribute", traj((1, 2, 0.1), (7, 2, 0.1))),
    "header_coefficients_0": (B, "coefficients", traj((1, 0, 0.1))),
    "header_coefficients_many": (B, "coefficients", traj((1, 5, 0.1))),
    "header_trajectory_step": (B, "step", traj((1, 2, -INF))),
    "header_neighbors_0": (B, "neighbors", header(neighbors=0)),
    "header_neighbors_9": (B, "neighbors", header(neighbors=9)),
    "header_node_coefficients": (B, "coefficients", header(coefficients=5)),
    "header_rotation_step": (B, "rotation_step", header(rotation_step=0.0)),
    "header_translation_step": (B, "translation_step", header(translation_step=NAN)),
    "header_rig_no_nodes": (B, "nodes in a group with a rig", header(flags=32, node_count=0)),
    "header_rig_no_joints": (B, "at least one joint", header(flags=32, rig=(0, 0.1, 0.1))),
    "header_rig_rotation_step": (B, "rotation_step of joints", header(flags=32, rig=(2, 0.0, 0.1))),
    "header_rig_translation_step": (B, "translation_step of joints", header(flags=32, rig=(2, 0.1, INF))),
    "header_truncated": (B, "2 more", change_unit(0, payload=pack_header()[:-1])),
    "header_left_over": (B, "group_header", change_unit(0, payload=pack_header() + b"\0")),
    # Limits
    "limit_gaussians": (L, "Gaussians", header(layer_counts=[65537])),
    "limit_gaussians_huge": (L, "Gaussians", header(layer_counts=[2**32 - 1])),
    "limit_frames": (L, "frames", header(frames=65, duration=65)),
    "limit_nodes": (L, "nodes", header(node_count=1025)),
    "limit_nodes_huge": (L, "nodes", header(node_count=2**32 - 1)),
    "limit_layers": (L, "Gaussians", header(layer_count=2, layer_counts=[40000, 40000])),
    "limit_pairs": (
        L,
        "pairs",
        lambda: units_file(
            lambda units: units[0].update(payload=pack_header(node_count=4096, layer_counts=[70000])), level=2
        ),
    ),
    # Entropy-coded payloads
    "payload_left_over": (B, "positions", change_stream("positions", lambda p: p + b"\1" * 8)),
    "payload_left_over_nodes": (
        B,
        "node_positions",
        lambda: units_file(lambda u: find_unit(u, 2).update(payload=find_unit(u, 2)["payload"] + b"\1" * 8)),
    ),
    "payload_short": (B, "positions", change_stream("positions", lambda p: p[: len(p) // 2])),
    "payload_empty": (B, "sh0", change_stream("sh0", lambda p: b"")),
    "payload_many_gaussians": (B, "positions", header(flags=16, layer_counts=[4096])),
    "payload_escape": (B, "sh0", change_stream("sh0", lambda p: b"\xef" + bytes(63))),
    "payload_value": (B, "sh0", change_stream("sh0", lambda p: b"\xee\x70" + bytes(62))),
    "payload_symbol": (B, "sh0", change_stream("sh0", lambda p: b"\xff\xff" + bytes(62))),
    "payload_rig_parent": (B, "values within", rig_unit(5, payload=b"\xff" * 40)),
    "payload_rig_weight": (B, "values within", rig_unit(5, payload=bytes.fromhex(WEIGHT_OF_MINUS_5))),
    "payload_rig_left_over": (
        B,
        "rig",
        lambda: rigged_file(lambda u: find_unit(u, 5).update(payload=find_unit(u, 5)["payload"] + b"\1" * 8)),
    ),
    "payload_joint_poses_short": (B, "joint_poses", rig_unit(6, payload=b"\x55" * 9)),
    "payload_lifetime": (B, "lifetimes", change_stream("lifetimes", lambda p: bytes.fromhex("342f5d0a5e4842"))),
}


# ---- Regenerator ----------------------------------------------------------------------------------------------------


def describe(data):
    """The manifest entry of a valid file, by the reference decoder; of a scene the tracks behind the first apart."""
    config, groups = reference.decode(data)
    others = [describe_track(reference.decode(data, k)[1]) for k in range(1, config.tracks)]
    facts = {"frames": sum(sample.frames for sample, _ in groups), "groups": describe_track(groups)}
    return facts | ({"tracks": others} if others else {})


def describe_track(groups):
    return [
        {
            "start_frame": sample.start_frame,
            "frames": sample.frames,
            "sync": sample.sync,
            "gaussians": len(group.positions),
            "sha256": reference.group_hash(group),
        }
        for sample, group in groups
    ]


def main():
    manifest, files = {"valid": [], "invalid": []}, {}
    for name, (about, build) in VALID.items():
        file = f"valid/{name}.gsv"
        files[file] = build()
        manifest["valid"].append({"file": file, "about": about} | describe(files[file]))
    for name, (error, reason, build) in INVALID.items():
        file = f"invalid/{name}.gsv"
        files[file] = build()
        manifest["invalid"].append({"file": file, "error": error, "reason": reason})
    for old in HERE.glob("*valid/*.gsv"):
        old.unlink()
    for file, data in files.items():
        (HERE / file).parent.mkdir(exist_ok=True)
        (HERE / file).write_bytes(data)
    (HERE / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n")
    print(f"{len(VALID)} valid, {len(INVALID)} invalid")


if __name__ == "__main__":
    main()
