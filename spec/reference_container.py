"""Clauses 1 and 2 of gsv.md for the reference decoder: fields, errors, and the container.

In: the bytes of a .gsv file. Out: its configuration and the samples, one per group.
"""

import math
import struct
from dataclasses import dataclass, field

import numpy as np


class BitstreamError(Exception):
    """The bytes break a rule of gsv.md (clause 1); tools without a decoding process yet are named "unsupported"."""


class LimitError(Exception):
    """The bytes exceed the caps of their level (clause 5)."""


def require(condition, message):
    if not condition:
        raise BitstreamError(message)


# ---- 1. Conventions -------------------------------------------------------------------------------------------------


class Reader:
    """Big-endian fields of data[position:end]; `what` names the structure in errors."""

    def __init__(self, data, position, end, what):
        self.data, self.position, self.end, self.what = data, position, end, what

    def take(self, count):
        require(
            self.end - self.position >= count, f"{self.what}: truncated at byte {self.position}, {count} more expected"
        )
        self.position += count
        return bytes(self.data[self.position - count : self.position])

    def unpack(self, code):
        return struct.unpack(">" + code, self.take(struct.calcsize(">" + code)))[0]

    def u8(self):
        return self.unpack("B")

    def u16(self):
        return self.unpack("H")

    def u32(self):
        return self.unpack("I")

    def u64(self):
        return self.unpack("Q")

    def i32(self):
        return self.unpack("i")

    def f32(self, name, positive=False):
        value = self.unpack("f")
        require(math.isfinite(value), f"{self.what}: {name} is {value}, expected a finite number")
        require(value > 0 or not positive, f"{self.what}: {name} is {value}, expected > 0")
        return value


def clip(x, lo, hi):
    return lo if x < lo else hi if x > hi else x


LEVELS = {  # clause 5: N, frames, nodes, symbols, bytes of a group
    1: (65536, 64, 1024, 2**23, 2**24),
    2: (262144, 128, 4096, 2**25, 2**26),
    3: (1048576, 256, 16384, 2**27, 2**28),
    4: (4194304, 256, 65536, 2**29, 2**30),
}


PAIRS = {1: 2**26, 2: 2**28, 3: 2**30, 4: 2**32}  # clause 5: N M


# ---- 2. Container ---------------------------------------------------------------------------------------------------

HEADER_BOXES = (b"ftyp", b"moov", b"sidx", b"ssix", b"moof")  # of the top level


def boxes(data, position, end, top_level=False):
    """Yields (type, offset, body, end) of each box. A truncated top-level box is left out, unless it is an mdat."""
    while position < end:
        offset, header = position, 8
        if end - offset < header:
            require(top_level, f"box at byte {offset}: {end - offset} bytes left, expected a header of 8")
            return
        size, kind = struct.unpack_from(">I4s", data, offset)
        if size == 1:
            header = 16
            if end - offset < header:
                require(top_level, f"box {kind!r} at byte {offset}: no room for largesize")
                return
            size = struct.unpack_from(">Q", data, offset + 8)[0]
        elif size == 0:
            require(kind == b"mdat" and top_level, f"box {kind!r} at byte {offset}: size 0 is for mdat only")
            size = 2**64  # to the end of the file, which may still grow
        elif offset + size >= 2**64:
            raise BitstreamError(f"box {kind!r} at byte {offset}: size {size}, expected an end below 2^64")
        require(size >= header, f"box {kind!r} at byte {offset}: size {size} is less than its header")
        if top_level and kind in HEADER_BOXES and size - header > 2**24:
            raise LimitError(f"box {kind!r} at byte {offset}: {size} bytes, at most 16 MiB are allowed")
        if offset + size > end and not (top_level and kind == b"mdat"):
            require(top_level, f"box {kind!r} at byte {offset}: {size} bytes, but its container ends at {end}")
            return
        yield kind, offset, offset + header, offset + size
        position = offset + size


def find_box(data, box, path):
    """First box at a path of types inside `box`, or None."""
    for wanted in path:
        children = list(boxes(data, box[2], box[3]))  # all of them: each must be well formed
        box = next((child for child in children if child[0] == wanted), None)
        if box is None:
            return None
    return box


def find_leniently(data, box, path):
    """`find_box`, but None also if a box on the path is malformed: readers ignore that track."""
    try:
        return find_box(data, box, path)
    except BitstreamError:
        return None


def open_box(data, box, path):
    """Reader of the body of a box that must exist."""
    found = find_box(data, box, path)
    name = b"/".join(path).decode()
    require(found is not None, f"{box[0].decode()} at byte {box[1]}: no {name}")
    return Reader(data, found[2], found[3], name)


