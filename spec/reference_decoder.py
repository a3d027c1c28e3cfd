"""Reference decoder of the gsv bitstream: the second implementation, written from gsv.md alone and in its order.

In: the bytes of a .gsv file. Out: for each group the decoded integers, exactly, and any frame of it in float64.
It imports numpy and the standard library only, keeps the names of gsv.md, and prefers being read to being fast:
entropy decoding works on Python integers, bin after bin. Strict: one damaged unit makes the group a BitstreamError.
Clauses 1 and 2 are in reference_container.py.

    python spec/reference_decoder.py FILE.gsv [--npz OUT.npz]     prints the conformance hash (clause 16) of each group
"""

import argparse
import hashlib
import struct
import sys
import zlib
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reference_container import LEVELS, BitstreamError, LimitError, Reader, clip, read_container, require

# ---- 3. Group payload -----------------------------------------------------------------------------------------------

GROUP_HEADER, POSITIONS, CHANNELS, LIFETIMES, NODE_POSITIONS, NODE_TRAJECTORIES, TRAJECTORIES = range(7)
KNOWN = range(10)
RESERVED = {7: "step_classes", 8: "deaths", 9: "layer_correction"}
MUST_DEPEND_ON = {CHANNELS: POSITIONS, LIFETIMES: POSITIONS, NODE_TRAJECTORIES: NODE_POSITIONS, TRAJECTORIES: POSITIONS}
MEANS, LOG_SCALES, QUATS, LOGIT_OPACITIES, SH0, SHN = range(1, 7)
ATTRIBUTES = {1: "means", 2: "log_scales", 3: "quats", 4: "logit_opacities", 5: "sh0", 6: "shN"}


def channel_count(attribute, sh_degree):
    """Clause 3.2: C."""
    return {LOGIT_OPACITIES: 1, SHN: 3 * ((sh_degree + 1) ** 2 - 1)}.get(attribute, 3)


@dataclass
class Unit:
    unit_type: int
    layer: int
    attribute: int
    dependencies: list
    payload: bytes

    def key(self):
        return self.unit_type, self.layer, self.attribute


def read_units(payload):
    """Clause 3: the units of a group, with all rules that do not need the group header."""
    units = []
    reader = Reader(payload, 0, len(payload), "unit 0")
    while reader.position < reader.end:
        index, start = len(units), reader.position
        reader.what = f"unit {index}"
        require(index < 255, f"more than 255 units in the group, byte {start}")
        unit_type, layer, attribute = reader.u8(), reader.u8(), reader.u8()
        dependencies = list(reader.take(reader.u8()))
        length = reader.u32()
        covered = bytes(payload[start : reader.position])
        crc = reader.u32()
        body = reader.take(length)
        require(zlib.crc32(covered + body) == crc, f"unit {index} at byte {start}: wrong CRC, the unit is damaged")
        increasing = dependencies == sorted({d for d in dependencies if d < index})
        require(increasing, f"unit {index}: dependencies {dependencies} are not increasing indices below {index}")
        require(not units or units[-1].layer <= layer, f"unit {index}: layer {layer} after a higher one")
        unit = Unit(unit_type, layer, attribute, dependencies, body)
        second = unit_type in KNOWN and any(unit.key() == u.key() for u in units)
        require(not second, f"unit {index}: second unit of (type, layer, attribute) {unit.key()}")
        units.append(unit)
    require(units and units[0].key() == (GROUP_HEADER, 0, 0), "unit 0 is not the group header")
    return units


def check_units(units, header):
    """Clause 3.1: all that the header announces is there, and nothing else -> {(type, attribute): payload}."""
    required = {(GROUP_HEADER, 0), (POSITIONS, 0)}
    required |= {(CHANNELS, a) for a in header.channels} | {(TRAJECTORIES, a) for a in header.trajectories}
    required |= {(NODE_POSITIONS, 0), (NODE_TRAJECTORIES, 0)} if header.node_count else set()
    found = {}
    for index, unit in enumerate(units):
        require(unit.unit_type not in RESERVED, f"unit {index}: unsupported tool {RESERVED.get(unit.unit_type)}")
        if unit.unit_type > TRAJECTORIES:
            continue  # unknown: skipped
        key = unit.unit_type, unit.attribute
        announced = key in required or key == (LIFETIMES, 0)
        require(
            announced and unit.layer == 0,
            f"unit {index}: (type, layer, attribute) {unit.key()} is not announced by the header",
        )
        needed = MUST_DEPEND_ON.get(unit.unit_type)
        on = [units[d].unit_type for d in unit.dependencies]
        require(needed is None or needed in on, f"unit {index}: must depend on the unit of type {needed}")
        found[key] = unit.payload
    require(required <= found.keys(), f"missing unit (type, attribute) {sorted(required - found.keys())}")
    return found


