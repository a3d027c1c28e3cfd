"""SuperSplat .compressed.ply <-> Gaussians: 16 bytes per Gaussian, quantized in chunks of 256.

Each chunk has its range of positions, log scales and colours; a Gaussian has four words: position and scale in
11+10+11 bits, the three smallest quaternion components in 10 bits each after the index of the largest (wxyz),
colour and opacity in 8 bits. SH coefficients are bytes over -4..4 in an element of their own. Other writers sort the
Gaussians; this one keeps their order, so that index i is the same Gaussian in all frames of a sequence.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError
from ..model.gaussians import SH_C0, Gaussians, logit, sigmoid
from ..ply_table import write_table
from .ply import join_rest, sh_count, split_rest, stack
from .smallest_three import join_smallest_three, split_smallest_three

CHUNK = 256
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BITS = (11, 10, 11)
RANGES = {
    "position": [f"{m}_{a}" for m in ("min", "max") for a in "xyz"],
    "scale": [f"{m}_scale_{a}" for m in ("min", "max") for a in "xyz"],
    "color": [f"{m}_{a}" for m in ("min", "max") for a in "rgb"],
}
SCALE_LIMIT = 20.0  # log scales are clipped to +- this: one outlier would take the precision of its whole chunk


def is_compressed(table: dict[str, np.ndarray]) -> bool:
    """Whether an element table has this layout."""
    return "chunk" in table and "vertex" in table and WORDS[0] in (table["vertex"].dtype.names or ())


def gaussians_of_compressed(table: dict[str, np.ndarray], path: Path) -> Gaussians:
    """The Gaussians of an element table in this layout.

    Raises:
        CaptureError: a property is missing or the elements do not fit together.
    """
    rows, chunks = table["vertex"], table["chunk"]
    ranged = bool({*RANGES["color"]} & {*chunks.dtype.names})  # before 2024 there was none, and colours are in 0..1
    names = [*WORDS, *RANGES["position"], *RANGES["scale"], *(RANGES["color"] if ranged else ())]
    missing = [n for n in names if n not in (*rows.dtype.names, *chunks.dtype.names)]
    if missing:
        raise CaptureError(f"{path}: no property {', '.join(missing)}, expected a SuperSplat compressed PLY")
    if len(chunks) != -(-len(rows) // CHUNK):
        expected = -(-len(rows) // CHUNK)
        raise CaptureError(f"{path}: {len(chunks)} chunks for {len(rows)} Gaussians, expected {expected} of {CHUNK}")
    position, rotation, scale, color = (rows[w].astype(np.uint32) for w in WORDS)
    rgba = np.stack([color >> s & 255 for s in (24, 16, 8, 0)], 1) / 255
    rgb = _unscale(rgba[:, :3], chunks, "color") if ranged else rgba[:, :3]
    small = (np.stack([rotation >> s & 1023 for s in (20, 10, 0)], 1) / 1023 - 0.5) * np.sqrt(2)
    return Gaussians(
        means=_unscale(_unpack(position), chunks, "position"),
        quats=join_smallest_three(small, rotation >> 30),
        log_scales=_unscale(_unpack(scale), chunks, "scale"),
        logit_opacities=logit(rgba[:, 3]),
        sh0=(rgb - 0.5) / SH_C0,
        shN=_read_sh(table, path, len(rows)),
    ).validate(str(path))


def _read_sh(table: dict[str, np.ndarray], path: Path, count: int) -> np.ndarray:
    if "sh" not in table:
        return np.zeros((count, 0, 3), np.float32)
    rows = table["sh"]
    k = sh_count(rows.dtype.names or (), path)
    if len(rows) != count:
        raise CaptureError(f"{path}: {len(rows)} rows of SH for {count} Gaussians, expected as many")
    code = stack(rows, [f"f_rest_{i}" for i in range(3 * k)])
    unit = np.where(code == 0, 0, np.where(code == 255, 1, (code + 0.5) / 256))
    return split_rest((unit - 0.5) * 8)


def _unpack(word: np.ndarray) -> np.ndarray:
    """[N] u32 -> [N, 3] f64 in 0..1."""
    parts = (word >> 21, word >> 11 & 1023, word & 2047)
    return np.stack([p / ((1 << b) - 1) for p, b in zip(parts, BITS, strict=True)], 1)


def _pack(unit: np.ndarray) -> np.ndarray:
    """[N, 3] in 0..1 -> [N] u32, the mirror of _unpack."""
    x, y, z = (_code(unit[:, i], b) for i, b in enumerate(BITS))
    return x << 21 | y << 11 | z


def _code(unit: np.ndarray, bits: int) -> np.ndarray:
    top = (1 << bits) - 1
    return np.clip(np.floor(unit * top + 0.5), 0, top).astype(np.uint32)


def _unscale(unit: np.ndarray, chunks: np.ndarray, what: str) -> np.ndarray:
    bounds = np.repeat(stack(chunks, RANGES[what]).astype(np.float64), CHUNK, 0)[: len(unit)]  # [N, 6]
    return bounds[:, :3] * (1 - unit) + bounds[:, 3:] * unit


def _scale(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[N, 3] -> [N, 3] in 0..1 and the range of each chunk [C, 6] f32, the mirror of _unscale."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (f.reduceat(values, starts).astype(np.float32) for f in (np.minimum, np.maximum))
    a, b = (np.repeat(v.astype(np.float64), CHUNK, 0)[: len(values)] for v in (low, high))
    return (values - a) / np.where(b > a, b - a, 1), np.concatenate([low, high], 1)


def write_compressed_ply(path: Path, gaussians: Gaussians) -> None:
    """Writes a .compressed.ply, with SH if there is any.

    Raises:
        CaptureError: there are no Gaussians, which this format cannot express.
    """
    g = gaussians
    if not len(g):
        raise CaptureError(f"{path}: no Gaussians to write; use .ply for an empty frame")
    position, position_range = _scale(g.means.astype(np.float64))
    scale, scale_range = _scale(np.clip(g.log_scales.astype(np.float64), -SCALE_LIMIT, SCALE_LIMIT))
    color, color_range = _scale(g.sh0.astype(np.float64) * SH_C0 + 0.5)
    small, largest = split_smallest_three(g.quats)
    a, b, c = (_code(small[:, i] / np.sqrt(2) + 0.5, 10) for i in range(3))
    rgba = [_code(v, 8) for v in (*color.T, sigmoid(g.logit_opacities))]
    rows = np.zeros(len(g), [(w, "<u4") for w in WORDS])
    rows[WORDS[0]], rows[WORDS[2]] = _pack(position), _pack(scale)
    rows[WORDS[1]] = largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c
    rows[WORDS[3]] = rgba[0] << 24 | rgba[1] << 16 | rgba[2] << 8 | rgba[3]
    bounds = np.concatenate([position_range, scale_range, color_range], 1)
    chunks = np.ascontiguousarray(bounds).view([(n, "<f4") for names in RANGES.values() for n in names])[:, 0]
    table = {"chunk": chunks, "vertex": rows}
    if g.shN.shape[1]:
        code = np.clip(np.trunc((join_rest(g.shN) / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
        table["sh"] = np.ascontiguousarray(code).view([(f"f_rest_{i}", "u1") for i in range(code.shape[1])])[:, 0]
    write_table(path, table)
