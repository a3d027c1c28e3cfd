"""Clauses 3 to 5 of gsv.md for the reference decoder: units, group header, levels."""

import zlib
from dataclasses import dataclass

from reference_container import LEVELS, PAIRS, LimitError, Reader, require

# ---- 3. Group payload -----------------------------------------------------------------------------------------------

GROUP_HEADER, POSITIONS, CHANNELS, LIFETIMES, NODE_POSITIONS, NODE_TRAJECTORIES, TRAJECTORIES = range(7)
DEATHS, LAYER_CORRECTION = 8, 9
UNIT_NAMES = {
    GROUP_HEADER: "group_header",
    POSITIONS: "positions",
    CHANNELS: "channels",
    LIFETIMES: "lifetimes",
    NODE_POSITIONS: "node_positions",
    NODE_TRAJECTORIES: "node_trajectories",
    TRAJECTORIES: "trajectories",
    DEATHS: "deaths",
    LAYER_CORRECTION: "layer_correction",
}
MUST_DEPEND_ON = {
    CHANNELS: (POSITIONS,),
    LIFETIMES: (POSITIONS, DEATHS),
    NODE_TRAJECTORIES: (NODE_POSITIONS,),
    TRAJECTORIES: (POSITIONS, DEATHS),
}
MEANS, LOG_SCALES, QUATS, LOGIT_OPACITIES, SH0, SHN = range(1, 7)
ATTRIBUTES = {1: "means", 2: "log_scales", 3: "quats", 4: "logit_opacities", 5: "sh0", 6: "shN"}


def channel_count(attribute, sh_degree):
    """Clause 3.2: C."""
    return {LOGIT_OPACITIES: 1, SHN: 3 * ((sh_degree + 1) ** 2 - 1)}.get(attribute, 3)


def unit_name(key):
    """(type, layer, attribute) in words."""
    unit_type, layer, attribute = key
    of = f" of {ATTRIBUTES.get(attribute, attribute)}" if attribute else ""
    return f"{UNIT_NAMES.get(unit_type, unit_type)} unit{of} in layer {layer}"


@dataclass
class Unit:
    unit_type: int
    layer: int
    attribute: int
    dependencies: list
    payload: bytes

    def key(self):
        return self.unit_type, self.layer, self.attribute


def read_units(payload, layers=256):
    """Clause 3: the units of the first layers of a group, with all rules that do not need the group header."""
    units, sizes = [], []
    reader = Reader(payload, 0, len(payload), "unit 0")
    while reader.position < reader.end:
        index, start = len(units), reader.position
        reader.what = f"unit {index}"
        require(index < 255, f"more than 255 units in the group, byte {start}")
        unit_type, layer, attribute = reader.u8(), reader.u8(), reader.u8()
        if layer >= layers:
            break
        dependencies = list(reader.take(reader.u8()))
        length = reader.u32()
        covered = bytes(payload[start : reader.position])
        crc = reader.u32()
        body = reader.take(length)
        require(zlib.crc32(covered + body) == crc, f"unit {index} at byte {start}: wrong CRC, the unit is damaged")
        size = reader.position - start
        wrong = f"unit {index}: {size} bytes, but the header says {sizes[index] if index < len(sizes) else 0}"
        require(index >= len(sizes) or sizes[index] == size, wrong)
        increasing = dependencies == sorted({d for d in dependencies if d < index})
        require(increasing, f"unit {index}: dependencies {dependencies} are not increasing indices below {index}")
        require(not units or units[-1].layer <= layer, f"unit {index}: layer {layer} after a higher one")
        unit = Unit(unit_type, layer, attribute, dependencies, body)
        second = unit_type in UNIT_NAMES and any(unit.key() == u.key() for u in units)
        require(not second, f"unit {index}: a second {unit_name(unit.key())}, expected one")
        if index == 0 and unit_type == GROUP_HEADER:
            sizes = [size, *read_opening(Reader(body, 0, len(body), "group_header"))[3]]
        units.append(unit)
    require(units and units[0].key() == (GROUP_HEADER, 0, 0), "unit 0 is not the group header, of layer 0")
    return units