# ---- 4. Group header ------------------------------------------------------------------------------------------------


@dataclass
class Header:
    frames: int
    origin: list
    grid_step: float
    grid_bits: int
    sh_degree: int
    count: int  # N
    channels: dict  # attribute -> (steps, offsets)
    trajectories: dict  # attribute -> (K_a, step)
    node_count: int = 0
    neighbors: int = 0
    node_coefficients: int = 0
    rotation_step: float = 0.0
    translation_step: float = 0.0


def read_group_header(payload):
    """Clause 4."""
    r = Reader(payload, 0, len(payload), "group_header")
    frames, flags = r.u16(), r.u8()
    require(frames >= 1, "group_header: frames is 0")
    require(flags < 4, f"group_header: flags are {flags:#x}, bits 2 to 7 must be 0")
    require(not flags & 1, "group_header: unsupported tool predicted")
    require(not flags & 2, "group_header: unsupported tool step_classes")
    origin = [r.f32("origin") for _ in range(3)]
    grid_step = r.f32("grid_step", positive=True)
    grid_bits, sh_degree, layer_count = r.u8(), r.u8(), r.u8()
    require(1 <= grid_bits <= 21, f"group_header: grid_bits is {grid_bits}, expected 1 to 21")
    require(sh_degree <= 3, f"group_header: sh_degree is {sh_degree}, expected 0 to 3")
    require(layer_count >= 1, "group_header: layer_count is 0")
    require(layer_count == 1, f"group_header: unsupported tool layers (layer_count is {layer_count})")
    count, map_width_log2 = r.u32(), r.u8()
    width = expected_map_width_log2(count)
    require(map_width_log2 == width, f"group_header: map_width_log2 is {map_width_log2}, expected {width}")
    expected = [LOG_SCALES, QUATS, LOGIT_OPACITIES, SH0, SHN][: 5 if sh_degree else 4]
    attribute_count, channels = r.u8(), {}
    require(
        attribute_count == len(expected),
        f"group_header: attribute_count is {attribute_count}, expected {len(expected)}",
    )
    for wanted in expected:
        attribute = r.u8()
        require(attribute == wanted, f"group_header: attribute is {attribute}, expected {wanted}")
        pairs = [(r.f32("step", positive=True), r.f32("offset")) for _ in range(channel_count(attribute, sh_degree))]
        channels[attribute] = [step for step, _ in pairs], [offset for _, offset in pairs]
    trajectories, last = {}, 0
    for _ in range(r.u8()):
        attribute, coefficients = r.u8(), r.u16()
        valid = last < attribute <= (SHN if sh_degree else SH0)
        require(valid, f"group_header: trajectories of attribute {attribute} after {last} at sh_degree {sh_degree}")
        require(1 <= coefficients <= frames, f"group_header: {coefficients} coefficients, expected 1 to {frames}")
        trajectories[attribute] = coefficients, r.f32("trajectory step", positive=True)
        last = attribute
    header = Header(frames, origin, grid_step, grid_bits, sh_degree, count, channels, trajectories, r.u32())
    if header.node_count:
        header.neighbors, header.node_coefficients = r.u8(), r.u16()
        require(1 <= header.neighbors <= 8, f"group_header: neighbors is {header.neighbors}, expected 1 to 8")
        valid = 1 <= header.node_coefficients <= frames
        require(valid, f"group_header: {header.node_coefficients} node coefficients, expected 1 to {frames}")
        header.rotation_step = r.f32("rotation_step", positive=True)
        header.translation_step = r.f32("translation_step", positive=True)
    require(r.position == r.end, f"group_header: {r.end - r.position} bytes left over")
    return header


# ---- 5. Levels ------------------------------------------------------------------------------------------------------


