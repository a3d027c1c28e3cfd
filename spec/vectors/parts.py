"""What the conformance vectors are made of: groups, files, and groups and files taken apart to change one thing.

Synthetic groups go through the package's encoder and muxer. The edits work on the bytes, with the reference decoder's
parser, since an encoder would never write what they make.
"""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np

from gscodec import _native

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import reference_decoder as reference
from reference_container import boxes

CHANNELS = {"log_scales": 3, "quats": 3, "logit_opacities": 1, "sh0": 3}


# ---- Groups ---------------------------------------------------------------------------------------------------------


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
    """A group dict for encode_group: smooth in space with noise, small motions. `trajectories`: attribute -> K."""
    rng = np.random.default_rng(seed)
    positions = sample_positions(rng, count, bits)
    names = dict(CHANNELS) | ({"shN": 3 * ((sh_degree + 1) ** 2 - 1)} if sh_degree else {})
    smooth = np.sin(positions @ rng.random((3, 1)) * 8 / 2**bits).T
    channels = {}
    for name, c in names.items():
        values = (
            (spread * (smooth * rng.random((c, 1)) + 0.3 * rng.standard_normal((c, count)))).round().astype(np.int32)
        )
        channels[name] = {
            "values": values,
            "steps": [0.01 + 0.002 * i for i in range(c)],
            "offsets": [0.1 * i - 0.2 for i in range(c)],
        }
    channels["quats"]["levers"] = [[-12, 40, 3], [127, -128, 0], [25, -9, 1]]
    group = {
        "frames": frames,
        "origin": [-1.0, 0.5, 2.0],
        "grid_step": 2.0 ** (1 - bits),
        "grid_bits": bits,
        "positions": positions,
        "channels": channels,
        "lifetimes": None,
        "nodes": None,
        "trajectories": {},
    }
    if nodes:
        k = min(6, frames)
        decay = 20 / (1 + np.arange(k)).reshape(k, 1, 1)
        motion = (decay * rng.standard_normal((k, 6, nodes))).round().astype(np.int32)
        group["nodes"] = {"positions": sample_positions(rng, nodes, bits), "coefficients": motion}
        group["nodes"] |= {"rotation_step": 0.01, "translation_step": 0.005, "neighbors": neighbors}
    for name, k in (trajectories or {}).items():
        c = 3 if name == "means" else names[name]
        values = (5 * rng.standard_normal((k, c, count))).round().astype(np.int32)
        length = rng.integers(0, k + 1, count) * (rng.random(count) < 0.3)
        values[np.broadcast_to(np.arange(k)[:, None, None] >= length, values.shape)] = 0
        group["trajectories"][name] = {"coefficients": values, "step": 0.003}
    if lifetimes:
        cut = rng.random(count) < 0.4
        start = rng.integers(0, frames, count)
        end = start + 1 + (rng.random(count) * (frames - start)).astype(int)
        group["lifetimes"] = np.column_stack([np.where(cut, start, 0), np.where(cut, end, frames)]).astype(np.uint16)
    return group


def extremes():
    """Values at +-2^24, corners of the finest grid, steps from tiny to large."""
    group = make_group(40, 3, bits=21, nodes=9, trajectories={"means": 3, "log_scales": 2})
    top = 2**21 - 1
    group["positions"][0], group["positions"][-1] = 0, top
    for i, name in enumerate(group["channels"]):
        channel = group["channels"][name]
        channel["values"][:, 1::7], channel["values"][:, 3::5] = 2**24, -(2**24)
        channel["steps"] = [2.0 ** -(30 + i)] * len(channel["steps"])
    group["channels"]["logit_opacities"]["steps"] = [1e30]
    group["trajectories"]["means"]["coefficients"][2, :, 4] = [2**24, -(2**24), 2**24]
    group["trajectories"]["means"]["step"] = 1e-30
    group["nodes"]["coefficients"][0, :, 2] = [2**24, -(2**24), 2**24] * 2
    group["nodes"] |= {"rotation_step": 1e-8, "translation_step": 1e-7}
    return group


def duplicates():
    """Many Gaussians on few grid points, more than 255 on one."""
    group = make_group(700, 4, bits=3, nodes=20, neighbors=8)
    group["positions"][:300] = group["positions"][0]
    return group


