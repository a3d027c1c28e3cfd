"""Writes files of payloads with the package's muxer, and changes single boxes of files."""

import struct
import sys
from pathlib import Path

import numpy as np
from groups import encode, make_group

from gscodec import _native

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from reference_container import boxes

CONFIG = {
    "level": 1,
    "fps": (30, 1),
    "metres_per_unit": 1.0,
    "up": "y",
    "color_space": "srgb",
    "background": [0.0, 0.0, 0.0],
    "sh_degree": 0,
    "cameras": [],
}


def poke(data, at, new):
    return data[:at] + new + data[at + len(new) :]


def f32(value):
    return struct.pack(">f", value)


def u32(value):
    return struct.pack(">I", value)


def make_file(payloads, *, finish=True, sound=(), **config):
    """payloads: [(bytes, frames)], a third item of False: not a sync sample -> bytes of a .gsv file. `sound`: of each
    group as `fragment` takes it."""
    config = CONFIG | config
    init = bytes(_native.init_segment(config))
    fragments, start = [], 0
    payloads = [(*p, True)[:3] for p in payloads]
    for number, (payload, frames, sync) in enumerate(payloads, 1):
        audio = sound[number - 1] if number <= len(sound) else None
        fragments.append(bytes(_native.fragment(payload, number, start, frames, sync, config, audio)))
        start += frames
    if finish:
        index = [(len(f), n, s, []) for f, (_, n, s) in zip(fragments, payloads, strict=True)]
        init = bytes(_native.finish(init, [index]))
    return init + b"".join(fragments)


def groups_file(*groups, **options):
    return make_file([(encode(group), group.frames) for group in groups], **options)


def sound_file(kind=b"Opus", decoder=b"dOps", entry=b"", **options):
    """Two groups of which the first has three samples of what claims to be sound."""
    head = bytes(6) + b"\0\1" + bytes(8) + b"\0\2\0\x10" + bytes(4) + u32(48000 << 16)  # AudioSampleEntry
    entry = box(kind, head + box(decoder, bytes(11)) + entry)
    audio = {"timescale": 48000, "media_start": 312, "entry": entry}
    sound = [(0, [(4, 960), (1, 960), (6, 480)], b"samplesound")]
    return groups_file(make_group(30, 2), make_group(20, 1, seed=2), audio=audio, sound=sound, **options)


def sound_patched(kind, offset, new, which=1):
    """`sound_file` with bytes changed at an offset from the body of a box of a type, the last one or number `which`."""

    def build():
        data, at = sound_file(), -1
        for _ in range(which + 1):
            at = data.index(kind, at + 1)
        return poke(data, at + 4 + offset, new)

    return build


def before_mdat():
    """The first sample of the sound is 20 bytes longer, and starts so many before: in front of the mdat."""
    data = sound_file()
    at = data.index(b"trun", data.index(b"trun") + 4) + 4
    (offset,) = struct.unpack_from(">I", data, at + 8)
    return poke(poke(data, at + 8, u32(offset - 20)), at + 16, u32(24))


def box(kind, body):
    return struct.pack(">I4s", 8 + len(body), kind) + body


def split_boxes(data):
    """[(type, bytes)] of the top-level boxes."""
    return [(kind, data[start:end]) for kind, start, _, end in boxes(data, 0, len(data), top_level=True)]


def shift_data(moof, by):
    """The moof with its data offset increased by `by`, for bytes between it and the sample."""
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


def second_trun(data, which):
    """The file with the trun number `which` of its first moof written twice in its traf; its samples stay in place."""
    parts = split_boxes(data)
    at = next(i for i, (kind, _) in enumerate(parts) if kind == b"moof")
    inner, result, number = parts[at][1][8:], b"", 0
    for kind, start, body, end in boxes(inner, 0, len(inner)):
        whole = inner[start:end]
        if kind == b"traf":
            trun = whole[whole.index(b"trun") - 4 :]  # the last box of a traf
            whole = box(b"traf", inner[body:end] + trun) if number == which else whole
            number += 1
        result += whole
    moof = box(b"moof", result)
    grown, position = len(moof) - len(parts[at][1]), -1
    while (position := moof.find(b"trun", position + 1)) >= 0:
        place = position + 12
        moof = poke(moof, place, struct.pack(">i", struct.unpack_from(">i", moof, place)[0] + grown))
    return b"".join(whole if i != at else moof for i, (_, whole) in enumerate(parts))


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
CAMERA["near"] = 0.75
CAMERA["viewmat"] = np.array([[0, 0, 1, 0.5], [1, 0, 0, -2], [0, 1, 0, 3], [0, 0, 0, 1.0]])

# ---- Tracks ---------------------------------------------------------------------------------------------------------

TURN = (0.8, 0.0, 0.36, 0.48)
PLACED = {
    "name": "Männlein",
    "hidden": False,
    "offset": -500,
    "repeats": 0,
    "keys": [(-300, (1.0, 0.0, 0.0, 0.0), (0.5, 0.0, -1.0), 1.0), (1700, TURN, (-0.25, 2.0, 0.0), 2.5)],
}


def scene_file(*tracks, finish=True, change=lambda parts: parts):
    """tracks: (groups, config) of each -> bytes of a file. `change`: of the top-level boxes."""
    configs = [CONFIG | config | {"track": k} for k, (_, config) in enumerate(tracks)]
    init = bytes(_native.init_segment(configs[0], configs[1:]))
    fragments, indices, number = b"", [], 0
    for (groups, _), config in zip(tracks, configs, strict=True):
        start, index = 0, []
        for group in groups:
            number += 1
            fragment = bytes(_native.fragment(encode(group), number, start, group.frames, True, config))
            index.append((len(fragment), group.frames, True, []))
            fragments, start = fragments + fragment, start + group.frames
        indices.append(index)
    data = (bytes(_native.finish(init, indices)) if finish else init) + fragments
    return b"".join(whole for _, whole in change(split_boxes(data)))


def two_tracks(**options):
    """A track at 30 frames a second, and one at 25 that is placed and repeated, with SH of degree 3."""
    second = {"sh_degree": 3, "fps": (1000, 40), "placement": PLACED}
    return scene_file(
        (
            [make_group(40, 3, nodes=4), make_group(30, 2, seed=2)],
            {"placement": PLACED | {"name": "room", "offset": 0, "keys": []}},
        ),
        ([make_group(25, 4, seed=3, sh_degree=3, trajectories={"shN": 2})], second),
        **options,
    )


def alternating(parts):
    """The fragments of two tracks in turn: of the first, the second, the first."""
    *head, a, b, c, d, e, f = parts
    return [*head, a, b, e, f, c, d]


def tracks_patched(offset, new, kind=b"gsvT", which=1):
    """`two_tracks` with bytes changed at an offset from the body of a box of a type, the last one or number `which`."""

    def build():
        data, at = two_tracks(finish=False), -1
        for _ in range(which + 1):
            at = data.index(kind, at + 1)
        return poke(data, at + 4 + offset, new)

    return build


def many_tracks():
    return scene_file(*[([], {})] * 65, finish=False)