class Budget:
    """Symbols of a group, counted against the level before they are decoded."""

    def __init__(self, level):
        self.level, self.cap, self.symbols = level, LEVELS[level][3], 0

    def spend(self, symbols):
        self.symbols += symbols
        limit(self.symbols, self.cap, "symbols", self.level)


def limit(value, cap, name, level):
    if value > cap:
        raise LimitError(f"{value} {name} in the group, level {level} allows {cap}")


def check_limits(header, level):
    """Clause 5, all that follows from the header; returns the budget for the coefficient values."""
    for value, cap, name in zip(
        (header.count, header.frames, header.node_count), LEVELS[level], ("Gaussians", "frames", "nodes"), strict=False
    ):
        limit(value, cap, name, level)
    budget = Budget(level)
    channels = sum(len(steps) for steps, _ in header.channels.values())
    budget.spend((3 + channels + len(header.trajectories)) * header.count)
    budget.spend((3 + 6 * header.node_coefficients) * header.node_count)
    return budget


# ---- 6. Entropy decoder ---------------------------------------------------------------------------------------------


class RangeDecoder:
    """Clause 6.1."""

    def __init__(self, payload, what):
        self.payload, self.what = payload, what
        self.range, self.code, self.position = 0xFFFFFFFF, int.from_bytes(payload[:4].ljust(4, b"\0"), "big"), 4

    def byte(self):
        self.position += 1
        require(self.position <= len(self.payload) + 4, f"{self.what}: {len(self.payload)} bytes, but more are needed")
        return self.payload[self.position - 1] if self.position <= len(self.payload) else 0

    def decode(self, p):
        bound = (self.range * p) >> 16
        if self.code < bound:
            bin, self.range = 1, bound
        else:
            bin, self.range, self.code = 0, self.range - bound, self.code - bound
        while self.range < 1 << 24:
            self.range, self.code = self.range << 8, (self.code << 8) | self.byte()
        return bin

    def bits(self, n):
        v = 0
        for _ in range(n):
            v = 2 * v + self.decode(32768)
        return v

    def finish(self):
        left = len(self.payload) - self.position
        require(left <= 0, f"{self.what}: {left} bytes left over after the last bin")


KNOTS = [
    *(32768, 40793, 47911, 53581, 57724, 60565, 62428, 63615, 64357, 64816, 65097, 65269, 65374),
    *(65438, 65476, 65500, 65514, 65523, 65528, 65531, 65533, 65534, 65535, 65535, 65536),
]


def curve(x):
    """Clause 6.3."""
    x = clip(x, -3071, 3071)
    i, f = abs(x) >> 7, abs(x) & 127
    p = (KNOTS[i] * (128 - f) + KNOTS[i + 1] * f + 64) >> 7
    return 65536 - p if x < 0 else p


def squash(x):
    return clip(curve(x), 16, 65520)


def stretch_table():
    """Clause 6.3; the curve never falls, so one sweep finds the smallest x of every entry."""
    table, x = [], -3071
    for i in range(4096):
        while curve(x) < 16 * i + 8:
            x += 1
        table.append(x)
    return table


