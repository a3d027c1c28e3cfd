"""Changes single units of groups.

The edits work on the bytes, with the reference decoder's parser, since an encoder would never write what they make.
"""

import struct
import sys
import zlib
from pathlib import Path

from files import CAMERA, groups_file, make_file, poke, split_boxes, u32
from groups import encode, layered, make_group, predicted, rigged

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from reference_container import Reader
from reference_units import read_header_bytes, read_units, read_varint


def predicted_file(first, *others, edit=lambda units: None, sync=False, **options):
    """An independent group and groups that are predicted from it; `edit` changes the units of the last one."""
    known = encode(first)
    payloads = [(known, first.frames)]
    for group in others:
        units = split_units(encode(group, known))
        if group is others[-1]:
            edit(units)
        payloads.append((join_units(units), group.frames, sync))
    return make_file(payloads, **options)


def base_group():
    return make_group(40, 4, nodes=3, trajectories={"means": 2, "sh0": 2}, lifetimes=True)


def split_units(payload):
    """Dicts of unit_type, layer, index, payload; that of the header has no directory, `join_units` makes it."""
    header, _ = read_header_bytes(payload)
    at = directory_at(header)
    count = struct.unpack_from(">H", header, at)[0]
    first = unit_dict(0, payload=header[:at] + header[at + 2 + 12 * count :])
    return [first, *(vars(unit) for unit in read_units(payload))]


def directory_at(header):
    """Where the directory begins: behind frames, flags and reference."""
    return 5 if header[2] & 1 else 3


def join_units(units):
    """The payload. `damage` of a unit changes its CRC, `size` its size in the directory."""
    header, *others = units
    directory = struct.pack(">H", len(others))
    for u in others:
        size, crc = u.get("size", len(u["payload"])), zlib.crc32(u["payload"]) ^ u.get("damage", 0)
        directory += struct.pack(">BBHII", u["unit_type"], u["layer"], u["index"], size, crc)
    at = directory_at(header["payload"])
    head = header["payload"][:at] + directory + header["payload"][at:]
    crc = zlib.crc32(head) ^ header.get("damage", 0)
    return struct.pack(">II", len(head), crc) + head + b"".join(u["payload"] for u in others)


def units_file(edit, frames=4, **config):
    """The base group with its units edited."""
    units = split_units(encode(base_group()))
    edit(units)
    return make_file([(join_units(units), frames)], **config)


def layers_file(edit):
    """The base group in layers of a half, with its units edited."""
    units = split_units(encode(layered(base_group(), [[0], [1]])))
    edit(units)
    return make_file([(join_units(units), 4)])


def change_unit_of_predicted(unit_type, index, change):
    """A group predicted from the base group, with deaths and births; `change` gets its units and one of them."""
    group = predicted(base_group(), make_group(60, 4, seed=6, trajectories={"means": 2}))

    def edit(units):
        change(units, find_unit(units, unit_type, index))

    return lambda: predicted_file(base_group(), group, edit=edit)


def change_predicted(edit):
    """The same with its header edited, which has no directory here."""
    return change_unit_of_predicted(0, 0, lambda units, u: u.update(payload=edit(u["payload"])))


def other_deaths(units, unit):
    """Puts the deaths of other survivors into a tile."""
    known, group = encode(base_group()), make_group(60, 4, seed=6, trajectories={"means": 2})
    others = split_units(encode(predicted(base_group(), group, deaths=lambda i: i % 2), known))
    streams, theirs = split_streams(unit["payload"], 2), split_streams(find_unit(others, TILE)["payload"], 2)
    unit["payload"] = join_streams([theirs[0], *streams[1:]])


def payload_file(edit):
    """The base group with its bytes edited."""
    return make_file([(edit(encode(base_group())), 4)])


TILE = 1
STREAMS = (
    "positions",
    "log_scales",
    "quats",
    "logit_opacities",
    "sh0",
    "means trajectories",
    "sh0 trajectories",
    "lifetimes",
)


def unit_dict(unit_type, layer=0, index=0, payload=b""):
    return {"unit_type": unit_type, "layer": layer, "index": index, "payload": payload}


def split_streams(payload, count):
    """The streams of a tile."""
    r = Reader(payload, 0, len(payload), "tile")
    sizes = [read_varint(r) for _ in range(count - 1)]
    return [bytes(r.take(size)) for size in sizes] + [bytes(r.take(r.end - r.position))]