def two_trees():
    """The least number of Gaussians whose positions are two trees; all else is 0."""
    group = make_group(2**14, 1, bits=4)
    for channel in group["channels"].values():
        channel["values"][:] = 0
    return group


def tied_nodes():
    """Nodes at equal distances and on top of each other: the order of clause 13.2 decides."""
    group = make_group(60, 5, bits=2, nodes=30, neighbors=3)
    group["nodes"]["positions"] = np.repeat(group["nodes"]["positions"][::2], 2, axis=0)
    return group


GAUSSIAN_AXIS = {"positions": 0, "lifetimes": 0, "parents": 0}


def take(group, index):
    """The Gaussians of a group dict at `index`, in that order."""
    result = dict(group)
    for name in GAUSSIAN_AXIS:
        if group.get(name) is not None:
            result[name] = group[name][index]
    for kind, key in (("channels", "values"), ("trajectories", "coefficients")):
        result[kind] = {n: c | {key: np.ascontiguousarray(c[key][..., index])} for n, c in group[kind].items()}
    return result


def layered(group, shares, corrections=None):
    """A group dict in layers: layer k has every Gaussian whose index modulo len(shares) is one of shares[k]."""
    n = len(group["positions"])
    period = sum(len(share) for share in shares)
    parts = [[i for i in range(n) if i % period in share] for share in shares]
    result = take(group, np.array([i for part in parts for i in part], int))
    result["layers"] = [len(part) for part in parts]
    return result | ({"corrections": corrections} if corrections else {})


def coarser(group, shifts):
    """A layered group dict whose layer k leaves out shifts[k] low bits of positions and of each attribute."""
    layer = np.repeat(np.arange(len(group["layers"])), group["layers"])
    shifts = np.array(shifts)
    cut = lambda v, s: (v >> s << s).astype(v.dtype)  # noqa: E731
    channels = {
        name: c | {"values": cut(c["values"], shifts[layer, i])}
        for i, (name, c) in enumerate(group["channels"].items(), 1)
    }
    positions = cut(group["positions"], shifts[layer, :1].astype(np.uint32))
    return group | {"positions": positions, "channels": channels, "shifts": shifts.tolist()}


def curved(group):
    """A group dict whose channels of log_scales and logit_opacities have curves: gentle, steep, flat, around 0."""
    rows = [[-0.3, 0.02, *range(0, 40, 5)], [0.0, 1e-3, *range(255, 15, -32)], [-1.0, 0.5, *[0] * 8]]
    curves = {"log_scales": rows, "logit_opacities": [[-0.4, 0.125, 48, 16, 0, 0, 3, 0, 16, 64]]}
    channels = {name: c | {"curves": curves.get(name)} for name, c in group["channels"].items()}
    return group | {"channels": channels}


def predicted(reference, group, *, back=1, deaths=lambda i: i % 5 == 0, births=9):
    """A predicted group dict: of `reference` those that do not die, and in each layer `births` Gaussians of `group`.

    Nodes, trajectories and lifetimes are those of `group`, which must have enough Gaussians.
    """
    parents, kept, first = [], [], 0
    layers = reference.get("layers") or [len(reference["positions"])]
    for k, count in enumerate(layers):
        alive = [i for i in range(first, first + count) if not deaths(i)]
        kept.append((alive, list(range(k * births, (k + 1) * births))))
        parents += alive + [-1] * births
        first += count

    def join(a, b, axis):
        return np.concatenate([part for i, j in kept for part in (a.take(i, axis), b.take(j, axis))], axis)

    result = dict(reference) | {"reference": back, "parents": np.array(parents, np.int32), "corrections": None}
    result["frames"] = group["frames"]
    result["layers"] = [len(alive) + births for alive, _ in kept]
    result["positions"] = join(reference["positions"], group["positions"], 0)
    result["channels"] = {
        n: c | {"values": join(c["values"], group["channels"][n]["values"], 1)}
        for n, c in reference["channels"].items()
    }
    own = take(group, np.arange(len(parents)))
    return result | {name: own[name] for name in ("trajectories", "nodes", "lifetimes")}


