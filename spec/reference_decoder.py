"""Reference decoder of the gsv bitstream: the second implementation, written from gsv.md alone and in its order.

In: the bytes of a .gsv file. Out: for each group the decoded integers, exactly, and any frame of it in float64.
It imports numpy and the standard library only, uses the names of gsv.md, and is written to be read, not to be fast:
entropy decoding works on Python integers, bin after bin. Strict: one damaged unit makes the group a BitstreamError.

    reference_container.py  clauses 1, 2      reference_units.py     clauses 3 to 5
    reference_entropy.py    clause 6          reference_integers.py  clauses 7 to 12
    reference_scene.py      clause 2.8

    python spec/reference_decoder.py FILE.gsv [--npz OUT.npz]     prints the conformance hash (clause 16) of each group
"""

import argparse
import hashlib
import struct
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reference_container import LEVELS, BitstreamError, LimitError, read_container, require
from reference_entropy import MAX_VALUE, Model, SymbolModel, ValueModel
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
    QUATS,
    RIG,
    SH0,
    SHN,
    TILE,
    TRAJECTORIES,
    Header,
    channel_count,
    check_limits,
    check_units,
    limit,
    read_group_header,
    read_header_bytes,
    read_reference,
    read_units,
    split_tile,
)

# ---- 3 to 12. Group -------------------------------------------------------------------------------------------------


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
    """A decoded group: the header and all of its integers, i32, of all layers and with survivors."""

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

    `reference`: its Group and the (first, count) of the tile there, of a tile of survivors. `models`: (kind, attribute)
    -> model, those that are missing are made and left as they are at the end of the stream.
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
    """Clause 7.4: the tiles of a layer, those that start others first -> {index: what decode_tile gives}."""
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
    """What decode_tile gives for no Gaussians."""
    channels = {a: np.zeros((len(steps), 0), np.int32) for a, (steps, _) in header.channels.items()}
    trajectories = {
        a: np.zeros((K, channel_count(a, header.sh_degree), 0), np.int32) for a, (K, _) in header.trajectories.items()
    }
    lifetimes = np.zeros((0, 2), np.int32) if header.lifetimes else None
    return np.zeros((0, 3), np.int32), channels, np.zeros((0, 4)), lifetimes, trajectories


def decode_group(payload, level, frames=None, reference=None, layers=256, tiles=None):
    """Clauses 3 to 12: a sample -> Group.

    `frames`: its duration in the container, if it comes out of one. `reference`: the Group to which a predicted one
    refers. `layers`: how many are decoded. `tiles`: (layer, index) -> whether the tile is; leading ones always are.
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


# ---- 13. Evaluation of frame t --------------------------------------------------------------------------------------


def basis(coefficients, frames, t):
    """Clause 13.1: [K], orthonormal DCT-II."""
    k = np.arange(coefficients)
    return np.sqrt(np.where(k == 0, 1, 2) / frames) * np.cos(np.pi * (2 * t + 1) * k / (2 * frames))


def node_weights(positions, nodes, k):
    """Clause 13.2, exact: neighbours [N, n] and their integer weights, before division by the sum, [N, n]."""
    n = min(k, len(nodes))
    indices = np.zeros((len(positions), n), np.int64)
    weights = np.ones((len(positions), n), np.int64)
    for i, g in enumerate(positions.astype(np.int64)):
        distances = ((nodes - g) ** 2).sum(1)
        order = np.argsort(distances, kind="stable")  # ties: the lower index first
        d = [int(distances[j]) for j in order[: k + 1]]
        D = d[k] if len(nodes) > k else 2 * d[n - 1]
        w = [((D - dj << 16) // D) ** 2 if D else 0 for dj in d[:n]]
        indices[i] = order[:n]
        weights[i] = w if any(w) else 1
    return indices, weights


def quaternion_product(a, b):
    """Hamilton product of [..., 4] wxyz."""
    w, x, y, z = np.moveaxis(a, -1, 0)
    W, X, Y, Z = np.moveaxis(b, -1, 0)
    product = (
        w * W - x * X - y * Y - z * Z,
        w * X + x * W + y * Z - z * Y,
        w * Y - x * Z + y * W + z * X,
        w * Z + x * Y - y * X + z * W,
    )
    return np.stack(product, -1)


def rotate(q, v):
    """Unit quaternions [..., 4] applied to vectors [..., 3]."""
    u = q[..., 1:]
    return v + 2 * np.cross(u, np.cross(u, v) + q[..., :1] * v)


def rotation(r):
    """Rotation vectors [..., 3] -> wxyz [..., 4]."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    axis = np.divide(r, angle, out=np.zeros_like(r), where=angle > 0)
    return np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], -1)


def average(q, weights, first):
    """Clause 13.3: quaternions [N, n, 4] blended by [N, n]; the signs are those nearer to q[first]."""
    before = np.take_along_axis(q, first[:, None, None], 1)
    sign = np.where((q * before).sum(-1) < 0, -1, 1)
    total = ((weights * sign)[..., None] * q).sum(1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length < 1e-12, before[:, 0], total / np.maximum(length, 1e-12))


