"""Clauses 3 to 12 of gsv.md for the reference decoder: a sample -> Group, the decoded integers of all layers and tiles.

In: the payload of a sample, and the Group to which a predicted one refers. Out: the integers in the order of the
bitstream, and quats0 of clause 13.1. reference_integers.py decodes each unit or stream; survivors take their values
from the reference.
"""

from dataclasses import dataclass

import numpy as np
from reference_container import LEVELS, require
from reference_entropy import MAX_VALUE, Model, SymbolModel, ValueModel
from reference_evaluation import rotations
from reference_integers import (
    ancestors,
    class_nodes,
    class_trajectories,
    decode_channels,
    decode_deaths,
    decode_lifetimes,
    decode_positions,
    decode_rig,
    decode_trajectories,
    dense,
    find_neighbors,
    read_layer_correction,
)
from reference_units import (
    ATTRIBUTES,
    CHANNELS,
    DEATHS,
    JOINT_POSES,
    LAYER_CORRECTION,
    LIFETIMES,
    LOG_SCALES,
    LOGIT_OPACITIES,
    MEANS,
    NODE_POSITIONS,
    NODE_TRAJECTORIES,
    POSITIONS,
    RIG,
    TILE,
    TRAJECTORIES,
    Header,
    channel_count,
    check_limits,
    check_units,
    limit,
    read_group_header,
    read_header_bytes,
    read_units,
    split_tile,
)


@dataclass
class Rig:
    """Clauses 11.1 and 11.2, i32."""

    joints: np.ndarray  # [J, 3]
    parents: np.ndarray  # [J]
    bind: np.ndarray  # [J, 6]
    weights: np.ndarray  # [M, J]
    poses: np.ndarray  # [T, 6, J]


@dataclass
class Group:
    """A decoded group: the header and the integers (i32) of all layers, survivors included."""

    header: Header
    counts: list  # Gaussians of each decoded layer
    tiles: list  # (first, count) of each tile of each decoded layer; None: not decoded
    positions: np.ndarray  # [N, 3]
    channels: dict  # attribute -> [C, N]
    quats0: np.ndarray  # [N, 4] wxyz, from the channels of quats and log_scales (clause 13.1)
    lifetimes: np.ndarray | None  # [N, 2]
    node_positions: np.ndarray | None  # [M, 3]
    node_trajectories: np.ndarray | None  # [K, 6, M]
    trajectories: dict  # attribute -> [K, C, N]
    correction: dict  # attribute -> value, of the last decoded layer
    rig: Rig | None = None


def make_model(kind):
    if kind == CHANNELS:
        return SymbolModel()
    return (Model(), ValueModel()) if kind == TRAJECTORIES else Model()


def settled(model):
    return tuple(m.settled() for m in model) if isinstance(model, tuple) else model.settled()


def decode_tile(payload, tile, k, header, reference, models, spend):
    """Clauses 3.3, 8 to 10 and 12: one tile -> positions [n, 3], channels, quats0, lifetimes or None, trajectories.

    `reference`: for a tile of survivors, the reference Group and (first, count) of the tile in it. `models`: (kind,
    attribute) -> model; missing models are added, and each keeps its state at the end of its stream.
    """
    shifts, streams = header.shifts[k], split_tile(payload, tile, header)

    def model(kind, a=0):
        return models.setdefault((kind, a), make_model(kind))

    if tile.born:
        bits = header.grid_bits - shifts[MEANS]
        points = decode_positions(streams[POSITIONS, 0], tile.count, bits, "positions", model(POSITIONS))
        near = find_neighbors(points)
        positions = np.array(points, np.int32).reshape(tile.count, 3) << shifts[MEANS]
        channels = {}
        for a, (steps, _) in header.channels.items():
            what = f"channels of {ATTRIBUTES[a]}"
            q = decode_channels(streams[CHANNELS, a], a, len(steps), near, what, model(CHANNELS, a))
            q = np.array(q, np.int64).reshape(len(steps), tile.count) << shifts[a]
            require((abs(q) <= MAX_VALUE).all(), f"{what}: a value beyond {MAX_VALUE}")
            channels[a] = q.astype(np.int32)
        quats0 = rotations(header, channels, near)
    else:
        group, (first, count) = reference
        alive = list(range(count))
        if tile.candidates:
            theirs = group.positions[first : first + count].tolist()
            alive = decode_deaths(streams[DEATHS, 0], find_neighbors(theirs), tile.count, "deaths")
        alive = np.array(alive, int) + first
        positions, quats0 = group.positions[alive], group.quats0[alive]
        channels = {a: q[:, alive] for a, q in group.channels.items()}
    near = find_neighbors(positions.tolist())
    trajectories, lifetimes = {}, None
    for a, (K, _) in header.trajectories.items():
        C, what = channel_count(a, header.sh_degree), f"trajectories of {ATTRIBUTES[a]}"
        own = model(TRAJECTORIES, a)
        q = decode_trajectories(streams[TRAJECTORIES, a], K, C, near, class_trajectories, spend, what, own)
        trajectories[a] = dense(q, K, C)
    if header.lifetimes:
        q = decode_lifetimes(streams[LIFETIMES, 0], header.frames, near, "lifetimes", model(LIFETIMES))
        lifetimes = np.array(q, np.int32).reshape(tile.count, 2)
    return positions, channels, quats0, lifetimes, trajectories