def check_units(units, header, layers):
    """Clause 3.1: the units are those that the header announces -> {(type, layer, attribute): payload}."""
    required, optional = {(GROUP_HEADER, 0, 0)}, set()
    required |= {(NODE_POSITIONS, 0, 0), (NODE_TRAJECTORIES, 0, 0)} if header.node_count else set()
    for k, layer in enumerate(header.layers[:layers]):
        if not header.reference or layer.births:
            required |= {(POSITIONS, k, 0)} | {(CHANNELS, k, a) for a in header.channels}
        required |= {(DEATHS, k, 0)} if layer.candidates else set()
        required |= {(TRAJECTORIES, k, a) for a in header.trajectories}
        optional |= {(LIFETIMES, k, 0), (LAYER_CORRECTION, k, LOG_SCALES), (LAYER_CORRECTION, k, LOGIT_OPACITIES)}
    found = {}
    for index, unit in enumerate(units):
        if unit.unit_type not in UNIT_NAMES:
            continue  # unknown: skipped
        announced = unit.key() in required | optional
        require(announced, f"unit {index}: the header announces no {unit_name(unit.key())}")
        on = [units[d].key() for d in unit.dependencies]
        needs = [(needed, unit.layer, 0) for needed in MUST_DEPEND_ON.get(unit.unit_type, ())]
        if unit.unit_type == CHANNELS and unit.attribute == QUATS:
            needs.append((CHANNELS, unit.layer, LOG_SCALES))
        for key in needs:
            require(key not in required or key in on, f"unit {index}: must depend on a {unit_name(key)}")
        found[unit.key()] = unit.payload
    missing = sorted(required - found.keys())
    require(not missing, f"expected units that are missing: {', '.join(map(unit_name, missing))}")
    return found


# ---- 4. Group header ------------------------------------------------------------------------------------------------


@dataclass
class Layer:
    count: int
    births: int  # Gaussians that are not in the reference
    candidates: int = 0  # Gaussians of the reference that a deaths unit codes


@dataclass
class Header:
    frames: int
    reference: int  # groups back, 0: independent
    origin: list
    grid_step: float
    grid_bits: int
    sh_degree: int
    layers: list
    channels: dict  # attribute -> (steps, offsets)
    trajectories: dict  # attribute -> (K_a, step)
    scale_exponents: list  # [3][3]: channel of quats, channel of log_scales
    shifts: list  # of each layer, attribute -> low bits that are not coded; MEANS: of positions
    companding: dict  # attribute -> (low, width, slopes) of each channel; empty without companding
    node_count: int = 0
    neighbors: int = 0
    node_coefficients: int = 0
    rotation_step: float = 0.0
    translation_step: float = 0.0


def read_opening(r):
    """Clause 4: frames, flags, reference (0: independent) and the unit_sizes, if present."""
    frames, flags = r.u16(), r.u8()
    require(frames >= 1, "group_header: frames is 0")
    wanted = "bits 4 to 7 must be 0, and bits 1 and 3 in a predicted group"
    require(not flags & (0xFA if flags & 1 else 0xF0), f"group_header: flags are {flags:#x}, {wanted}")
    reference = r.u16() if flags & 1 else 0
    require(reference or not flags & 1, "group_header: reference is 0, expected >= 1")
    return frames, flags, reference, [r.u32() for _ in range(r.u8() if flags & 4 else 0)]


def read_reference(payload):
    """Clause 4: how many groups back a group refers, 0: it is independent."""
    return read_opening(Reader(payload, 0, len(payload), "group_header"))[2]


def read_grid(r):
    """Clause 4: origin, grid_step, grid_bits, sh_degree."""
    origin = [r.f32("origin") for _ in range(3)]
    grid_step = r.f32("grid_step", positive=True)
    grid_bits, sh_degree = r.u8(), r.u8()
    require(1 <= grid_bits <= 21, f"group_header: grid_bits is {grid_bits}, expected 1 to 21")
    require(sh_degree <= 3, f"group_header: sh_degree is {sh_degree}, expected 0 to 3")
    return origin, grid_step, grid_bits, sh_degree


def read_layers(r, reference):
    """Clause 4: the layers. `reference`: the Header of the reference of a predicted group, else None."""
    layer_count = r.u8()
    require(1 <= layer_count <= 16, f"group_header: {layer_count} layers, expected 1 to 16")
    if reference:
        wanted = len(reference.layers)
        require(layer_count == wanted, f"group_header: {layer_count} layers, the reference has {wanted}")
    layers = []
    for k in range(layer_count):
        count, map_width_log2 = r.u32(), r.u8()
        width = expected_map_width_log2(count)
        require(map_width_log2 == width, f"group_header: map_width_log2 is {map_width_log2}, expected {width}")
        layer = Layer(count, count)
        if reference:
            layer.births, before = r.u32(), reference.layers[k].count
            survivors = count - layer.births
            require(
                0 <= survivors <= before,
                f"group_header: {survivors} survivors of {before} Gaussians besides {layer.births} births",
            )
            layer.candidates = before if survivors < before else 0
        layers.append(layer)
    return layers