STRETCH = stretch_table()
DIVISOR = [131072 // (2 * n + 3) for n in range(256)]
AGE = [0 if n < 4 else 1 if n < 16 else 2 if n < 64 else 3 for n in range(256)]


class Model:
    """Clauses 6.2 and 6.4: tables A and B of counters [p, n] and pairs of weights, made when first used."""

    def __init__(self, decoder):
        self.decoder = decoder
        self.A = defaultdict(lambda: [1 << 21, 0])
        self.B = defaultdict(lambda: [1 << 21, 0])
        self.weights = defaultdict(lambda: [26214, 26214])

    def mixed(self, a, b, w):
        ca, cb = self.A[a], self.B[b]
        sa, sb = STRETCH[ca[0] >> 10], STRETCH[cb[0] >> 10]
        wt = self.weights[16 * w + 4 * AGE[ca[1]] + AGE[cb[1]]]
        p = squash((wt[0] * sa + wt[1] * sb) >> 16)
        bin = self.decoder.decode(p)
        err = (65536 if bin else 0) - p
        wt[0] = clip(wt[0] + ((sa * err + 16384) >> 15), -262144, 262144)
        wt[1] = clip(wt[1] + ((sb * err + 16384) >> 15), -262144, 262144)
        target = (1 << 22) - 1 if bin else 0
        for counter in (ca, cb):
            counter[0] += ((target - counter[0]) * DIVISOR[counter[1]]) >> 16
            counter[1] = min(counter[1] + 1, 255)
        return bin


MAX_VALUE = 1 << 24
SPREAD_BUCKET = [0, 1, 2, 3, 3, 4, 4, *[5] * 3, *[6] * 5, *[7] * 10, *[8] * 16, 9]


class ValueModel(Model):
    """Clause 6.5."""

    def value(self, class_, near, prev1, prev2):
        s = sum(weight * v for weight, v in zip((4, 3, 2, 2), near, strict=False))
        g = sum((4, 3, 2, 2)[: len(near)])
        p = (2 * s + g) // (2 * g) if g else 0
        spread = SPREAD_BUCKET[min(sum(abs(v - p) for v in near), 41)]
        centre = p - clip(p, -7, 7)
        m = abs(p) if abs(p) <= 6 else min(7 + (abs(p) - 7) // 4, 11)
        a0 = ((class_ * 23 + 11 + (-m if p < 0 else m)) * 10 + spread) * 64
        b0 = (((class_ * 15 + clip(prev1, -7, 7) + 7) * 15 + clip(prev2, -7, 7) + 7) * 3 + clip(p, -1, 1) + 1) * 64

        def bin(j):
            return self.mixed(a0 + j, b0 + j, class_ * 64 + j)

        if not bin(0):
            return self.checked(centre)
        negative = bin(1)
        j, v = (18 if negative else 2), 0
        while v < 16 and bin(j + v):
            v += 1
        if v == 16:  # escape: Exp-Golomb
            e = 0
            while bin(34 + e):
                e += 1
                require(e <= 25, f"{self.decoder.what}: escape of more than 25 bits")
            v = 16 + (1 << e | self.decoder.bits(e)) - 1
        return self.checked(centre - v - 1 if negative else centre + v + 1)

    def checked(self, value):
        require(abs(value) <= MAX_VALUE, f"{self.decoder.what}: value {value} is outside -2^24 .. 2^24")
        return value


# ---- 7. Order and maps ----------------------------------------------------------------------------------------------


def morton_inverse(code):
    """Clause 7.1: code -> (x, y, z)."""
    return tuple(sum((code >> (3 * j + axis) & 1) << j for j in range(21)) for axis in (2, 1, 0))


def expected_map_width_log2(count):
    """Clause 7.2."""
    return (count.bit_length() - 1) >> 1 if count else 0


def find_neighbors(positions):
    """Clause 7.3: for each i up to four j < i, nearest first."""
    result = []
    for i, (x, y, z) in enumerate(positions):
        ranked = sorted(
            ((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2, i - j)
            for j, (px, py, pz) in enumerate(positions[max(0, i - 32) : i], max(0, i - 32))
        )
        result.append([i - back for _, back in ranked[:4]])
    return result


# ---- 8. Positions ---------------------------------------------------------------------------------------------------


def decode_positions(payload, count, grid_bits, what):
    """Clause 8: -> list of (x, y, z) in Morton order."""
    model = Model(RangeDecoder(payload, what))
    output, level = [], [(0, count)] if count else []
    for rest in range(grid_bits, 0, -1):
        cubes = [morton_inverse(code) for code, _ in level]
        counts = {cube: n for cube, (_, n) in zip(cubes, level, strict=True)}
        seen, following = {}, []  # cube -> points of its children, capped
        for (code, n), (x, y, z) in zip(level, cubes, strict=True):
            lower = (x - 1, y, z), (x, y - 1, z), (x, y, z - 1)
            upper = [counts.get(q, 0) for q in ((x + 1, y, z), (x, y + 1, z), (x, y, z + 1))]
            occupied = sum(q in counts for q in lower) + sum(u > 0 for u in upper)
            if n == 1 and occupied == 0:
                output.append(code << 3 * rest | model.decoder.bits(3 * rest))
                continue
            split = Splitter(model, occupied, rest)
            parts = split.children(n, [seen.get(q, [0] * 8) for q in lower], upper)
            seen[x, y, z] = [min(255, part) for part in parts]
            following += [(code << 3 | k, part) for k, part in enumerate(parts) if part]
        level = following
    for code, n in level:
        output += [code] * n
    model.decoder.finish()
    return [morton_inverse(code) for code in sorted(output)]


class Splitter:
    """Clause 8: children(node)."""

    def __init__(self, model, occupied, rest):
        self.model, self.occupied, self.rest = model, occupied, rest

    def children(self, count, lower, upper):
        (Lx, Ly, Lz), (Ux, Uy, Uz) = lower, upper
        n, own = [0] * 8, [0] * 8
        c = context(side(S(Ly, 4, 0), S(Ly, 4, 4)), side(S(Lz, 4, 0), S(Lz, 4, 4)), S(Lx, 4, 4), Ux)
        m0 = self.split(count, c, 0)
        for x, m in enumerate((m0, count - m0)):
            if m == 0:
                continue
            X = 4 * x
            sx = side(S(Lx, 6, 4), S(Lx, 6, 6)) if x == 0 else side(S(own, 6, 0), S(own, 6, 2))
            sz = side(S(Lz, 6, X), S(Lz, 6, X + 2))
            k0 = self.split(m, context(sx, sz, S(Ly, 6, X + 2), Uy), 1)
            for y, k in enumerate((k0, m - k0)):
                if k == 0:
                    continue
                Y = X + 2 * y
                sx = side(Lx[4 + 2 * y], Lx[5 + 2 * y]) if x == 0 else side(own[2 * y], own[2 * y + 1])
                sy = side(Ly[X + 2], Ly[X + 3]) if y == 0 else side(own[X], own[X + 1])
                n[Y] = self.split(k, context(sx, sy, Lz[Y + 1], Uz), 2)
                n[Y + 1] = k - n[Y]
                own[Y], own[Y + 1] = min(255, n[Y]), min(255, n[Y + 1])
        return n

    def split(self, n, c, axis):
        bucket = n - 1 if n <= 8 else min(4 + n.bit_length(), 15)
        lo, hi, tree = 0, n, 1
        while lo < hi:
            mid = (lo + hi) >> 1
            if tree < 32:
                t = bucket * 32 + tree
                bin = self.model.mixed(t * 144 + c, ((t * 3 + axis) * 7 + self.occupied) * 8 + min(self.rest - 1, 7), t)
            else:
                bin = self.model.decoder.bits(1)
            tree = 2 * tree + bin
            lo, hi = (mid + 1, hi) if bin else (lo, mid)
        return lo


def S(s, mask, v):
    return sum(s[k] for k in range(8) if k & mask == v)


def side(low, high):
    return 0 if low == high == 0 else 1 if low > high else 2 if low < high else 3


def context(s, t, low, up):
    return ((min(low, 2) * 3 + min(up, 2)) * 4 + s) * 4 + t


# ---- 9. Channels ----------------------------------------------------------------------------------------------------


def decode_channels(payload, attribute, channels, near, what):
    """Clause 9: -> q[c][i]."""
    model = ValueModel(RangeDecoder(payload, what))
    q = [[] for _ in range(channels)]
    s = 3 if attribute == SHN else 2
    for j in near:
        row = []
        for c in range(channels):
            k = c // 3
            class_ = 3 * (0 if k < 3 else 1 if k < 8 else 2) + c % 3 if attribute == SHN else c
            row.append(
                model.value(class_, [q[c][n] for n in j], row[c - 1] if c >= 1 else 0, row[c - s] if c >= s else 0)
            )
        for c in range(channels):
            q[c].append(row[c])
    model.decoder.finish()
    return q


# ---- 10. Lifetimes --------------------------------------------------------------------------------------------------


def decode_lifetimes(payload, frames, near, what):
    """Clause 10: -> list of (t0, t1)."""
    model = Model(RangeDecoder(payload, what))
    w = (frames - 1).bit_length()

    def point(e, ref):
        v, node = 0, 1
        for j in range(w):
            follow = ref >> (w - 1 - j) & 1 if v == ref >> (w - j) else 2
            bin = model.mixed(16 + 256 * e + node, 16 + (8 * e + j) * 3 + follow, 1 + 8 * e + j)
            v, node = 2 * v + bin, 2 * node + bin
        return v

    lifetimes = []
    for i, neighbors in enumerate(near):
        cuts = [int(lifetimes[j] != (0, frames)) for j in neighbors] + [0] * (4 - len(neighbors))
        t0, t1 = 0, frames
        if model.mixed(2 * cuts[0] + cuts[1], sum(cuts), 0):
            r0, r1 = lifetimes[neighbors[0]] if neighbors else (0, frames)
            t0 = point(0, r0)
            t1 = point(1, r1 - 1) + 1
            require(t0 < t1 <= frames, f"{what}: lifetime [{t0}, {t1}) of Gaussian {i}, expected within [0, {frames})")
        lifetimes.append((t0, t1))
    model.decoder.finish()
    return lifetimes


# ---- 11. Node trajectories ------------------------------------------------------------------------------------------


def class_nodes(k, c):
    return 6 * min(k, 3) + c


# ---- 12. Trajectories -----------------------------------------------------------------------------------------------


def class_trajectories(k, c):
    return 3 * min(k, 3) + c % 3


def decode_trajectories(payload, coefficients, channels, near, class_of, spend, what):
    """Clauses 11 and 12: -> for each i a list, as long as it has coefficients, of [C] values; spend(C) before each."""
    decoder = RangeDecoder(payload, what)
    lengths, values = Model(decoder), ValueModel(decoder)
    q, zeros = [], [0] * channels
    for j in near:
        l = [len(q[n]) for n in j] + [0] * (4 - len(j))
        a, b = 4 * min(l[0], 3) + min(l[1], 3), min(2 * l[0] + l[1] + l[2] + l[3], 15)
        length = 0
        while length < coefficients:
            z = min(length, 31)
            if not lengths.mixed(32 * a + z, 32 * b + z, z):
                break
            length += 1
        spend(channels * length)
        own = []
        for k in range(length):
            others = [q[n][k] if k < len(q[n]) else zeros for n in j]
            before, row = own[-1] if own else zeros, []
            for c in range(channels):
                row.append(values.value(class_of(k, c), [o[c] for o in others], before[c], row[c - 1] if c else 0))
            own.append(row)
        q.append(own)
    decoder.finish()
    return q


def dense(q, coefficients, channels):
    """Coefficients as decoded -> [K, C, N] i32."""
    values = np.zeros((coefficients, channels, len(q)), np.int32)
    for i, own in enumerate(q):
        for k, row in enumerate(own):
            values[k, :, i] = row
    return values


@dataclass
class Group:
    """A decoded group: the header and all of its integers, i32."""

    header: Header
    positions: np.ndarray  # [N, 3]
    channels: dict  # attribute -> [C, N]
    lifetimes: np.ndarray | None  # [N, 2]
    node_positions: np.ndarray | None  # [M, 3]
    node_trajectories: np.ndarray | None  # [K, 6, M]
    trajectories: dict  # attribute -> [K, C, N]


def decode_group(payload, level, frames=None):
    """Clauses 3 to 12: a sample -> Group. `frames`: its duration in the container, if it comes out of one."""
    limit(len(payload), LEVELS[level][4], "bytes", level)
    units = read_units(payload)
    header = read_group_header(units[0].payload)
    budget = check_limits(header, level)
    wrong = f"group_header: frames is {header.frames}, but the sample lasts {frames}"
    require(frames is None or frames == header.frames, wrong)
    found = check_units(units, header)
    points = decode_positions(found[POSITIONS, 0], header.count, header.grid_bits, "positions")
    near = find_neighbors(points)
    channels, trajectories, lifetimes, node_positions, node_trajectories = {}, {}, None, None, None
    for a, (steps, _) in header.channels.items():
        q = decode_channels(found[CHANNELS, a], a, len(steps), near, f"channels of {ATTRIBUTES[a]}")
        channels[a] = np.array(q, np.int32).reshape(len(steps), header.count)
    if (LIFETIMES, 0) in found:
        q = decode_lifetimes(found[LIFETIMES, 0], header.frames, near, "lifetimes")
        lifetimes = np.array(q, np.int32).reshape(header.count, 2)
    if header.node_count:
        nodes = decode_positions(found[NODE_POSITIONS, 0], header.node_count, header.grid_bits, "node_positions")
        node_positions = np.array(nodes, np.int32)
        K, node_near = header.node_coefficients, find_neighbors(nodes)
        unit = found[NODE_TRAJECTORIES, 0]
        q = decode_trajectories(unit, K, 6, node_near, class_nodes, lambda _: None, "node_trajectories")
        node_trajectories = dense(q, K, 6)
    for a, (K, _) in header.trajectories.items():
        C, what = channel_count(a, header.sh_degree), f"trajectories of {ATTRIBUTES[a]}"
        q = decode_trajectories(found[TRAJECTORIES, a], K, C, near, class_trajectories, budget.spend, what)
        trajectories[a] = dense(q, K, C)
    positions = np.array(points, np.int32).reshape(header.count, 3)
    return Group(header, positions, channels, lifetimes, node_positions, node_trajectories, trajectories)


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


def blend_nodes(group, x0, t):
    """Clause 13.3: [N, 3] -> x_blend [N, 3], q_blend [N, 4]."""
    h = group.header
    b = basis(h.node_coefficients, h.frames, t)
    motion = np.einsum("kcm,k->mc", group.node_trajectories.astype(float), b)  # [M, 6]
    r, translation = h.rotation_step * motion[:, :3], h.translation_step * motion[:, 3:]
    angle = np.linalg.norm(r, axis=1, keepdims=True)
    axis = np.divide(r, angle, out=np.zeros_like(r), where=angle > 0)
    q = np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], 1)  # [M, 4]
    n = np.array(h.origin) + h.grid_step * group.node_positions
    j, w = node_weights(group.positions, group.node_positions.astype(np.int64), h.neighbors)
    weight = (w / w.sum(1, keepdims=True))[..., None]  # [N, n, 1]
    x = (weight * (rotate(q[j], x0[:, None] - n[j]) + n[j] + translation[j])).sum(1)
    sign = np.where((q[j] * q[j[:, :1]]).sum(-1, keepdims=True) < 0, -1, 1)
    total = (weight * sign * q[j]).sum(1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return x, np.where(length < 1e-12, q[j[:, 0]], total / np.maximum(length, 1e-12))


def unit(v):
    """Clause 13.4: [N, 3] -> wxyz [N, 4]."""
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (v * v).sum(-1, keepdims=True))), v], -1)


