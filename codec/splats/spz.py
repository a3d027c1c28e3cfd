"""Niantic's .spz, versions 2 to 4 <-> Gaussians: 8-bit attributes, 24-bit positions, one plane after the other.

| version | container | rotations |
|---|---|---|
| 2 | one gzip stream, header within | x, y, z in 8 bits each |
| 3 | the same | the three smallest in a sign and 9 bits each, after the index of the largest |
| 4 | plain header, a table of sizes, one zstd stream for each plane | as in 3 |

Axes are right, up, back; those of a .ply are right, down, forward: y and z change signs. Version 3 is written, since
all readers know it; 4 differs only by its container.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..atomic_write import part_file
from ..errors import CaptureError, require
from ..model.gaussians import SH_COUNTS, Gaussians, logit, sigmoid
from .smallest_three import join_smallest_three, split_smallest_three

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
WRITTEN = 3
SH_DEGREES = {0: 0, 1: 3, 2: 8, 3: 15, 4: 24}  # degree -> coefficients a channel; those of degree 4 are not used
POSITION_BITS = 12  # fraction bits, unless large positions need more of the 24 bits
COLOR_SCALE = 0.15  # of sh0, which is wider than 0 to 1
GAUSSIANS_MAX = 50_000_000
LEAST_BYTES = (
    1 / 40
)  # least bytes of the file per Gaussian, which has 19 to 92 unpacked bytes; a file with fewer is a zip bomb
COORDINATES = 0xADBE0003  # record of another coordinate system (SPZ_ADOBE_coordinate_system)
RUB = 4
RDF = np.array([1, -1, -1])  # signs from the axes of a .spz to those of a .ply
RDF_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])  # the same for harmonics, degree 1 to 3


@dataclass(frozen=True)
class Header:
    """The header of a file.

    Attributes:
        version: 2 to 4.
        count: number of Gaussians.
        degree: SH degree.
        fraction: fraction bits of positions.
    """

    version: int
    count: int
    degree: int
    fraction: int

    def planes(self) -> dict[str, int]:
        """Plane -> bytes per Gaussian, in the order of the file; no plane is empty."""
        rotation = 3 if self.version == 2 else 4
        sizes = {"means": 9, "alphas": 1, "colors": 3, "scales": 3, "quats": rotation}
        return sizes | ({"sh": 3 * SH_DEGREES[self.degree]} if self.degree else {})


def spz_header(path: Path) -> Header:
    """The header, of at most 32 bytes of the file's content.

    Raises:
        CaptureError: not a .spz, another version, or a count that the file cannot hold.
    """
    with path.open("rb") as f:
        head = f.read(32)
    if head.startswith(GZIP):
        try:
            with gzip.open(path) as f:
                head = f.read(16)
        except (OSError, EOFError, zlib.error) as e:
            raise CaptureError(f"{path}: its gzip stream is damaged ({e})") from None
        packed = True
    else:
        packed = False
    return _header(path, head, packed)


def _header(path: Path, head: bytes, packed: bool) -> Header:
    if not head.startswith(MAGIC) or len(head) < 16:
        raise CaptureError(f"{path}: not a .spz, expected {MAGIC.decode()} or a gzip stream that opens with it")
    version, count, degree, fraction = struct.unpack_from("<IIBB", head, 4)
    if version not in ((2, 3) if packed else (4,)):
        kind = "in gzip" if packed else "without gzip"
        raise CaptureError(f"{path}: .spz version {version} {kind}, expected 2 or 3 in gzip, or 4 without")
    if degree not in SH_DEGREES or fraction > 24:
        raise CaptureError(f"{path}: SH degree {degree}, {fraction} fraction bits; expected 0 to 4 and at most 24")
    most = min(GAUSSIANS_MAX, int(path.stat().st_size / LEAST_BYTES))
    if count > most:
        raise CaptureError(f"{path}: {count} Gaussians in {path.stat().st_size} bytes, expected at most {most}")
    return Header(version, count, degree, fraction)


def read_spz(path: Path) -> Gaussians:
    """Reads a .spz in the axes of a .ply; harmonics of degree 4 are left out.

    Raises:
        CaptureError: not a .spz of version 2 to 4, truncated or damaged.
        UsageError: zstandard is not installed, which version 4 needs.
    """
    header = spz_header(path)
    planes = _zstd_planes(path, header) if header.version == 4 else _gzip_planes(path, header)
    return _gaussians(header, planes).validate(str(path))


def _gzip_planes(path: Path, header: Header) -> dict[str, np.ndarray]:
    sizes = header.planes()
    wanted = header.count * sum(sizes.values())
    try:
        with gzip.open(path) as f:
            f.read(16)
            data = f.read(wanted)  # no more is unpacked than the header promises
    except (OSError, EOFError, zlib.error) as e:
        raise CaptureError(f"{path}: truncated or damaged ({e}), expected {wanted} bytes behind the header") from None
    if len(data) < wanted:
        raise CaptureError(f"{path}: truncated, {len(data)} of {wanted} bytes behind the header are there")
    at = np.concatenate([[0], np.cumsum([header.count * s for s in sizes.values()])])
    flat = np.frombuffer(data, np.uint8)
    return {n: flat[at[i] : at[i + 1]].reshape(header.count, s) for i, (n, s) in enumerate(sizes.items())}


def _zstd_planes(path: Path, header: Header) -> dict[str, np.ndarray]:
    zstandard = require("zstandard", "reading .spz version 4")
    data, sizes = path.read_bytes(), header.planes()
    flags, streams, table = struct.unpack_from("<BBI", data.ljust(32, b"\0"), 14)
    if streams != len(sizes) or not 32 <= table <= len(data) - 16 * streams:
        raise CaptureError(f"{path}: {streams} streams, table at byte {table}; expected {len(sizes)}, within the file")
    if flags & 2:
        _check_coordinates(path, data[32:table])
    at, planes = table + 16 * streams, {}
    for i, (name, size) in enumerate(sizes.items()):
        packed, plain = struct.unpack_from("<QQ", data, table + 16 * i)
        if plain != header.count * size or packed > len(data) - at:
            raise CaptureError(
                f"{path}: {name} has {packed} bytes for {plain}, expected {header.count * size} and at most "
                f"{len(data) - at}"
            )
        try:
            unpacked = zstandard.ZstdDecompressor().stream_reader(data[at : at + packed]).read(plain)
        except zstandard.ZstdError as e:
            raise CaptureError(f"{path}: {name} is damaged ({e})") from None
        if len(unpacked) != plain:
            raise CaptureError(f"{path}: {name} is truncated, {len(unpacked)} of {plain} bytes are there")
        planes[name] = np.frombuffer(unpacked, np.uint8).reshape(header.count, size)
        at += packed
    return planes


def _check_coordinates(path: Path, records: bytes) -> None:
    """Refuses a file whose extension records name other axes than those of the format."""
    at = 0
    while at + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, at)
        if kind == COORDINATES and records[at + 8 : at + 12].ljust(4, b"\0") not in (bytes(4), struct.pack("<I", RUB)):
            raise CaptureError(f"{path}: its coordinate system is not right, up, back; convert it with spz's own tools")
        at += 8 + length


def _gaussians(h: Header, p: dict[str, np.ndarray]) -> Gaussians:
    fixed = (p["means"].reshape(h.count, 3, 3).astype(np.int64) @ (1 << np.array([8, 16, 24]))).astype(np.int32) >> 8
    if h.version == 2:
        xyz = p["quats"] / 127.5 - 1
        xyzw = np.concatenate([xyz, np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True)))], 1)
    else:
        word = np.ascontiguousarray(p["quats"]).view("<u4")[:, 0]
        field = word[:, None] >> np.array([20, 10, 0], np.uint32)
        small = (field & 511) / 511 * np.sqrt(0.5) * np.where(field & 512, -1, 1)
        xyzw = join_smallest_three(small, (word >> 30).astype(int))
    quats = np.roll(xyzw, 1, 1) * np.concatenate([[1], RDF])
    quats[~quats.any(1)] = (1, 0, 0, 0)
    k = min(SH_DEGREES[h.degree], len(RDF_SH))
    shN = np.zeros((h.count, 0, 3))
    if k:
        shN = (p["sh"].reshape(h.count, -1, 3)[:, :k] - 128.0) / 128 * RDF_SH[:k, None]
    return Gaussians(
        means=fixed / (1 << h.fraction) * RDF,
        quats=quats,
        log_scales=p["scales"] / 16 - 10,
        logit_opacities=logit(p["alphas"][:, 0] / 255),
        sh0=(p["colors"] / 255 - 0.5) / COLOR_SCALE,
        shN=shN,
    )


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Writes a .spz of version 3, harmonics in 8 bits.

    Raises:
        CaptureError: there are no Gaussians, or a position is too large for 24 bits.
    """
    g = gaussians
    if not len(g):
        raise CaptureError(f"{path}: no Gaussians to write; use .ply for an empty frame")
    far = float(np.abs(g.means).max())
    fraction = min(POSITION_BITS, int(np.floor(np.log2((2**23 - 1) / max(far, 1)))))
    if fraction < 0:
        raise CaptureError(f"{path}: a position of {far:g}, expected less than {2**23} in a .spz")
    fixed = np.rint(g.means.astype(np.float64) * RDF * (1 << fraction)).astype("<i4")
    small, largest = split_smallest_three(np.roll(g.quats * np.concatenate([[1], RDF]), -1, 1))
    level = np.rint(np.abs(small) * np.sqrt(2) * 511).astype(np.uint32) | np.where(small < 0, 512, 0).astype(np.uint32)
    word = largest.astype(np.uint32) << 30 | level[:, 0] << 20 | level[:, 1] << 10 | level[:, 2]
    k = g.shN.shape[1]
    planes = [
        fixed.view(np.uint8).reshape(len(g), 3, 4)[..., :3],
        _byte(255 * sigmoid(g.logit_opacities)),
        _byte(255 * (g.sh0.astype(np.float64) * COLOR_SCALE + 0.5)),
        _byte(16 * (g.log_scales.astype(np.float64) + 10)),
        np.ascontiguousarray(word, "<u4"),
        _byte(128 + 128 * g.shN.astype(np.float64) * RDF_SH[:k, None]),
    ]
    head = MAGIC + struct.pack("<IIBBBB", WRITTEN, len(g), SH_COUNTS[k], fraction, 0, 0)
    data = gzip.compress(head + b"".join(p.tobytes() for p in planes), mtime=0)
    with part_file(path) as part:
        part.write_bytes(data)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