def read_channels(r, sh_degree):
    """Clause 4: attribute -> (steps, offsets)."""
    expected = [LOG_SCALES, QUATS, LOGIT_OPACITIES, SH0, SHN][: 5 if sh_degree else 4]
    attribute_count, channels = r.u8(), {}
    require(
        attribute_count == len(expected),
        f"group_header: {attribute_count} attributes, expected {len(expected)}",
    )
    for wanted in expected:
        attribute = r.u8()
        require(attribute == wanted, f"group_header: attribute is {attribute}, expected {wanted}")
        pairs = [(r.f32("step", positive=True), r.f32("offset")) for _ in range(channel_count(attribute, sh_degree))]
        channels[attribute] = [step for step, _ in pairs], [offset for _, offset in pairs]
    return channels


def read_scale_exponents(r):
    """Clause 4: [3][3]."""
    return [[(byte - 256 if byte > 127 else byte) / 32 for byte in r.take(3)] for _ in range(3)]


def read_shifts(r, layer_count, grid_bits, attributes):
    """Clause 4: of each layer attribute -> shift, MEANS: of positions."""
    shifts = [{a: r.u8() for a in (MEANS, *attributes)} for _ in range(layer_count)]
    for shift in (s for own in shifts for s in own.values()):
        require(shift <= 15, f"group_header: shift is {shift}, expected 0 to 15")
    for own in shifts:
        require(own[MEANS] < grid_bits, f"group_header: shift of positions is {own[MEANS]}, of {grid_bits} bits")
    return shifts


def read_companding(r):
    """Clause 4: attribute -> (low, width, slopes) of each channel."""

    def channel():
        return r.f32("companding low"), r.f32("companding width", positive=True), list(r.take(8))

    return {LOG_SCALES: [channel() for _ in range(3)], LOGIT_OPACITIES: [channel()]}


def expected_map_width_log2(count):
    """Clause 7.2."""
    return (count.bit_length() - 1) >> 1 if count else 0


def read_group_header(payload, reference=None):
    """Clause 4. `reference`: the Header of the reference of a predicted group."""
    r = Reader(payload, 0, len(payload), "group_header")
    frames, flags, back, _ = read_opening(r)
    if back:
        require(reference is not None and not reference.reference, "group_header: no independent group to refer to")
        layers, channels = read_layers(r, reference), reference.channels
        grid = reference.origin, reference.grid_step, reference.grid_bits, reference.sh_degree
        scale_exponents, shifts, companding = reference.scale_exponents, reference.shifts, reference.companding
    else:
        grid = read_grid(r)
        layers = read_layers(r, None)
        channels = read_channels(r, grid[3])
        scale_exponents = read_scale_exponents(r)
        unshifted = [dict.fromkeys((MEANS, *channels), 0)] * len(layers)
        shifts = read_shifts(r, len(layers), grid[2], channels) if flags & 8 else unshifted
        companding = read_companding(r) if flags & 2 else {}
    sh_degree = grid[3]
    trajectories, last = {}, 0
    for _ in range(r.u8()):
        attribute, coefficients = r.u8(), r.u16()
        valid = last < attribute <= (SHN if sh_degree else SH0)
        require(valid, f"group_header: trajectories of attribute {attribute} after {last} at sh_degree {sh_degree}")
        require(1 <= coefficients <= frames, f"group_header: {coefficients} coefficients, expected 1 to {frames}")
        trajectories[attribute] = coefficients, r.f32("trajectory step", positive=True)
        last = attribute
    header = Header(frames, back, *grid, layers, channels, trajectories, scale_exponents, shifts, companding, r.u32())
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
    """Clause 5: checks the caps that follow from the header; returns the budget for the coefficient values."""
    count = sum(layer.count for layer in header.layers)
    facts = (count, "Gaussians"), (header.frames, "frames"), (header.node_count, "nodes")
    for (value, name), cap in zip(facts, LEVELS[level], strict=False):
        limit(value, cap, name, level)
    limit(count * header.node_count, PAIRS[level], "pairs of Gaussian and node", level)
    budget = Budget(level)
    channels = sum(len(steps) for steps, _ in header.channels.values())
    budget.spend((3 + channels) * sum(layer.births for layer in header.layers))
    budget.spend(len(header.trajectories) * count + sum(layer.candidates for layer in header.layers))
    budget.spend((3 + 6 * header.node_coefficients) * header.node_count)
    return budget
