"""Synthetic groups in integers, for the conformance vectors; the package's encoder makes payloads of them."""

from dataclasses import replace

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantized_group import (
    QuantizedChannels,
    QuantizedGroup,
    QuantizedNodes,
    QuantizedRig,
    QuantizedTrajectories,
)

CHANNELS = {"log_scales": 3, "quats": 3, "logit_opacities": 1, "sh0": 3}


def morton(positions, bits):
    code = [0] * len(positions)
    for i, point in enumerate(positions.tolist()):
        for axis, value in enumerate(point):
            code[i] |= sum((value >> j & 1) << (3 * j + 2 - axis) for j in range(bits))
    return code


def sample_positions(rng, count, bits):
    """[N, 3] u32 in Morton order: a surface and a few points away from it."""
    uv = rng.random((count, 2))
    z = (
        0.5
        + 0.3 * np.sin(5 * uv[:, 0]) * np.cos(4 * uv[:, 1])
        + 0.1 * rng.standard_normal(count) * (rng.random(count) < 0.1)
    )
    points = np.column_stack([uv, z.clip(0, 1)]) * (2**bits - 1)
    positions = points.round().astype(np.uint32).reshape(count, 3)
    code = morton(positions, bits)
    return positions[sorted(range(count), key=code.__getitem__)]


def make_group(
    count, frames, *, seed=1, bits=10, sh_degree=0, nodes=0, neighbors=4, trajectories=None, lifetimes=False, spread=12
):
    """A group for encode_group: smooth in space with noise, small motions. `trajectories`: attribute -> K."""
    rng = np.random.default_rng(seed)
    positions = sample_positions(rng, count, bits)
    names = dict(CHANNELS) | ({"shN": 3 * ((sh_degree + 1) ** 2 - 1)} if sh_degree else {})
    smooth = np.sin(positions @ rng.random((3, 1)) * 8 / 2**bits).T
    channels = {}
    for name, c in names.items():
        values = (
            (spread * (smooth * rng.random((c, 1)) + 0.3 * rng.standard_normal((c, count)))).round().astype(np.int32)
        )
        steps = np.array([0.01 + 0.002 * i for i in range(c)], np.float32)
        offsets = np.array([0.1 * i - 0.2 for i in range(c)], np.float32)
        channels[name] = QuantizedChannels(values, steps, offsets)
    motion = None
    if nodes:
        k = min(6, frames)
        decay = 20 / (1 + np.arange(k)).reshape(k, 1, 1)
        coefficients = (decay * rng.standard_normal((k, 6, nodes))).round().astype(np.int32)
        motion = QuantizedNodes(sample_positions(rng, nodes, bits), coefficients, 0.01, 0.005, neighbors)
    trajectories_of = {}
    for name, k in (trajectories or {}).items():
        c = 3 if name == "means" else names[name]
        values = (5 * rng.standard_normal((k, c, count))).round().astype(np.int32)
        length = rng.integers(0, k + 1, count) * (rng.random(count) < 0.3)
        values[np.broadcast_to(np.arange(k)[:, None, None] >= length, values.shape)] = 0
        trajectories_of[name] = QuantizedTrajectories(values, 0.003)
    shown = None
    if lifetimes:
        cut = rng.random(count) < 0.4
        start = rng.integers(0, frames, count)
        end = start + 1 + (rng.random(count) * (frames - start)).astype(int)
        shown = np.column_stack([np.where(cut, start, 0), np.where(cut, end, frames)]).astype(np.uint16)
    return QuantizedGroup(
        frames=frames,
        origin=np.array([-1.0, 0.5, 2.0], np.float32),
        grid_step=2.0 ** (1 - bits),
        grid_bits=bits,
        positions=positions,
        channels=channels,
        trajectories=trajectories_of,
        nodes=motion,
        lifetimes=shown,
        scale_exponents=np.array([[-12, 40, 3], [127, -128, 0], [25, -9, 1]], np.int32),
    )


def extremes():
    """Values at +-2^24, corners of the finest grid, steps from tiny to large."""
    group = make_group(40, 3, bits=21, nodes=9, trajectories={"means": 3, "log_scales": 2})
    group.positions[0], group.positions[-1] = 0, 2**21 - 1
    channels = {}
    for i, (name, c) in enumerate(group.channels.items()):
        c.values[:, 1::7], c.values[:, 3::5] = 2**24, -(2**24)
        step = 1e30 if name == "logit_opacities" else 2.0 ** -(30 + i)
        channels[name] = replace(c, steps=np.full(len(c.values), step, np.float32))
    means = replace(group.trajectories["means"], step=1e-30)
    means.coefficients[2, :, 4] = [2**24, -(2**24), 2**24]
    nodes = replace(group.nodes, rotation_step=1e-8, translation_step=1e-7)
    nodes.coefficients[0, :, 2] = [2**24, -(2**24), 2**24] * 2
    trajectories = {**group.trajectories, "means": means}
    return replace(group, channels=channels, trajectories=trajectories, nodes=nodes)


def duplicates():
    """Many Gaussians on few grid points, more than 255 on one."""
    group = make_group(700, 4, bits=3, nodes=20, neighbors=8)
    group.positions[:300] = group.positions[0]
    return group


def tiled(group, side_log2=4):
    """A group in tiles of another size."""
    return replace(group, tile_side_log2=side_log2)