def encode(group, reference=None):
    """The payload of a group dict; `reference`: the payload of the group that a predicted one refers to."""
    known = reference and _native.DecodedGroup(reference, 4)
    return _native.encode_group(group, known)[0]


# ---- Files ----------------------------------------------------------------------------------------------------------

CONFIG = {
    "level": 1,
    "fps": (30, 1),
    "metres_per_unit": 1.0,
    "up": "y",
    "color_space": "srgb",
    "background": [0.0, 0.0, 0.0],
    "sh_degree": 0,
    "sh_frame": "world",
    "cameras": [],
}


def make_file(payloads, *, finish=True, **config):
    """payloads: [(bytes, frames)], with a third item of False for no sync sample -> bytes of a .gsv file."""
    config = CONFIG | config
    init = bytes(_native.init_segment(config))
    fragments, start = [], 0
    payloads = [(*p, True)[:3] for p in payloads]
    for number, (payload, frames, sync) in enumerate(payloads, 1):
        fragments.append(bytes(_native.fragment(payload, number, start, frames, sync, config)))
        start += frames
    if finish:
        index = [(len(f), n, s, []) for f, (_, n, s) in zip(fragments, payloads, strict=True)]
        init = bytes(_native.finish(init, index))
    return init + b"".join(fragments)


def groups_file(*groups, **options):
    return make_file([(encode(group), group["frames"]) for group in groups], **options)


def predicted_file(first, *others, edit=lambda units: None, sync=False, **options):
    """An independent group and groups that are predicted from it; `edit` changes the units of the last one."""
    known = encode(first)
    payloads = [(known, first["frames"])]
    for group in others:
        units = split_units(encode(group, known))
        if group is others[-1]:
            edit(units)
        payloads.append((join_units(units), group["frames"], sync))
    return make_file(payloads, **options)


def box(kind, body):
    return struct.pack(">I4s", 8 + len(body), kind) + body


def split_boxes(data):
    """[(type, bytes)] of the top-level boxes."""
    return [(kind, data[start:end]) for kind, start, _, end in boxes(data, 0, len(data), top_level=True)]


def shift_data(moof, by):
    """The moof when `by` bytes come between it and the sample."""
    at = moof.index(b"trun") + 12
    return poke(moof, at, struct.pack(">i", struct.unpack_from(">i", moof, at)[0] + by))


def unknown_boxes():
    """Unknown boxes after every top-level box and at the end of each container box."""
    extra, result = box(b"what", b"ever"), b""
    for kind, whole in split_boxes(groups_file(make_group(30, 2), make_group(30, 2, seed=2), finish=False)):
        if kind == b"moof":
            whole = shift_data(whole, 2 * len(extra))
        if kind in (b"moov", b"moof"):
            whole = box(kind, whole[8:] + extra)
        result += whole + extra
    return result


def other_mdat_sizes():
    """The first mdat with a 64-bit size, the last one with size 0."""
    parts = split_boxes(groups_file(make_group(30, 2), make_group(30, 3, seed=2), finish=False))
    (_, first_moof), (_, first_mdat), (_, last_moof), (_, last_mdat) = parts[2:]
    first_mdat = struct.pack(">I4sQ", 1, b"mdat", len(first_mdat) + 8) + first_mdat[8:]
    return parts[0][1] + parts[1][1] + shift_data(first_moof, 8) + first_mdat + last_moof + bytes(4) + last_mdat[4:]


def full_box(kind, flags, *fields, version=0):
    """Fields are u32 or bytes."""
    body = b"".join(f if isinstance(f, bytes) else struct.pack(">I", f) for f in fields)
    return box(kind, struct.pack(">I", version << 24 | flags) + body)


