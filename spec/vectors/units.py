"""Changes single units of groups.

The edits work on the bytes, with the reference decoder's parser, since an encoder would never write what they make.
"""

import struct
import sys
import zlib
from pathlib import Path

from files import CAMERA, groups_file, make_file, poke, split_boxes, u32
from groups import encode, layered, make_group, predicted, two_trees

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import reference_decoder as reference


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
    """A deaths unit of the base group with other contents."""
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
    """Positions of two trees with another first_size."""
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
    data += bytes(9) + bytes(h.get("shifts", b""))  # scale_exponents of 0
    data += b"".join(struct.pack(">ff8x", *channel) for channel in h.get("companding", ()))
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