def join_streams(streams):
    sizes = b"".join(varint(len(stream)) for stream in streams[:-1])
    return sizes + b"".join(streams)


def varint(value):
    return bytes(value >> 7 * i & 127 | (128 if i else 0) for i in range(5) if not i or value >> 7 * i)[::-1]


def add_unknown_units(units):
    units.append(unit_dict(200, index=17, payload=b"from later"))
    units.append(unit_dict(7, index=2))
    units.append(unit_dict(255, layer=3))
    units.append(unit_dict(255, layer=3))
    units.append(unit_dict(10, layer=3, payload=bytes(100)))


def find_unit(units, unit_type, index=0, layer=0):
    return next(u for u in units if (u["unit_type"], u["layer"], u["index"]) == (unit_type, layer, index))


def remove_unit(unit_type):
    """The base group without a unit."""
    return lambda: units_file(lambda units: units.remove(find_unit(units, unit_type)))


def change_unit(unit_type, /, **fields):
    return lambda: units_file(lambda units: find_unit(units, unit_type).update(fields))


def change_tile(edit):
    """The base group with the payload of its tile edited."""

    def change(units):
        unit = find_unit(units, TILE)
        unit["payload"] = edit(unit["payload"])

    return lambda: units_file(change)


def change_stream(name, edit):
    """The base group with a stream of its tile edited."""

    def change(payload):
        streams = split_streams(payload, len(STREAMS))
        at = STREAMS.index(name)
        return join_streams([*streams[:at], edit(streams[at]), *streams[at + 1 :]])

    return change_tile(change)


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
    "layer_counts": [40],
    "tile_side_log2": 6,
    "bounds": (0, 0, 0, 65535, 65535, 65535),
    "channels": [(a, [(0.1, 0.0)] * c) for a, c in ((2, 3), (3, 3), (4, 1), (5, 3))],
    "trajectories": [(1, 2, 0.1), (5, 2, 0.1)],
    "node_count": 3,
    "neighbors": 4,
    "coefficients": 4,
    "rotation_step": 0.1,
    "translation_step": 0.1,
}


def rig_unit(unit_type, **fields):
    """A group with a rig, with a unit changed."""
    change = lambda units: find_unit(units, unit_type).update(fields)  # noqa: E731
    return lambda: rigged_file(change)


def rigged_file(edit):
    """A group with a rig, with its units edited."""
    units = split_units(encode(rigged(base_group())))
    edit(units)
    return make_file([(join_units(units), 4)])


def pack_header(**changes):
    h = HEADER | changes
    data = struct.pack(">HB", h["frames"], h["flags"])
    data += struct.pack(">H", h["reference"]) if "reference" in h else b""
    data += struct.pack(">3ffBBB", *h["origin"], h["grid_step"], h["grid_bits"], h["sh_degree"], h["layer_count"])
    data += b"".join(struct.pack(">I", count) for count in h["layer_counts"])
    data += bytes([h["tile_side_log2"], len(h["channels"])])
    for attribute, pairs in h["channels"]:
        data += bytes([attribute]) + b"".join(struct.pack(">ff", *pair) for pair in pairs)
    data += bytes(9) + bytes(h.get("shifts", b""))  # scale_exponents of 0
    data += b"".join(struct.pack(">ff8x", *channel) for channel in h.get("companding", ()))
    data += bytes([len(h["trajectories"])]) + b"".join(struct.pack(">BHf", *t) for t in h["trajectories"])
    data += struct.pack(">I", h["node_count"])
    if h["node_count"]:
        data += struct.pack(
            ">BHff", *(h[k] for k in ("neighbors", "coefficients", "rotation_step", "translation_step"))
        )
    data += struct.pack(">Bff", *h["rig"]) if "rig" in h else b""
    cells = 4 ** max(h["tile_side_log2"], 4)
    bounds = b"".join(struct.pack(">H", v) for v in h["bounds"])
    return data + bounds * sum(-(-count // cells) for count in h["layer_counts"] if count < 2**24)


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


def poke_duration(frame_duration, wrong):
    data = groups_file(base_group(), fps=(30000, frame_duration))
    return poke(data, data.index(b"trun") + 16, u32(wrong))


def poke_time(frame_duration, wrong):
    data = groups_file(base_group(), fps=(30000, frame_duration))
    return poke(data, data.index(b"tfdt") + 8, struct.pack(">Q", wrong))