def decode_layer(found, k, header, reference, spend):
    """Clause 7.4: the tiles of a layer, leading tiles first -> {index: result of decode_tile}."""
    layer, seeds, decoded = header.layers[k], {}, {}
    leading = layer.leading()
    for t in sorted(range(len(layer.tiles)), key=lambda t: (t not in leading, t)):
        tile, theirs = layer.tiles[t], None
        if not tile.born:
            theirs = reference.tiles[k][t]
        if (TILE, k, t) not in found or (not tile.born and theirs is None):
            continue
        models = {key: settled(seed) for key, seed in seeds.items()}
        decoded[t] = decode_tile(found[TILE, k, t], tile, k, header, (reference, theirs), models, spend)
        if t in leading:
            seeds = models | seeds
    return decoded


def empty_tile(header):
    """Result of decode_tile for 0 Gaussians."""
    channels = {a: np.zeros((len(steps), 0), np.int32) for a, (steps, _) in header.channels.items()}
    trajectories = {
        a: np.zeros((K, channel_count(a, header.sh_degree), 0), np.int32) for a, (K, _) in header.trajectories.items()
    }
    lifetimes = np.zeros((0, 2), np.int32) if header.lifetimes else None
    return np.zeros((0, 3), np.int32), channels, np.zeros((0, 4)), lifetimes, trajectories


def decode_group(payload, level, frames=None, reference=None, layers=256, tiles=None):
    """Clauses 3 to 12: a sample -> Group.

    `frames`: duration of the sample in the container, None without a container. `reference`: the Group to which a
    predicted one refers. `layers`: number of decoded layers. `tiles`: (layer, index) -> whether the tile is decoded;
    leading tiles always are.
    """
    limit(len(payload), LEVELS[level][4], "bytes", level)
    header = read_group_header(read_header_bytes(payload)[0], reference and reference.header)
    reference = reference if header.reference else None

    def wanted(k, t):
        return tiles is None or tiles(k, t) or t in header.layers[k].leading()

    budget = check_limits(header, level)
    units = read_units(payload, layers, wanted)
    wrong = f"group_header: frames is {header.frames}, but the sample lasts {frames}"
    require(frames is None or frames == header.frames, wrong)
    found = check_units(units, header, layers, wanted)
    parts, places, total = [empty_tile(header)], [], 0
    for k, layer in enumerate(header.layers[:layers]):
        decoded = decode_layer(found, k, header, reference, budget.spend)
        places.append([])
        for t, tile in enumerate(layer.tiles):
            lacking = t not in decoded and tile.count > 0
            count = len(decoded[t][0]) if t in decoded else 0
            places[-1].append(None if lacking else (total, count))
            total += count
            parts += [decoded[t]] if t in decoded else []
    counts = [sum(place[1] for place in own if place) for own in places]
    node_positions, node_trajectories, rig = None, None, None
    if header.node_count:
        nodes = decode_positions(
            found[NODE_POSITIONS, 0, 0], header.node_count, header.grid_bits, "node_positions", Model()
        )
        node_positions = np.array(nodes, np.int32)
        K, node_near = header.node_coefficients, find_neighbors(nodes)
        unit = found[NODE_TRAJECTORIES, 0, 0]
        q = decode_trajectories(unit, K, 6, node_near, class_nodes, lambda _: None, "node_trajectories")
        node_trajectories = dense(q, K, 6)
    if header.joint_count:
        parents, joints, bind, weights = decode_rig(found[RIG, 0, 0], header.joint_count, node_near, "rig")
        unit, T = found[JOINT_POSES, 0, 0], header.frames
        q = decode_trajectories(unit, T, 6, ancestors(parents), class_nodes, lambda _: None, "joint_poses")
        integers = (np.array(a, np.int32) for a in (joints, parents, bind, weights))
        rig = Rig(*integers, dense(q, T, 6))
    correction = {}
    for k in range(len(counts)):
        for a in (LOG_SCALES, LOGIT_OPACITIES):
            unit = found.get((LAYER_CORRECTION, k, a))
            value = 0.0 if unit is None else read_layer_correction(unit, "layer_correction")
            correction[a] = value  # of the last layer
    return Group(
        header,
        counts,
        places,
        np.concatenate([part[0] for part in parts]),
        {a: np.concatenate([part[1][a] for part in parts], 1) for a in header.channels},
        np.concatenate([part[2] for part in parts]),
        np.concatenate([part[3] for part in parts]) if header.lifetimes else None,
        node_positions,
        node_trajectories,
        {a: np.concatenate([part[4][a] for part in parts], 2) for a in header.trajectories},
        correction,
        rig,
    )