def joint_motions(places, parents, poses):
    """Clause 13.3: G_j of poses [J, 6] as (quaternion, shift) of x -> R x + shift, for each joint."""
    motions = []
    for j, (g, parent, pose) in enumerate(zip(places, parents, poses, strict=True)):
        q = rotation(pose[:3])
        shift = g + pose[3:] - rotate(q, g)
        if parent < j:
            Q, S = motions[parent]
            q, shift = quaternion_product(Q, q), rotate(Q, shift) + S
        motions.append((q, shift))
    return motions


def predict_nodes(group, n, t):
    """Clause 13.3: nodes at n [M, 3] -> y [M, 3], p [M, 4]."""
    h, rig = group.header, group.rig
    steps = np.repeat([h.joint_rotation_step, h.joint_translation_step], 3)
    places = np.array(h.origin) + h.grid_step * rig.joints
    poses = steps * np.einsum("kcj,k->jc", rig.poses.astype(float), basis(h.frames, h.frames, t))
    now = joint_motions(places, rig.parents, poses)
    before = joint_motions(places, rig.parents, steps * rig.bind)
    y, turned = [], []  # by each joint alone
    for (q, s), (q0, s0) in zip(now, before, strict=True):
        back = q0 * [1, -1, -1, -1]
        turned.append(quaternion_product(q, back))
        y.append(rotate(q, rotate(back, n - s0)) + s)
    y, turned = np.stack(y, 1), np.tile(np.array(turned), (len(n), 1, 1))
    moved = rig.weights.any(1)
    w = rig.weights / np.maximum(rig.weights.sum(1, keepdims=True), 1)
    p = average(turned, w, rig.weights.argmax(1))
    still = np.array([1.0, 0, 0, 0])
    return np.where(moved[:, None], (w[..., None] * y).sum(1), n), np.where(moved[:, None], p, still)


def blend_nodes(group, x0, t):
    """Clause 13.3: [N, 3] -> x_blend [N, 3], q_blend [N, 4]."""
    h = group.header
    b = basis(h.node_coefficients, h.frames, t)
    motion = np.einsum("kcm,k->mc", group.node_trajectories.astype(float), b)  # [M, 6]
    r, translation = h.rotation_step * motion[:, :3], h.translation_step * motion[:, 3:]
    q = rotation(r)  # [M, 4]
    n = np.array(h.origin) + h.grid_step * group.node_positions
    if group.rig is not None:
        y, p = predict_nodes(group, n, t)
        q, translation = quaternion_product(p, q), y - n + rotate(p, translation)
    j, w = node_weights(group.positions, group.node_positions.astype(np.int64), h.neighbors)
    weight = w / w.sum(1, keepdims=True)  # [N, n]
    x = (weight[..., None] * (rotate(q[j], x0[:, None] - n[j]) + n[j] + translation[j])).sum(1)
    return x, average(q[j], weight, np.zeros(len(j), int))


def expand(v, low, width, slopes):
    """Clause 13.1: [N] coded values of a companded channel -> values."""
    rise = 2.0 ** (np.array(slopes) / 16)
    before = np.concatenate([[0], rise.cumsum()])
    j = np.clip(np.floor((v - low) / width), 0, 7).astype(int)
    return low + width * before[j] + rise[j] * (v - low - j * width)


def canonical(header, attribute, integers):
    """Clause 13.1: integers [C, N] -> a0 [N, C], without the correction."""
    steps, offsets = header.channels[attribute]
    values = np.array(offsets) + np.array(steps) * integers.T
    if attribute in header.companding:
        values = np.stack(
            [expand(v, *table) for v, table in zip(values.T, header.companding[attribute], strict=True)], 1
        )
    return values


def rotations(header, channels, near):
    """Clause 13.1: quats0 [N, 4] of the births of a layer; `near`: the neighbours of each."""
    steps, offsets = (np.array(v) for v in header.channels[QUATS])
    octaves = -canonical(header, LOG_SCALES, channels[LOG_SCALES]) @ np.array(header.scale_exponents).T
    own_steps = np.minimum(1, steps * 2.0 ** np.clip(octaves, -64, 64))
    v = np.clip(offsets + own_steps * channels[QUATS].T, -1, 1)
    residuals = None
    for c in (2, 1, 0):
        one = np.zeros((len(v), 4))
        one[:, 0], one[:, 1 + c] = np.sqrt(1 - v[:, c] ** 2), v[:, c]
        residuals = one if residuals is None else quaternion_product(residuals, one)
    quats0 = np.zeros((len(v), 4))
    for i in range(len(v)):
        known = near[i] and near[i][0] >= 512 * (i // 512)
        before = quats0[near[i][0]] if known else np.array([1.0, 0, 0, 0])
        quats0[i] = quaternion_product(before, residuals[i])
    return quats0


def unit(v):
    """Clause 13.4: [N, 3] -> wxyz [N, 4]."""
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (v * v).sum(-1, keepdims=True))), v], -1)


