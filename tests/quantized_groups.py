"""Groups in integers, for tests of the coder."""

from dataclasses import fields, is_dataclass, replace

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantized_group import QuantizedChannels, QuantizedGroup, QuantizedNodes, QuantizedTrajectories
from gscodec.model.attributes import ATTRIBUTES


def surface_group(n=4000, frames=1, sh_coefficients=0, seed=0):
    """A group like a scan: points on a bumpy sphere, attributes that vary over it, and noise."""
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(n, 3))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    r = 400 + 40 * np.sin(4 * v[:, :1]) + rng.normal(size=(n, 1))
    p = np.clip(np.rint(v * r + 512), 0, 1023).astype(np.uint32)
    order = _native.morton_order(p)
    p, v = p[order], v[order]
    waves = np.stack([np.sin(3 * v @ rng.normal(size=3)) for _ in range(10 + 3 * sh_coefficients)])
    q = np.rint(4 * waves + rng.normal(size=waves.shape)).astype(np.int32)

    def channels(lo, hi, step):
        return QuantizedChannels(q[lo:hi], np.full(hi - lo, step, np.float32), np.full(hi - lo, 0.5, np.float32))

    own = {
        "log_scales": channels(0, 3, 0.5),
        "quats": channels(3, 6, 0.03125),
        "logit_opacities": channels(6, 7, 1.0),
        "sh0": channels(7, 10, 0.125),
    }
    if sh_coefficients:
        own["shN"] = channels(10, 10 + 3 * sh_coefficients, 0.0625)
    origin = np.array([-1.0, 0.0, 2.0], np.float32)
    return QuantizedGroup(frames, origin, grid_step=0.25, grid_bits=10, positions=p, channels=own)


def moving_group(n=500, frames=8):
    """A group with nodes, trajectories of every attribute and lifetimes."""
    g = surface_group(n, frames, sh_coefficients=3)
    rng = np.random.default_rng(1)
    trajectories = {}
    for a in ATTRIBUTES:
        c = np.zeros((4, 9 if a.name == "shN" else a.channels, n), np.int32)
        some = rng.permutation(n)[: n // 10]
        c[:3, :, some] = rng.integers(-3, 4, (3, c.shape[1], len(some)))
        trajectories[a.name] = QuantizedTrajectories(c, step=0.015625)
    count = min(30, n)
    nodes = QuantizedNodes(
        positions=g.positions[np.sort(rng.permutation(n)[:count])],
        coefficients=rng.integers(-5, 6, (frames, 6, count)).astype(np.int32),
        rotation_step=0.0625,
        translation_step=0.125,
        neighbors=4,
    )
    t0 = rng.integers(0, 3, n)
    lifetimes = np.stack([t0, t0 + 1 + rng.integers(0, frames - 2, n)], 1).astype(np.uint16)
    return replace(g, trajectories=trajectories, nodes=nodes, lifetimes=lifetimes)


def take(group, index):
    """The Gaussians of a group at `index`, in that order."""
    channels = {n: replace(c, values=c.values[:, index]) for n, c in group.channels.items()}
    trajectories = {n: replace(t, coefficients=t.coefficients[:, :, index]) for n, t in group.trajectories.items()}
    lifetimes = None if group.lifetimes is None else group.lifetimes[index]
    own = {"channels": channels, "trajectories": trajectories, "lifetimes": lifetimes}
    return replace(group, positions=group.positions[index], **own)


SHIFTS = np.array([[0, 0, 0, 0, 0, 0], [1, 2, 1, 1, 0, 3]], np.uint8)
COMPANDING = {
    "log_scales": [[-1.0, 0.25, 0, 8, 16, 24, 32, 40, 48, 56], [0.0, 0.5, *[16] * 8], [-0.5, 1.0, *[0] * 8]],
    "logit_opacities": [[-2.0, 0.5, 64, 48, 32, 16, 0, 16, 32, 48]],
}


def layered_group(n=300):
    """`moving_group` with all other tools of an independent group: layers, shifts, corrections, companding, scale
    exponents."""
    group = moving_group(n)
    first = np.arange(n) % 3 == 0
    group = take(group, np.concatenate([np.flatnonzero(first), np.flatnonzero(~first)]))
    layers = (int(first.sum()), int((~first).sum()))
    shifts = np.repeat(SHIFTS, layers, 0)
    channels = {}
    for i, (name, c) in enumerate(group.channels.items(), 1):
        companding = np.array(COMPANDING[name], np.float32) if name in COMPANDING else None
        channels[name] = replace(c, values=c.values >> shifts[:, i] << shifts[:, i], companding=companding)
    return replace(
        group,
        positions=group.positions >> shifts[:, :1] << shifts[:, :1],
        channels=channels,
        layers=layers,
        shifts=SHIFTS,
        corrections=np.array([[0.5, -0.25], [0.125, 1.0]], np.float32),
        scale_exponents=np.array([[-12, 40, 3], [16, -8, 0], [25, -9, 1]], np.int32),
    )


def predicted_group(reference):
    """A group predicted from `reference`, a group with layers: in each layer every fifth Gaussian dies, a few are
    born."""
    ends = np.cumsum(reference.layers)
    index, parents, layers = [], [], []
    for first, last in zip(ends - reference.layers, ends, strict=True):
        alive = np.flatnonzero(np.arange(last) % 5 > 0)
        alive, born = alive[alive >= first], np.arange(first, last, 20)  # births: copies, in Morton order
        index += [*alive, *born]
        parents += [*alive, *[-1] * len(born)]
        layers.append(len(alive) + len(born))
    group = take(reference, np.array(index))
    return replace(group, layers=tuple(layers), reference=1, parents=np.array(parents, np.int32))


def with_channels(group, name, **change):
    """The group with changed fields (`change`) in the channels of one attribute."""
    return replace(group, channels={**group.channels, name: replace(group.channels[name], **change)})


def assert_same(a, b, path="group"):
    """Compares two groups field by field. `a` may leave out layers and corrections if there is one layer."""
    if isinstance(a, QuantizedGroup):
        a = replace(a, layers=a.layers or (len(a),))
        a = replace(a, corrections=np.zeros((len(a.layers), 2)) if a.corrections is None else a.corrections)
    if is_dataclass(a):
        assert type(a) is type(b), path
        a, b = ({f.name: getattr(g, f.name) for f in fields(g)} for g in (a, b))
    if isinstance(a, dict):
        assert set(a) == set(b), path
        for key in a:
            assert_same(a[key], b[key], f"{path}/{key}")
    elif a is None:
        assert b is None, path
    else:
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b), err_msg=path)
