"""Clauses 3 to 5 of gsv.md for the reference decoder: units, group header, levels."""

import zlib
from dataclasses import dataclass, field

from reference_container import LEVELS, PAIRS, LimitError, Reader, require

# ---- 3. Group payload -----------------------------------------------------------------------------------------------

GROUP_HEADER, TILE, NODE_POSITIONS, NODE_TRAJECTORIES, LAYER_CORRECTION, RIG, JOINT_POSES = range(7)
UNIT_NAMES = {
    GROUP_HEADER: "group_header",
    TILE: "tile",
    NODE_POSITIONS: "node_positions",
    NODE_TRAJECTORIES: "node_trajectories",
    LAYER_CORRECTION: "layer_correction",
    RIG: "rig",
    JOINT_POSES: "joint_poses",
}
MEANS, LOG_SCALES, QUATS, LOGIT_OPACITIES, SH0, SHN = range(1, 7)
ATTRIBUTES = {1: "means", 2: "log_scales", 3: "quats", 4: "logit_opacities", 5: "sh0", 6: "shN"}


def channel_count(attribute, sh_degree):
    """Clause 3.2: C."""
    return {LOGIT_OPACITIES: 1, SHN: 3 * ((sh_degree + 1) ** 2 - 1)}.get(attribute, 3)


def unit_name(key):
    """(type, layer, index) in words."""
    unit_type, layer, index = key
    which = f" {index}" if unit_type == TILE else ""
    return f"{UNIT_NAMES.get(unit_type, unit_type)}{which} of layer {layer}"


@dataclass
class Unit:
    unit_type: int
    layer: int
    index: int
    payload: bytes

    def key(self):
        return self.unit_type, self.layer, self.index


def read_header_bytes(payload):
    """Clause 3: the header of a group, and where the payloads of the units begin."""
    r = Reader(payload, 0, len(payload), "unit 0 (group_header)")
    length, crc = r.u32(), r.u32()
    header = r.take(length)
    require(zlib.crc32(header) == crc, "unit 0: wrong CRC, the group_header is damaged")
    return bytes(header), r.position


def read_units(payload, layers=256, tiles=None):
    """Clause 3: the units behind the header, of the first `layers` layers, checked by all rules that need only the
    directory. `tiles`: (layer, index) -> whether a tile is wanted; the bytes of other tiles are not checked."""
    header, start = read_header_bytes(payload)
    units, directory = [], read_opening(Reader(header, 0, len(header), "group_header"))[3]
    reader = Reader(payload, start, len(payload), "unit 1")
    for number, (unit_type, layer, index, size, crc) in enumerate(directory, 1):
        reader.what, where = f"unit {number}", f"unit {number} of the directory"
        before = directory[number - 2][1] if number > 1 else 0
        require(before <= layer, f"{where}: layer {layer}, expected layers in increasing order")
        require(unit_type != GROUP_HEADER, f"{where}: expected no second group_header")
        single = unit_type not in (NODE_POSITIONS, NODE_TRAJECTORIES, RIG, JOINT_POSES) or index == 0
        require(single, f"{where}: expected an index of 0, not {index}")
        known = unit_type != LAYER_CORRECTION or index in (LOG_SCALES, LOGIT_OPACITIES)
        require(known, f"{where}: a layer_correction of attribute {index}, expected one of attribute 2 or 4")
        if layer >= layers:
            return units
        wanted = unit_type != TILE or tiles is None or tiles(layer, index)
        body = bytes(reader.take(size))
        if wanted:
            require(zlib.crc32(body) == crc, f"unit {number}: wrong CRC, the unit is damaged")
            units.append(Unit(unit_type, layer, index, body))
    left = reader.end - reader.position
    require(not left, f"{left} bytes behind the last unit, expected the end of the group")
    return units