def other_track():
    """An audio track before ours in moov and moof, and every other way to say where a sample is and how long."""
    payload = encode(make_group(30, 2))
    first, second = encode(make_group(20, 3, seed=2)), encode(make_group(25, 3, seed=3))
    (_, ftyp), (_, moov), *_ = split_boxes(make_file([(payload, 2)], finish=False))
    at = moov.index(b"trak") - 4
    audio = box(b"trak", box(b"mdia", full_box(b"hdlr", 0, 0, b"soun", bytes(13))))
    moov = box(b"moov", moov[8:at] + audio + moov[at:])
    start = moov.index(b"trex") - 4  # defaults: a duration of 3 frames, no sync sample
    moov = moov[:start] + full_box(b"trex", 0, 1, 1, 3, 0, 1 << 16)
    mvex = moov.index(b"mvex") - 4
    moov = box(b"moov", moov[8:mvex] + box(b"mvex", moov[mvex + 8 :]))
    head = ftyp + moov
    theirs = box(b"traf", full_box(b"tfhd", 0, 2) + full_box(b"trun", 0, 7))

    def moof(*traf):
        return box(b"moof", full_box(b"mfhd", 0, 1) + theirs + box(b"traf", b"".join(traf)))

    def by_base(offset):  # base_data_offset, size and flags in tfhd; 32-bit time, no data_offset in trun
        tfhd = full_box(b"tfhd", 0x31, 1, struct.pack(">Q", offset), len(first), 0)
        return moof(tfhd, full_box(b"tfdt", 0, 0), full_box(b"trun", 0, 1))

    def by_tfhd(offset):  # sample_description_index, duration, size in tfhd; first_sample_flags in trun
        tfhd = full_box(b"tfhd", 0x1A, 1, 1, 3, len(second))
        return moof(tfhd, full_box(b"tfdt", 0, 3), full_box(b"trun", 0x005, 1, offset, 1 << 25))

    def by_trex(offset):
        return moof(full_box(b"tfhd", 0, 1), full_box(b"tfdt", 0, 6), full_box(b"trun", 0x201, 1, offset, len(second)))

    data = head + by_base(len(head) + len(by_base(0)) + 13) + box(b"mdat", b"audio" + first + b"more audio")
    for fragment in (by_tfhd, by_trex):
        data += fragment(len(fragment(0)) + 8) + box(b"mdat", second)
    return data


def no_mdat():
    """A moof that an unknown box follows in place of its mdat, then a whole fragment."""
    parts = split_boxes(groups_file(make_group(30, 2), make_group(30, 2, seed=2), finish=False))
    return b"".join(whole.replace(b"mdat", b"what") if i == 3 else whole for i, (_, whole) in enumerate(parts))


def truncated():
    return groups_file(make_group(30, 2), make_group(30, 2, seed=2), finish=False)[:-10]


def second_moof():
    """A moof without a traf of our track between a moof and its mdat."""
    parts = split_boxes(groups_file(make_group(30, 2), finish=False))
    empty = box(b"moof", full_box(b"mfhd", 0, 2))
    (_, ftyp), (_, moov), (_, moof), (_, mdat) = parts
    return ftyp + moov + shift_data(moof, len(empty)) + empty + mdat


def truncated_to_end():
    """An mdat of size 0 whose sample goes on past the end of the file, after a whole group."""
    return other_mdat_sizes()[:-10]


def ignored_fields():
    """Values of later versions in fields that a reader does not look at."""
    data = groups_file(make_group(30, 2))
    entry = data.index(b"stsd") + 20  # the body of the sample entry
    for at, new in (
        (12, u32(7)),  # minor_version of ftyp
        (data.index(b"hdlr") + 8, u32(1)),  # pre_defined
        (data.index(b"vvhd") + 4, b"\1\0\0\1"),  # version and flags
        (entry, b"later!\0\2" + b"\xff" * 32),  # reserved, data_reference_index, compressor_name
    ):
        data = poke(data, at, new)
    return data


def truncated_after_sample():
    """The file ends in an mdat that goes on after its sample."""
    parts = split_boxes(groups_file(make_group(30, 2), finish=False))
    last = parts.pop()[1]
    return b"".join(whole for _, whole in parts) + struct.pack(">I", len(last) + 100) + last[4:]


def major_brand_only():
    parts = split_boxes(groups_file(make_group(30, 2)))
    return box(b"ftyp", b"gsv1\0\0\0\0isom") + b"".join(whole for _, whole in parts[1:])