@dataclass
class Config:
    """gsvC (clause 2.3), and the fields of the track that the fragments need."""

    level: int
    frame_duration: int
    metres_per_unit: float
    up_axis: int
    color_space: int
    background: list
    sh_degree: int
    cameras: list
    timescale: int = 0
    track_id: int = 0
    defaults: dict = field(default_factory=dict)  # in trex: duration, size, flags
    audio: "Audio | None" = None
    placement: "Placement" = field(default_factory=lambda: Placement())
    tracks: int = 1  # gsv tracks of the file


@dataclass
class Placement:
    """gsvT (clause 2.8)."""

    hidden: bool = False
    name: str = ""
    offset: int = 0
    repeats: int = 1
    keys: list = field(default_factory=list)  # (time, rotation [4], translation [3], scale)


@dataclass
class Audio:
    """The audio track (clause 2.7)."""

    track_id: int
    timescale: int
    media_start: int
    entry: bytes  # a whole box
    defaults: dict


@dataclass
class Sample:
    """One group in the container (clause 2.4)."""

    start_frame: int
    frames: int
    sync: bool
    payload: bytes
    audio: tuple | None = None  # (media time, [(size, duration)], bytes)


def read_container(data, track=0):
    """Clause 2: bytes of a file -> (Config, [Sample]) of one of its gsv tracks."""
    config, pending, samples, first = None, [], [], True
    require(
        len(data) < 8 or data[4:8] == b"ftyp", f"the first box is {bytes(data[4:8])!r}, expected ftyp: not a gsv file"
    )
    for box in boxes(data, 0, len(data), top_level=True):
        kind, offset, body, end = box
        if first:
            read_ftyp(data, body, end)
        elif kind == b"moov":
            require(config is None, f"second moov at byte {offset}")
            config = read_moov(data, box, track)
        elif kind == b"moof":
            require(config is not None, f"moof at byte {offset} before moov")
            require(not pending, f"moof at byte {offset}: the mdat of the one before is missing")
            pending = read_moof(data, box, config)
        elif kind == b"mdat":
            for start, size, *timing, audio in pending:
                at = start if audio is None else start - sum(size for size, _ in audio[1])
                require(body <= at and start + size <= end, f"sample at byte {at}: outside the next mdat")
                if start + size <= len(data):
                    audio = audio and (*audio, bytes(data[at:start]))
                    samples.append(Sample(*timing, bytes(data[start : start + size]), audio))
            pending = []
        first = False
    require(config is not None, "no moov box: not a whole gsv file")
    return config, samples