def check_units(units, header, layers, wanted=lambda k, t: True):
    """Clause 3.1: the units are those that the header announces -> {(type, layer, index): payload}."""
    required, optional = set(), set()
    required |= {(NODE_POSITIONS, 0, 0), (NODE_TRAJECTORIES, 0, 0)} if header.node_count else set()
    required |= {(RIG, 0, 0), (JOINT_POSES, 0, 0)} if header.joint_count else set()
    for k, layer in enumerate(header.layers[:layers]):
        required |= {(TILE, k, t) for t, tile in enumerate(layer.tiles) if tile.count and wanted(k, t)}
        optional |= {(LAYER_CORRECTION, k, LOG_SCALES), (LAYER_CORRECTION, k, LOGIT_OPACITIES)}
    found = {}
    for unit in units:
        if unit.unit_type not in UNIT_NAMES:
            continue  # unknown: skipped
        name = unit_name(unit.key())
        require(
            unit.key() in required | optional,
            f"a unit {name}, which the header announces not: only units that it announces",
        )
        require(unit.key() not in found, f"a second {name}, expected one unit of each type, layer and index")
        found[unit.key()] = unit.payload
    missing = sorted(required - found.keys())
    require(not missing, f"expected a unit {', '.join(map(unit_name, missing))}, found none")
    return found


# ---- 3.3 Tile -------------------------------------------------------------------------------------------------------

DEATHS, POSITIONS, CHANNELS, TRAJECTORIES, LIFETIMES = "deaths", "positions", "channels", "trajectories", "lifetimes"


def split_tile(payload, tile, header):
    """Clause 3.3: {(kind, attribute or 0): bytes}."""
    kinds = [(DEATHS, 0)] if tile.candidates else []
    if tile.born:
        kinds = [(POSITIONS, 0)] + [(CHANNELS, a) for a in header.channels]
    kinds += [(TRAJECTORIES, a) for a in header.trajectories] + [(LIFETIMES, 0)] * header.lifetimes
    r = Reader(payload, 0, len(payload), "tile")
    sizes = [read_varint(r) for _ in kinds[1:]]
    streams = {}
    for n, kind in enumerate(kinds):
        left = r.end - r.position
        size = sizes[n] if n < len(sizes) else left
        require(size <= left, f"tile: {size} more bytes of a stream, found {left}")
        streams[kind] = bytes(r.take(size))
    require(r.position == r.end, f"tile: expected the end of the tile, found {r.end - r.position} more bytes")
    return streams


def read_varint(r):
    value = 0
    for _ in range(5):
        require(r.position < r.end, "tile: the size of a stream is cut off")
        byte = r.u8()
        value = value << 7 | byte & 127
        if byte < 128:
            require(value < 1 << 32, "tile: the size of a stream is too large")
            return value
    require(False, "tile: expected the size of a stream, of at most 5 bytes")


# ---- 4. Group header ------------------------------------------------------------------------------------------------


@dataclass
class Tile:
    count: int
    born: bool  # of births, not of survivors
    candidates: int = 0  # Gaussians of the reference that its deaths code
    bounds: tuple = ()


@dataclass
class Layer:
    count: int
    births: int  # Gaussians that are not in the reference
    tiles: list = field(default_factory=list)

    def leading(self):
        """Clause 7.4: indices of the leading tiles."""
        first = {0} if self.tiles and self.tiles[0].count else set()
        return first | set([t for t, tile in enumerate(self.tiles) if tile.born][:1])


@dataclass
class Header:
    frames: int
    reference: int  # groups back, 0: independent
    origin: list
    grid_step: float
    grid_bits: int
    sh_degree: int
    layers: list
    tile_side_log2: int
    lifetimes: bool
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
    joint_count: int = 0
    joint_rotation_step: float = 0.0
    joint_translation_step: float = 0.0
    turned_harmonics: bool = False


def read_opening(r):
    """Clause 4: frames, flags, reference (0: independent) and the directory."""
    frames, flags = r.u16(), r.u8()
    require(frames >= 1, "group_header: frames is 0, expected frames >= 1")
    allowed = 0x31 if flags & 1 else 0x7A
    require(not flags & ~allowed, f"group_header: flags are {flags:#x}, expected reserved flags to be 0")
    reference = r.u16() if flags & 1 else 0
    require(reference or not flags & 1, "group_header: reference is 0, expected a reference >= 1")
    directory = [(r.u8(), r.u8(), r.u16(), r.u32(), r.u32()) for _ in range(r.u16())]
    return frames, flags, reference, directory