def rgb(v):
    """Clause 13.5: [..., 3] Y, Co, Cg -> R, G, B."""
    Y, Co, Cg = np.moveaxis(v, -1, 0)
    return np.stack([Y + Co - Cg, Y + Cg, Y - Co - Cg], -1)


def evaluate(group, t):
    """Clause 13: frame t in float64: all Gaussians, and a mask of those that are shown.

    means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], logit_opacities [N], sh0 [N, 3] and shN [N, K, 3] RGB,
    shown [N] bool.
    """
    h = group.header
    count = len(group.positions)
    x0 = np.array(h.origin) + h.grid_step * group.positions

    def rest(a):  # [N, C]
        return canonical(h, a, group.channels[a]) + group.correction.get(a, 0.0)

    def delta(a):  # [N, C]
        if a not in h.trajectories:
            return np.zeros((count, channel_count(a, h.sh_degree)))
        K, step = h.trajectories[a]
        return step * np.einsum("kcn,k->nc", group.trajectories[a].astype(float), basis(K, h.frames, t))

    x, q = blend_nodes(group, x0, t) if h.node_count else (x0, np.tile([1.0, 0, 0, 0], (count, 1)))
    quats = quaternion_product(quaternion_product(unit(delta(QUATS)), q), group.quats0)
    frame = {
        "means": x + delta(MEANS),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": rest(LOG_SCALES) + delta(LOG_SCALES),
        "logit_opacities": (rest(LOGIT_OPACITIES) + delta(LOGIT_OPACITIES))[:, 0],
        "sh0": rgb(rest(SH0) + delta(SH0)),
        "shN": np.zeros((count, 0, 3)),
        "shown": np.ones(count, bool),
    }
    if h.sh_degree:
        frame["shN"] = rgb((rest(SHN) + delta(SHN)).reshape(count, -1, 3))
    if group.lifetimes is not None:
        frame["shown"] = (group.lifetimes[:, 0] <= t) & (t < group.lifetimes[:, 1])
    return frame


# ---- 16. Conformance ------------------------------------------------------------------------------------------------


def arrays(group):
    """Clause 16: the decoded arrays in their order; None where the group has none."""
    yield "positions", group.positions
    for a in range(LOG_SCALES, SHN + 1):
        yield f"channels_{ATTRIBUTES[a]}", group.channels.get(a)
    yield "lifetimes", group.lifetimes
    yield "node_positions", group.node_positions
    yield "node_trajectories", group.node_trajectories
    for a in range(MEANS, SHN + 1):
        yield f"trajectories_{ATTRIBUTES[a]}", group.trajectories.get(a)
    if group.rig is not None:
        yield "joints", group.rig.joints
        yield "parents", group.rig.parents
        yield "bind", group.rig.bind
        yield "weights", group.rig.weights
        yield "joint_poses", group.rig.poses


def hash_arrays(frames, grid_bits, arrays):
    """Clause 16: SHA-256 of the canonical serialization of the decoded integers."""
    digest = hashlib.sha256(struct.pack("<2i", frames, grid_bits))
    for array in arrays:
        shape = () if array is None else array.shape
        digest.update(struct.pack(f"<{1 + len(shape)}i", len(shape), *shape))
        digest.update(b"" if array is None else np.ascontiguousarray(array, "<i4").tobytes())
    return digest.hexdigest()


def group_hash(group):
    return hash_arrays(group.header.frames, group.header.grid_bits, [array for _, array in arrays(group)])


def decode(data, track=0):
    """A whole file -> (Config, [(Sample, Group)]) of one of its tracks."""
    config, samples = read_container(data, track)
    groups = []
    for i, sample in enumerate(samples):
        back = read_reference(sample.payload)
        require(back <= i, f"group {i}: it refers to the group {back} before it, which is before the first")
        require(not back or not sample.sync, f"group {i}: it is predicted, but its sample is a sync sample")
        reference = groups[i - back] if back else None
        group = decode_group(sample.payload, config.level, sample.frames, reference)
        told, got = config.sh_degree, group.header.sh_degree
        require(got <= told, f"group_header: sh_degree is {got}, but gsvC allows {told}")
        groups.append(group)
    return config, list(zip(samples, groups, strict=True))


def main():
    parser = argparse.ArgumentParser(description="Decode a .gsv file with the reference decoder.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--npz", type=Path, help="write the decoded integers of all groups here")
    options = parser.parse_args()
    try:
        _, groups = decode(options.file.read_bytes())
    except (BitstreamError, LimitError) as error:
        sys.exit(f"{type(error).__name__}: {error}")
    for sample, group in groups:
        print(f"{group_hash(group)}  frames {sample.start_frame} to {sample.start_frame + sample.frames - 1}")
    if options.npz:
        named = {
            f"group{g}_{name}": a for g, (_, group) in enumerate(groups) for name, a in arrays(group) if a is not None
        }
        np.savez_compressed(options.npz, **named)


if __name__ == "__main__":
    main()