CAMERA = {
    "name": "Kamera 1 äöü",
    "width": 1920,
    "height": 1080,
    "K": np.array([[1000.5, 0.25, 960], [0, 1001, 540], [0, 0, 1.0]]),
}
CAMERA["viewmat"] = np.array([[0, 0, 1, 0.5], [1, 0, 0, -2], [0, 1, 0, 3], [0, 0, 0, 1.0]])


# ---- Groups taken apart ---------------------------------------------------------------------------------------------


def poke(data, at, new):
    return data[:at] + new + data[at + len(new) :]


def base_group():
    return make_group(40, 4, nodes=3, trajectories={"means": 2, "sh0": 2}, lifetimes=True)


def split_units(payload):
    return [vars(unit) for unit in reference.read_units(payload)]


def join_units(units):
    result = b""
    for u in units:
        head = bytes([u["unit_type"], u["layer"], u["attribute"], len(u["dependencies"]), *u["dependencies"]])
        head += struct.pack(">I", len(u["payload"]))
        result += head + struct.pack(">I", zlib.crc32(head + u["payload"]) ^ u.get("damage", 0)) + u["payload"]
    return result


def without_sizes(units):
    """Removes unit_sizes from the header, as draft 2 had it, so that units may change their size."""
    head = units[0]["payload"]
    at = 5 if head[2] & 1 else 3
    units[0]["payload"] = head[:2] + bytes([head[2] & ~4]) + head[3:at] + head[at + 1 + 4 * head[at] :]
    return units


def units_file(edit, frames=4, **config):
    """The base group with its units (a list of dicts: unit_type, layer, attribute, dependencies, payload) edited."""
    units = without_sizes(split_units(encode(base_group())))
    edit(units)
    return make_file([(join_units(units), frames)], **config)


def layers_file(edit):
    """The base group in layers of a half, with its units edited."""
    units = without_sizes(split_units(encode(layered(base_group(), [[0], [1]]))))
    edit(units)
    return make_file([(join_units(units), 4)])


def change_unit_of_predicted(unit_type, attribute, change):
    """A group predicted from the base group, with deaths and births; `change` gets its units and one of them."""
    group = predicted(base_group(), make_group(60, 4, seed=6, trajectories={"means": 2}))

    def edit(units):
        change(without_sizes(units), find_unit(units, unit_type, attribute))

    return lambda: predicted_file(base_group(), group, edit=edit)


def change_predicted(edit):
    """The same with its header edited."""
    return change_unit_of_predicted(0, 0, lambda units, u: u.update(payload=edit(u["payload"])))


def deaths_of_others():
    """A deaths unit of the base group that says otherwise."""
    known, group = encode(base_group()), make_group(60, 4, seed=6)
    units = split_units(encode(predicted(base_group(), group, deaths=lambda i: i % 2), known))
    return find_unit(units, 8)["payload"]


def sizes_file(edit):
    """The base group with its header, which has unit_sizes from byte 3 on, edited."""
    units = split_units(encode(base_group()))
    units[0]["payload"] = edit(units[0]["payload"])
    return make_file([(join_units(units), 4)])


def payload_file(edit):
    """The base group with its bytes edited."""
    return make_file([(edit(encode(base_group())), 4)])


def unit_dict(unit_type, layer=0, attribute=0, dependencies=(), payload=b""):
    names = ("unit_type", "layer", "attribute", "dependencies", "payload")
    return dict(zip(names, (unit_type, layer, attribute, list(dependencies), payload), strict=True))


def add_unknown_units(units):
    units.append(unit_dict(200, attribute=17, dependencies=[1], payload=b"from later"))
    units.append(unit_dict(7, attribute=2, dependencies=[1]))
    units.append(unit_dict(255, layer=3))
    units.append(unit_dict(255, layer=3))
    units.append(unit_dict(10, layer=3, payload=bytes(100)))


def find_unit(units, unit_type, attribute=0, layer=0):
    return next(u for u in units if (u["unit_type"], u["layer"], u["attribute"]) == (unit_type, layer, attribute))


def drop(units, unit):
    """Removes a unit, and all dependencies on it."""
    index = units.index(unit)
    del units[index]
    for u in units:
        u["dependencies"] = [d - (d > index) for d in u["dependencies"] if d != index]