def tied_nodes():
    """Nodes at equal distances and on top of each other: the order of clause 13.2 decides."""
    group = make_group(60, 5, bits=2, nodes=30, neighbors=3)
    nodes = replace(group.nodes, positions=np.repeat(group.nodes.positions[::2], 2, axis=0))
    return replace(group, nodes=nodes)


def rigged(group, joints=6, seed=2):
    """A group whose nodes a rig moves: a tree of joints with two roots, weights of up to three joints, or none."""
    rng = np.random.default_rng(seed)
    count = len(group.nodes.positions)
    parents = np.array([0, 1, *(rng.integers(0, j) for j in range(2, joints))][:joints], np.uint8)
    decay = (200 / (1 + np.arange(group.frames)) ** 2).reshape(-1, 1, 1)
    poses = (decay * rng.standard_normal((group.frames, 6, joints))).round().astype(np.int32)
    poses[:, 3:, 2:] = 0
    share = rng.random((count, joints)) * (rng.random((count, joints)) < 0.4)
    weights = np.floor(64 * share / np.maximum(share.sum(1, keepdims=True), 1e-9)).astype(np.uint8)
    rig = QuantizedRig(
        joints=rng.integers(-300, 1500, (joints, 3)).astype(np.int32),
        parents=parents,
        bind=(100 * rng.standard_normal((joints, 6))).round().astype(np.int32),
        weights=weights,
        poses=poses,
        rotation_step=0.005,
        translation_step=0.002,
    )
    return replace(group, nodes=replace(group.nodes, rig=rig))


def take(group, index):
    """The Gaussians of a group at `index`, in that order."""
    pick = lambda a: None if a is None else a[index]  # noqa: E731
    channels = {n: replace(c, values=c.values[:, index]) for n, c in group.channels.items()}
    trajectories = {n: replace(t, coefficients=t.coefficients[..., index]) for n, t in group.trajectories.items()}
    own = {name: pick(getattr(group, name)) for name in ("positions", "lifetimes", "parents")}
    return replace(group, channels=channels, trajectories=trajectories, **own)


def layered(group, shares, corrections=None):
    """A group in layers: layer k has every Gaussian whose index modulo len(shares) is one of shares[k]."""
    n = len(group)
    period = sum(len(share) for share in shares)
    parts = [[i for i in range(n) if i % period in share] for share in shares]
    result = take(group, np.array([i for part in parts for i in part], int))
    if corrections is not None:
        corrections = np.array(corrections, np.float32)
    return replace(result, layers=tuple(len(part) for part in parts), corrections=corrections)


def coarser(group, shifts):
    """A layered group whose layer k leaves out shifts[k] low bits of positions and of each attribute."""
    layer = np.repeat(np.arange(len(group.layers)), group.layers)
    shifts = np.array(shifts)
    cut = lambda v, s: (v >> s << s).astype(v.dtype)  # noqa: E731
    channels = {
        name: replace(c, values=cut(c.values, shifts[layer, i]))
        for i, (name, c) in enumerate(group.channels.items(), 1)
    }
    positions = cut(group.positions, shifts[layer, :1].astype(np.uint32))
    return replace(group, positions=positions, channels=channels, shifts=shifts)


def companded(group):
    """A group whose channels of log_scales and logit_opacities are companded: gentle, steep, flat, around 0."""
    rows = [[-0.3, 0.02, *range(0, 40, 5)], [0.0, 1e-3, *range(255, 15, -32)], [-1.0, 0.5, *[0] * 8]]
    companding = {"log_scales": rows, "logit_opacities": [[-0.4, 0.125, 48, 16, 0, 0, 3, 0, 16, 64]]}
    own = {n: replace(group.channels[n], companding=np.array(c, np.float32)) for n, c in companding.items()}
    return replace(group, channels={**group.channels, **own})


def predicted(reference, group, *, back=1, deaths=lambda i: i % 5 == 0, births=9):
    """A predicted group: the survivors of `reference`, and in each layer `births` Gaussians of `group`.

    Nodes, trajectories and lifetimes are those of `group`, which must have enough Gaussians.
    """
    parents, kept, first = [], [], 0
    for k, count in enumerate(reference.layers or (len(reference),)):
        alive = [i for i in range(first, first + count) if not deaths(i)]
        kept.append((alive, list(range(k * births, (k + 1) * births))))
        parents += alive + [-1] * births
        first += count

    def join(a, b, axis):
        return np.concatenate([part for i, j in kept for part in (a.take(i, axis), b.take(j, axis))], axis)

    own = take(group, np.arange(len(parents)))
    return replace(
        reference,
        frames=group.frames,
        positions=join(reference.positions, group.positions, 0),
        channels={
            n: replace(c, values=join(c.values, group.channels[n].values, 1)) for n, c in reference.channels.items()
        },
        trajectories=own.trajectories,
        nodes=own.nodes,
        lifetimes=own.lifetimes,
        layers=tuple(len(alive) + births for alive, _ in kept),
        corrections=None,
        reference=back,
        parents=np.array(parents, np.int32),
    )


def encode(group, reference=None):
    """The payload of a group; `reference`: the payload of the group that a predicted one refers to."""
    known = reference and _native.DecodedGroup(reference, 4)
    return _native.encode_group(group, known)[0]
