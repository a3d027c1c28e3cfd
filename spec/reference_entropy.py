"""Clause 6 of gsv.md for the reference decoder: bits to bins to values."""

from bisect import bisect_right
from collections import defaultdict

from reference_container import clip, require

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
        bin = int(self.code < bound)
        self.take(*((0, bound) if bin else (bound, self.range - bound)))
        return bin

    def take(self, start, length):
        self.code, self.range = self.code - start, length
        while self.range < 1 << 24:
            self.range, self.code = self.range << 8, (self.code << 8 | self.byte()) & 0xFFFFFFFF

    def bits(self, n):
        v = 0
        while n > 0:
            m = min(n, 16)
            unit = self.range >> m
            few = min(self.code // unit, (1 << m) - 1)
            self.take(unit * few, unit)
            v, n = v << m | few, n - m
        return v

    def symbol(self, F):
        unit = self.range >> 16
        s = bisect_right(F, min(self.code // unit, 65535))
        start = F[s - 1] if s else 0
        self.take(unit * start, unit * (F[s] - start))
        return s

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

    def __init__(self, decoder=None):
        self.decoder = decoder
        self.A = defaultdict(lambda: [1 << 21, 0])
        self.B = defaultdict(lambda: [1 << 21, 0])
        self.weights = defaultdict(lambda: [26214, 26214])

    def settled(self):
        """Clause 7.4: a copy for another tile, which takes a decoder of its own."""
        other = type(self)()
        for mine, theirs in ((self.A, other.A), (self.B, other.B)):
            theirs.update({i: [p, min(n, 20)] for i, (p, n) in mine.items()})
        other.weights.update({i: list(pair) for i, pair in self.weights.items()})
        return other

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


def expected(near):
    """Clause 6.5: -> spread, centre, level, sign."""
    s = sum(weight * v for weight, v in zip((4, 3, 2, 2), near, strict=False))
    g = sum((4, 3, 2, 2)[: len(near)])
    p = (2 * s + g) // (2 * g) if g else 0
    spread = SPREAD_BUCKET[min(sum(abs(v - p) for v in near), 41)]
    m = abs(p) if abs(p) <= 6 else min(7 + (abs(p) - 7) // 4, 11)
    return spread, p - clip(p, -7, 7), 11 + (-m if p < 0 else m), clip(p, -1, 1) + 1


def checked(value, what):
    require(abs(value) <= MAX_VALUE, f"{what}: value {value} is outside -2^24 .. 2^24")
    return value


class ValueModel(Model):
    """Clause 6.5."""

    def value(self, class_, near, prev1, prev2):
        spread, centre, level, sign = expected(near)
        a0 = ((class_ * 23 + level) * 10 + spread) * 64
        b0 = (((class_ * 15 + clip(prev1, -7, 7) + 7) * 15 + clip(prev2, -7, 7) + 7) * 3 + sign) * 64

        def bin(j):
            return self.mixed(a0 + j, b0 + j, class_ * 64 + j)

        if not bin(0):
            return checked(centre, self.decoder.what)
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
        return checked(centre - v - 1 if negative else centre + v + 1, self.decoder.what)


class Distribution:
    """Clause 6.6."""

    def __init__(self):
        self.E, self.n = [2048 * (i + 1) - 1 for i in range(32)], 0

    def probability(self, s):
        return self.E[s] - (self.E[s - 1] if s else 0)

    def learn(self, s):
        rate = 131072 // (2 * self.n + 3)
        below, above = self.E[:s], [65535 - e for e in self.E[s:]]
        self.E = [x - (x * rate >> 16) for x in below] + [65535 - (x - (x * rate >> 16)) for x in above]
        self.n = min(self.n + 1, 126)


class SymbolModel:
    """Clause 6.6: tables of distributions and pairs of weights, made when first used."""

    def __init__(self, decoder=None):
        self.decoder = decoder
        self.tables = [defaultdict(Distribution) for _ in range(3)]
        self.weights = defaultdict(lambda: [21845 * 128] * 2)

    def settled(self):
        """Clause 7.4: a copy for another tile, which takes a decoder of its own."""
        other = SymbolModel()
        for mine, theirs in zip(self.tables, other.tables, strict=True):
            for i, d in mine.items():
                theirs[i].E, theirs[i].n = list(d.E), min(d.n, 30)
        other.weights.update({i: list(pair) for i, pair in self.weights.items()})
        return other

    def mixed_symbol(self, class_, *contexts):
        e = [table[d] for table, d in zip(self.tables, contexts, strict=True)]
        v = self.weights[64 * class_ + 16 * AGE[e[0].n] + 4 * AGE[e[1].n] + AGE[e[2].n]]
        w = [v[0] >> 7, v[1] >> 7]
        w.append(65536 - sum(w))
        mean = [
            (a * w[0] >> 16) + (b * w[1] >> 16) + (c * w[2] >> 16) for a, b, c in zip(*(d.E for d in e), strict=True)
        ]
        s = self.decoder.symbol([m - (m >> 9) + 4 * (i + 1) for i, m in enumerate(mean[:31])] + [65536])
        f = [w * ((d.probability(s) >> 1) + 1) for w, d in zip(w, e, strict=True)]
        unit = (sum(f) >> 16) + 1
        for k in (0, 1):
            share = f[k] // unit
            v[k] += share - (share >> 5) + 682 - (v[k] + 127 >> 7)
        for d in e:
            d.learn(s)
        return s