def rgb(v):
    """Clause 13.5: [..., 3] Y, Co, Cg -> R, G, B."""
    Y, Co, Cg = np.moveaxis(v, -1, 0)
    return np.stack([Y + Co - Cg, Y + Cg, Y - Co - Cg], -1)


def evaluate(group, t):
    """Clause 13: frame t in float64, all Gaussians, and which of them are shown.

    means [N, 3], quats [N, 4] wxyz, log_scales [N, 3], logit_opacities [N], sh0 [N, 3] and shN [N, K, 3] RGB,
    shown [N] bool.
    """
    h = group.header
    count = h.count
    x0 = np.array(h.origin) + h.grid_step * group.positions

    def canonical(a):  # [N, C]
        steps, offsets = h.channels[a]
        return np.array(offsets) + np.array(steps) * group.channels[a].T

    def delta(a):  # [N, C]
        if a not in h.trajectories:
            return np.zeros((count, channel_count(a, h.sh_degree)))
        K, step = h.trajectories[a]
        return step * np.einsum("kcn,k->nc", group.trajectories[a].astype(float), basis(K, h.frames, t))

    x, q = blend_nodes(group, x0, t) if h.node_count else (x0, np.tile([1.0, 0, 0, 0], (count, 1)))
    quats = quaternion_product(quaternion_product(unit(delta(QUATS)), q), unit(canonical(QUATS)))
    frame = {
        "means": x + delta(MEANS),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "log_scales": canonical(LOG_SCALES) + delta(LOG_SCALES),
        "logit_opacities": (canonical(LOGIT_OPACITIES) + delta(LOGIT_OPACITIES))[:, 0],
        "sh0": rgb(canonical(SH0) + delta(SH0)),
        "shN": np.zeros((count, 0, 3)),
        "shown": np.ones(count, bool),
    }
    if h.sh_degree:
        frame["shN"] = rgb((canonical(SHN) + delta(SHN)).reshape(count, -1, 3))
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


def decode(data):
    """A whole file -> (Config, [(Sample, Group)])."""
    config, samples = read_container(data)
    groups = [decode_group(sample.payload, config.level, sample.frames) for sample in samples]
    for group in groups:
        told, got = config.sh_degree, group.header.sh_degree
        require(got <= told, f"group_header: sh_degree is {got}, but gsvC allows {told}")
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
