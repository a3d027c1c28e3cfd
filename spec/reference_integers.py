"""Clauses 7 to 12 of gsv.md for the reference decoder: order, neighbours, and the integers of each unit."""

import numpy as np
from reference_container import Reader, require
from reference_entropy import Model, RangeDecoder, ValueModel, checked, expected
from reference_units import SHN

# ---- 7. Order and maps ----------------------------------------------------------------------------------------------


def morton_inverse(code):
    """Clause 7.1: code -> (x, y, z)."""
    return tuple(sum((code >> (3 * j + axis) & 1) << j for j in range(21)) for axis in (2, 1, 0))


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


def decode_positions(payload, count, grid_bits, what, model=None):
    """Clause 8: -> list of (x, y, z) in Morton order."""
    model = model or Model()
    model.decoder = RangeDecoder(payload, what)
    output, level = [], [(0, count)] if count else []
    for rest in range(grid_bits, 0, -1):
        cubes = [morton_inverse(code) for code, _ in level]
        counts = {cube: n for cube, (_, n) in zip(cubes, level, strict=True)}
        seen, following = {}, []  # cube -> points of its children, capped
        for (code, n), (x, y, z) in zip(level, cubes, strict=True):
            lower = (x - 1, y, z), (x, y - 1, z), (x, y, z - 1)
            upper = [counts.get(q, 0) for q in ((x + 1, y, z), (x, y + 1, z), (x, y, z + 1))]
            occupied = sum(q in counts for q in lower) + sum(u > 0 for u in upper)
            if n == 1 and occupied <= 2:
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

LEAST = [1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 17, 25, 41, 73]
EXTRA = [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 2, 3, 4, 5]


def decode_channels(payload, attribute, channels, near, what, model):
    """Clause 9: -> q[c][i]."""
    decoder = model.decoder = RangeDecoder(payload, what)
    q = [[] for _ in range(channels)]
    s = 3 if attribute == SHN else 2
    for j in near:
        row = []
        for c in range(channels):
            k = c // 3
            class_ = 3 * (0 if k < 3 else 1 if k < 8 else 2) + c % 3 if attribute == SHN else c
            around = [q[c][n] for n in j]
            prev1, prev2 = row[c - 1] if c >= 1 else 0, row[c - s] if c >= s else 0
            spread, centre, level, sign = expected(around)
            n = fold(around[0] - centre if around else 0)
            d0 = (class_ * 23 + level) * 10 + spread
            d1 = ((class_ * 15 + fold(prev1)) * 15 + fold(prev2)) * 3 + sign
            d2 = ((class_ * 15 + n) * 15 + fold(prev1)) * 3 + (0 if spread < 4 else 1 if spread < 7 else 2)
            row.append(checked(centre + residual(decoder, model.mixed_symbol(class_, d0, d1, d2)), what))
        for c in range(channels):
            q[c].append(row[c])
    decoder.finish()
    return q


def fold(x):
    f = next((f for f, most in enumerate((0, 1, 2, 4, 8, 14, 24)) if abs(x) <= most), 7)
    return 7 - f if x < 0 else 7 + f


def residual(decoder, symbol):
    require(symbol < 31, f"{decoder.what}: symbol 31")
    if symbol == 0:
        return 0
    r = (symbol - 1) // 2
    if r < 14:
        v = LEAST[r] + decoder.bits(EXTRA[r])
    else:
        e = decoder.bits(5)
        require(e <= 25, f"{decoder.what}: escape of more than 25 bits")
        v = LEAST[r] + (1 << e | decoder.bits(e)) - 1
    return v if symbol % 2 else -v


# ---- 10. Lifetimes --------------------------------------------------------------------------------------------------


def decode_lifetimes(payload, frames, near, what, model):
    """Clause 10: -> list of (t0, t1)."""
    model.decoder = RangeDecoder(payload, what)
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


# ---- 10.1 Deaths ----------------------------------------------------------------------------------------------------


def decode_deaths(payload, near, survivors, what):
    """Clause 10.1: -> list of the indices of survivors."""
    model = Model(RangeDecoder(payload, what))
    dead = []
    for neighbors in near:
        d = [dead[j] for j in neighbors] + [0] * (4 - len(neighbors))
        dead.append(model.mixed(2 * d[0] + d[1], sum(d), 0))
    model.decoder.finish()
    alive = [i for i, gone in enumerate(dead) if not gone]
    require(len(alive) == survivors, f"{what}: {len(alive)} survivors, expected {survivors} as the header says")
    return alive


# ---- 10.2 Layer correction ------------------------------------------------------------------------------------------


def read_layer_correction(payload, what):
    """Clause 10.2."""
    reader = Reader(payload, 0, len(payload), what)
    value = reader.f32("value")
    require(reader.position == reader.end, f"{what}: {reader.end - reader.position} bytes left over")
    return value


# ---- 11. Node trajectories ------------------------------------------------------------------------------------------


def class_nodes(k, c):
    return 6 * min(k, 3) + c


# ---- 11.1 Rig -------------------------------------------------------------------------------------------------------


def decode_rig(payload, joints, near, what):
    """Clause 11.1: -> parents [J], joints [J, 3], bind [J, 6], weights [M, J], as lists."""
    decoder = RangeDecoder(payload, what)
    model = ValueModel(decoder)
    parents, places, bind, weights = [], [], [], []
    for j in range(joints):
        parent = decoder.bits(8)
        require(parent <= j, f"{what}: parent {parent} of joint {j}, expected values within its range")
        known = [places[parent]] if parent < j else []
        parents.append(parent)
        places.append([model.value(0, [p[c] for p in known], 0, 0) for c in range(3)])
        bind.append([model.value(1, [], 0, 0) for _ in range(6)])
    for i, neighbors in enumerate(near):
        row, left = [], 64
        for j in range(joints):
            w = model.value(2, [weights[n][j] for n in neighbors], row[-1] if row else 0, left)
            require(0 <= w <= 64, f"{what}: weight {w} of node {i}, expected values within 0 to 64")
            row.append(w)
            left -= w
        weights.append(row)
    decoder.finish()
    return parents, places, bind, weights


def ancestors(parents):
    """Clause 11.2: for each joint up to four ancestors, the parent first."""
    near = []
    for j, parent in enumerate(parents):
        near.append([parent, *near[parent]][:4] if parent < j else [])
    return near


# ---- 12. Trajectories -----------------------------------------------------------------------------------------------


def class_trajectories(k, c):
    return 3 * min(k, 3) + c % 3


def decode_trajectories(payload, coefficients, channels, near, class_of, spend, what, models=None):
    """Clauses 11 and 12: -> for each i the list of its coefficients, [C] values each; calls spend(C) before each.
    `models`: (model of the lengths, model of the values)."""
    decoder = RangeDecoder(payload, what)
    lengths, values = models or (Model(), ValueModel())
    lengths.decoder = values.decoder = decoder
    q, zeros, any_of = [], [0] * channels, [0, 0]  # any(g) of clause 12 for all blocks, after two zeros
    for i, j in enumerate(near):
        if i % 16 == 0:
            last, other = any_of[-1], any_of[-2]
            any_of.append(lengths.mixed(512 + 2 * last + other, 512 + last, 32))
        if not any_of[-1]:
            q.append([])
            continue
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