def remove_unit(unit_type, attribute=0):
    """The base group without a unit."""
    return lambda: units_file(lambda units: drop(units, find_unit(units, unit_type, attribute)))


def change_unit(unit_type, attribute=0, /, **fields):
    return lambda: units_file(lambda units: find_unit(units, unit_type, attribute).update(fields))


def change_first_tree(size):
    """Positions of two trees that tell another size of the first one."""
    units = split_units(encode(two_trees()))
    positions = find_unit(units, 1)
    positions["payload"] = size + positions["payload"][4:]
    return make_file([(join_units(units), 1)])


def change_payload(unit_type, attribute, edit):
    def change(units):
        unit = find_unit(units, unit_type, attribute)
        unit["payload"] = edit(unit["payload"])

    return lambda: units_file(change)


def insert(*units):
    return lambda: units_file(lambda others: others.extend(units))


HEADER = {
    "frames": 4,
    "flags": 0,
    "origin": (0.0, 0.0, 0.0),
    "grid_step": 0.01,
    "grid_bits": 10,
    "sh_degree": 0,
    "layer_count": 1,
    "layer_counts": [(40, 2)],
    "channels": [(a, [(0.1, 0.0)] * c) for a, c in ((2, 3), (3, 3), (4, 1), (5, 3))],
    "trajectories": [(1, 2, 0.1), (5, 2, 0.1)],
    "node_count": 3,
    "neighbors": 4,
    "coefficients": 4,
    "rotation_step": 0.1,
    "translation_step": 0.1,
}


def pack_header(**changes):
    h = HEADER | changes
    data = struct.pack(">HB", h["frames"], h["flags"])
    data += struct.pack(">H", h["reference"]) if "reference" in h else b""
    data += struct.pack(">3ffBBB", *h["origin"], h["grid_step"], h["grid_bits"], h["sh_degree"], h["layer_count"])
    data += b"".join(struct.pack(">IB", *layer) for layer in h["layer_counts"]) + bytes([len(h["channels"])])
    for attribute, pairs in h["channels"]:
        data += bytes([attribute]) + b"".join(struct.pack(">ff", *pair) for pair in pairs)
    data += bytes(9) + bytes(h.get("shifts", b""))  # no levers
    data += b"".join(struct.pack(">ff8x", *curve) for curve in h.get("curves", ()))
    data += bytes([len(h["trajectories"])]) + b"".join(struct.pack(">BHf", *t) for t in h["trajectories"])
    data += struct.pack(">I", h["node_count"])
    if h["node_count"]:
        data += struct.pack(
            ">BHff", *(h[k] for k in ("neighbors", "coefficients", "rotation_step", "translation_step"))
        )
    return data


def header(duration=4, **changes):
    """The base group under another header; a check of the header comes before its other units are looked at."""
    return lambda: units_file(lambda units: units[0].update(payload=pack_header(**changes)), frames=duration)


def traj(*trajectories):
    return header(trajectories=list(trajectories))


def patched(kind, offset, new):
    """A file with bytes changed at an offset from the body of the first box of a type."""

    def build():
        data = groups_file(base_group(), cameras=[CAMERA])
        return poke(data, data.index(kind) + 4 + offset, new)

    return build


def other_top(edit):
    """A file with its list of top-level boxes edited."""

    def build():
        parts = split_boxes(groups_file(base_group()))
        return b"".join(whole for _, whole in edit(parts) or parts)

    return build


def f32(value):
    return struct.pack(">f", value)


def u32(value):
    return struct.pack(">I", value)


def poke_duration(frame_duration, wrong):
    data = groups_file(base_group(), fps=(30000, frame_duration))
    return poke(data, data.index(b"trun") + 16, u32(wrong))


def poke_time(frame_duration, wrong):
    data = groups_file(base_group(), fps=(30000, frame_duration))
    return poke(data, data.index(b"tfdt") + 8, struct.pack(">Q", wrong))


def left_over_empty():
    """N = 0: nothing is decoded, so a payload of five bytes has one left over."""
    units = split_units(encode(make_group(0, 4)))
    find_unit(units, 1)["payload"] = bytes(5)
    return make_file([(join_units(units), 4)])