def read_ftyp(data, body, end):
    """Clause 2.1."""
    reader = Reader(data, body, end, "ftyp")
    brands = [reader.take(4) for _ in range((end - body) // 4)]
    require(b"gsv1" in brands[:1] + brands[2:], f"ftyp: brands {brands} (and version), expected gsv1")


def tracks(data, moov, handler):
    """The tracks of a handler."""
    for trak in list(boxes(data, moov[2], moov[3])):
        hdlr = find_leniently(data, trak, [b"mdia", b"hdlr"]) if trak[0] == b"trak" else None
        if hdlr is not None and data[hdlr[2] + 8 : min(hdlr[3], hdlr[2] + 12)] == handler:
            yield trak


def read_moov(data, moov, track):
    """Clause 2.2: a track of handler `volv`, and with the first one the audio track."""
    found = list(tracks(data, moov, b"volv"))
    if len(found) > 64:
        raise LimitError(f"moov: {len(found)} tracks, at most 64 are allowed")
    require(track < len(found), f"moov: no track {track} with handler volv, found {len(found)}")
    trak = found[track]
    track_id, timescale = read_timed(data, trak, [b"tkhd"]), read_timed(data, trak, [b"mdia", b"mdhd"])
    require(timescale > 0, "mdhd: timescale is 0")
    config = read_sample_entry(data, trak)
    config.track_id, config.timescale = track_id, timescale
    config.defaults = read_defaults(data, moov, track_id)
    config.tracks = len(found)
    for other in found:
        own = read_timed(data, other, [b"tkhd"]) if other is not trak and find_box(data, other, [b"tkhd"]) else None
        require(own != track_id, f"tkhd: two tracks have the track_ID {track_id}")
    config.audio = read_audio_track(data, moov) if track == 0 else None
    return config


def read_defaults(data, moov, track_id):
    """Clause 2.2: duration, size and flags in trex."""
    mvex = find_box(data, moov, [b"mvex"])
    for box in boxes(data, mvex[2], mvex[3]) if mvex else ():
        reader = Reader(data, box[2], box[3], "trex")
        if box[0] == b"trex" and (reader.u32(), reader.u32())[1] == track_id:
            reader.u32()  # default_sample_description_index
            return {name: reader.u32() for name in ("duration", "size", "flags")}
    return {"duration": 0, "size": 0, "flags": 0}


def read_audio_track(data, moov):
    """Clause 2.7, moov; None if there is none."""
    for trak in tracks(data, moov, b"soun"):
        stsd = find_leniently(data, trak, [b"mdia", b"minf", b"stbl", b"stsd"])
        entry = next(iter(list(boxes(data, stsd[2] + 8, stsd[3])) if stsd else ()), None)
        if entry is None or entry[0] not in (b"mp4a", b"Opus"):
            continue
        kind, offset, body, end = entry
        if end - offset > 4096:
            raise LimitError(f"sample entry at byte {offset}: {end - offset} bytes, at most 4096 are allowed")
        open_box(data, (kind, offset, body + 28, end), [b"esds" if kind == b"mp4a" else b"dOps"])
        timescale = read_timed(data, trak, [b"mdia", b"mdhd"])
        require(timescale > 0, "audio track, mdhd: timescale is 0")
        track_id, media_start = read_timed(data, trak, [b"tkhd"]), 0
        if find_box(data, trak, [b"edts", b"elst"]):
            elst = open_box(data, trak, [b"edts", b"elst"])
            long, count = elst.u32() >> 24 == 1, elst.u32()
            media_start = (elst.u64(), elst.u64())[1] if long else (elst.u32(), elst.u32())[1]
            require(count == 1 and media_start < 2**31, f"elst: {count} edits at {media_start}, expected one edit")
        return Audio(track_id, timescale, media_start, bytes(data[offset:end]), read_defaults(data, moov, track_id))
    return None


def read_timed(data, trak, path):
    """track_ID of tkhd, timescale of mdhd: the u32 after version, flags, creation and modification time."""
    reader = open_box(data, trak, path)
    reader.take(16 if reader.u32() >> 24 == 1 else 8)
    return reader.u32()


def read_sample_entry(data, trak):
    """Clause 2.2: stsd with the entry gsv1, and in it gsvC."""
    reader = open_box(data, trak, [b"mdia", b"minf", b"stbl", b"stsd"])
    reader.take(8)  # version, flags, entry_count
    entry = next((e for e in list(boxes(data, reader.position, reader.end)) if e[0] == b"gsv1"), None)
    require(entry is not None, "stsd: no sample entry gsv1")
    Reader(data, entry[2], entry[3], "gsv1").take(40)
    kind, offset, body, end = entry
    inside = (kind, offset, body + 40, end)
    config = read_gsvc(open_box(data, inside, [b"gsvC"]))
    if find_box(data, inside, [b"gsvT"]):
        config.placement = read_gsvt(open_box(data, inside, [b"gsvT"]))
    return config


def read_gsvt(r):
    """Clause 2.8."""
    flags, name = r.u8(), r.take(r.u8())
    try:
        name = name.decode()
    except UnicodeDecodeError:
        raise BitstreamError(f"gsvT: track name {name!r} is not UTF-8, expected track names in UTF-8") from None
    offset, repeats, keys = r.i32(), r.u32(), []
    for _ in range(r.u16()):
        time, rotation = r.i32(), np.array([r.f32("rotation") for _ in range(4)])
        length = (rotation**2).sum()
        require(0.998 <= length <= 1.002, f"gsvT: a rotation whose squared length is {length}, expected 0.998 to 1.002")
        translation, scale = np.array([r.f32("translation") for _ in range(3)]), r.f32("scale", positive=True)
        require(not keys or time > keys[-1][0], f"gsvT: time {time}, expected keys in the order of their times")
        keys.append((time, rotation / np.sqrt(length), translation, scale))
    return Placement(bool(flags & 1), name, offset, repeats, keys)


def read_gsvc(r):
    """Clause 2.3."""
    version = r.u8()
    require(version == 4, f"gsvC: configuration_version is {version}, expected 4")
    level, frame_duration = r.u8(), r.u32()
    if level not in LEVELS:
        raise LimitError(f"gsvC: level is {level}, expected 1 to {max(LEVELS)}")
    require(frame_duration > 0, "gsvC: frame_duration is 0")
    metres_per_unit = r.f32("metres_per_unit", positive=True)
    up_axis, color_space = r.u8(), r.u8()
    require(up_axis <= 5, f"gsvC: up_axis is {up_axis}, expected 0 to 5")
    require(color_space == 0, f"gsvC: color_space is {color_space}, expected 0")
    background = [r.f32("background") for _ in range(3)]
    require(all(0 <= b <= 1 for b in background), f"gsvC: background is {background}, expected 0 to 1")
    sh_degree, reserved = r.u8(), r.u8()
    require(sh_degree <= 3, f"gsvC: sh_degree is {sh_degree}, expected 0 to 3")
    require(reserved <= 1, f"gsvC: reserved is {reserved}, expected 0 or 1")
    cameras = []
    for _ in range(r.u16()):
        name = r.take(r.u8())
        try:
            camera = {"name": name.decode()}
        except UnicodeDecodeError:
            raise BitstreamError(f"gsvC: camera name {name!r} is not UTF-8") from None
        camera["width"], camera["height"] = r.u32(), r.u32()
        require(camera["width"] > 0 and camera["height"] > 0, "gsvC: a camera has no pixels")
        fx, skew, cx, fy, cy = (r.f32("camera matrix") for _ in range(5))
        camera["K"] = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
        camera["viewmat"] = np.array([r.f32("viewmat") for _ in range(12)] + [0, 0, 0, 1]).reshape(4, 4)
        cameras.append(camera | {"near": 0.01})
    if r.position < r.end:
        for camera in cameras:
            camera["near"] = r.f32("near", positive=True)
    return Config(level, frame_duration, metres_per_unit, up_axis, color_space, background, sh_degree, cameras)


def read_trafs(data, moof, track_id, defaults):
    """Clause 2.4: yields (base, defaults, time, trun) of each traf of a track."""
    for traf in list(boxes(data, moof[2], moof[3])):
        if traf[0] != b"traf":
            continue
        tfhd = open_box(data, traf, [b"tfhd"])
        flags, found = tfhd.u32() & 0xFFFFFF, tfhd.u32()
        if found != track_id:
            continue
        own = dict(defaults)
        base = tfhd.u64() if flags & 0x01 else moof[1]
        if flags & 0x02:
            tfhd.u32()  # sample_description_index
        for bit, name in ((0x08, "duration"), (0x10, "size"), (0x20, "flags")):
            if flags & bit:
                own[name] = tfhd.u32()
        tfdt = open_box(data, traf, [b"tfdt"])
        time = tfdt.u64() if tfdt.u32() >> 24 == 1 else tfdt.u32()
        truns = sum(box[0] == b"trun" for box in boxes(data, traf[2], traf[3]))
        require(truns <= 1, f"moof at byte {moof[1]}: {truns} trun of a track, expected one, of one sample or of sound")
        yield base, own, time, open_box(data, traf, [b"trun"])


def read_moof(data, moof, config):
    """Clause 2.4: [(offset, size, start_frame, frames, sync, audio)] of the gsv track: none or one."""
    found = next(read_trafs(data, moof, config.track_id, config.defaults), None)
    if found is None:
        return []
    base, sample, time, trun = found
    flags, count = trun.u32() & 0xFFFFFF, trun.u32()
    require(count == 1, f"moof at byte {moof[1]}: {count} samples, expected 1")
    start = base + (trun.i32() if flags & 0x001 else 0)
    if flags & 0x004:
        sample["flags"] = trun.u32()  # first_sample_flags
    for bit, name in ((0x100, "duration"), (0x200, "size"), (0x400, "flags")):
        if flags & bit and not (name == "flags" and flags & 0x004):
            sample[name] = trun.u32()
    frames, rest = divmod(sample["duration"], config.frame_duration)
    require(
        rest == 0 and frames >= 1,
        f"moof at byte {moof[1]}: duration {sample['duration']} is not a number of frames",
    )
    start_frame, rest = divmod(time, config.frame_duration)
    require(rest == 0, f"moof at byte {moof[1]}: decode time {time} is not a number of frames")
    audio = read_sound(data, moof, config.audio, start) if config.audio else None
    return [(start, sample["size"], start_frame, frames, not sample["flags"] >> 16 & 1, audio)]


def read_sound(data, moof, audio, group):
    """Clause 2.7: (media time, [(size, duration)]) of the audio samples in front of a group, None without samples."""
    for base, defaults, time, trun in read_trafs(data, moof, audio.track_id, audio.defaults):
        start, samples = read_run(trun, base, defaults)
        end = start + sum(size for size, _ in samples)
        fits = not samples or end == group
        require(fits, f"moof at byte {moof[1]}: sound ends at byte {end}, expected where the group starts")
        if samples:
            return time, samples
    return None


def read_run(trun, base, defaults):
    """Clause 2.7: offset of the first sample in an audio trun, and [(size, duration)]."""
    flags, count = trun.u32() & 0xFFFFFF, trun.u32()
    if count > 65536:
        raise LimitError(f"traf of the audio track: {count} samples, at most 65536 are allowed")
    start, samples = base + (trun.i32() if flags & 0x001 else 0), []
    if flags & 0x004:
        trun.u32()  # first_sample_flags
    for _ in range(count):
        duration = trun.u32() if flags & 0x100 else defaults["duration"]
        size = trun.u32() if flags & 0x200 else defaults["size"]
        trun.take(4 * (flags >> 10 & 3).bit_count())  # flags, composition offset
        require(
            size > 0 and duration > 0, f"trun: a sample of {size} bytes, {duration} units, expected at least one byte"
        )
        samples.append((size, duration))
    return start, samples