def read_reference(payload):
    """Clause 4: how many groups back a group refers, 0: it is independent."""
    header, _ = read_header_bytes(payload)
    return read_opening(Reader(header, 0, len(header), "group_header"))[2]


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
        count = r.u32()
        layer = Layer(count, count)
        if reference:
            layer.births, before = r.u32(), reference.layers[k].count
            survivors = count - layer.births
            require(
                0 <= survivors <= before,
                f"group_header: {survivors} survivors of {before} Gaussians besides {layer.births} births",
            )
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


def read_tiles(r, layers, side_log2, reference):
    """Clause 4: the index of tiles."""
    total, most = sum(layer.count for layer in layers), LEVELS[4][0]
    if total > most:
        raise LimitError(f"{total} Gaussians in the group, no level allows more than {most}")
    for k, layer in enumerate(layers):
        left = layer.count - layer.births
        for t, before in enumerate(reference.layers[k].tiles if reference else []):
            count = r.u32()
            require(
                count <= min(before.count, left),
                f"group_header: {count} survivors in tile {t}, expected at most {left}",
            )
            left -= count
            candidates = before.count if 0 < count < before.count else 0
            layer.tiles.append(Tile(count, False, candidates, read_bounds(r)))
        require(left == 0, f"group_header: expected {left} more survivors in the tiles of layer {k}")
        for first in range(0, layer.births, 4**side_log2):
            layer.tiles.append(Tile(min(4**side_log2, layer.births - first), True, 0, read_bounds(r)))


def read_bounds(r):
    bounds = tuple(r.u16() for _ in range(6))
    valid = all(low <= high for low, high in zip(bounds[:3], bounds[3:], strict=True))
    require(valid, f"group_header: bounds are {bounds}, expected bounds whose lower corner is below")
    return bounds


def read_group_header(payload, reference=None):
    """Clause 4. `reference`: the Header of the reference of a predicted group."""
    r = Reader(payload, 0, len(payload), "group_header")
    frames, flags, back, _ = read_opening(r)
    if back:
        require(reference is not None and not reference.reference, "group_header: no independent group to refer to")
        layers, channels = read_layers(r, reference), reference.channels
        side_log2 = reference.tile_side_log2
        grid = reference.origin, reference.grid_step, reference.grid_bits, reference.sh_degree
        scale_exponents, shifts, companding = reference.scale_exponents, reference.shifts, reference.companding
    else:
        grid = read_grid(r)
        layers = read_layers(r, None)
        side_log2 = r.u8()
        require(4 <= side_log2 <= 7, f"group_header: tile_side_log2 is {side_log2}, expected 4 to 7")
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
    head = frames, back, *grid, layers, side_log2, bool(flags & 16)
    header = Header(*head, channels, trajectories, scale_exponents, shifts, companding, r.u32())
    if header.node_count:
        header.neighbors, header.node_coefficients = r.u8(), r.u16()
        require(1 <= header.neighbors <= 8, f"group_header: neighbors is {header.neighbors}, expected 1 to 8")
        valid = 1 <= header.node_coefficients <= frames
        require(valid, f"group_header: {header.node_coefficients} node coefficients, expected 1 to {frames}")
        header.rotation_step = r.f32("rotation_step", positive=True)
        header.translation_step = r.f32("translation_step", positive=True)
    if flags & 32:
        require(header.node_count, "group_header: a rig without nodes, expected nodes in a group with a rig")
        header.joint_count = r.u8()
        require(header.joint_count, "group_header: joint_count is 0, expected at least one joint")
        header.joint_rotation_step = r.f32("rotation_step of joints", positive=True)
        header.joint_translation_step = r.f32("translation_step of joints", positive=True)
    header.turned_harmonics = reference.turned_harmonics if back else bool(flags & 64)
    read_tiles(r, layers, side_log2, reference if back else None)
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
    budget.spend(
        len(header.trajectories) * count + sum(tile.candidates for layer in header.layers for tile in layer.tiles)
    )
    budget.spend((3 + 6 * header.node_coefficients) * header.node_count)
    budget.spend((9 + 6 * header.frames + header.node_count) * header.joint_count)
    return budget
