"""Bits per Gaussian of the positions, ours beside Draco's kd-tree coder at equal steps: bench/results/positions.json.

usage: GSCODEC_DATA=... python -m bench.positions [NAME=SPLAT ...]   (splats besides those of the data folder)

Both coders get the same set of integers, the points of Draco's quantization grid. Draco: DracoPy 2, compression level
10, order free. Ours: the positions units of a stream.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import DracoPy
import numpy as np

from gscodec import _native
from gscodec.bitstream.quantized_group import QuantizedChannels, QuantizedGroup
from gscodec.splats import open_sequence

from .data import data_folder
from .machine import RESULTS, write_result

BITS = (9, 10, 11, 12, 13, 14)
SCENES = {"statue": "splats/statue.ply", "playbot": "splats/playbot.ply", "fruit": "splats/fruit.ply", "wave": "wave"}


def ours(positions: np.ndarray) -> int:
    """Bytes of the positions, of all tiles."""
    channels = {}
    for name, count in (("log_scales", 3), ("quats", 3), ("logit_opacities", 1), ("sh0", 3)):
        values = np.zeros((count, len(positions)), np.int32)
        channels[name] = QuantizedChannels(values, np.ones(count, np.float32), np.zeros(count, np.float32))
    group = QuantizedGroup(
        frames=1,
        origin=np.zeros(3, np.float32),
        grid_step=1.0,
        grid_bits=max(1, int(positions.max()).bit_length()),
        positions=positions[_native.morton_order(positions)],
        channels=channels,
    )
    _, units = _native.encode_group(group)
    return sum(u["bytes"] for u in units if u["type"] == "positions")


def compare(name: str, means: np.ndarray, bits: int) -> dict:
    """One row of the table."""
    extent = float((means.max(0) - means.min(0)).max())
    step = extent / (2**bits - 1)
    positions = np.rint((means - means.min(0)) / step).astype(np.uint32)
    draco = DracoPy.encode(means, quantization_bits=bits, compression_level=10, preserve_order=False)
    per = 8 / len(means)
    a, b = ours(positions) * per, len(draco) * per
    return {
        "scene": name,
        "gaussians": len(means),
        "bits_per_axis": bits,
        "step": step,
        "ours": round(a, 2),
        "draco": round(b, 2),
        "saved": round(1 - a / b, 3),
    }


def main() -> None:
    """Writes the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("splats", nargs="*", metavar="NAME=SPLAT", help="splats besides those of the data folder")
    named = parser.parse_args().splats
    data = data_folder()
    scenes = {n: data / p for n, p in SCENES.items()} | dict(a.split("=", 1) for a in named)
    rows = []
    for name, path in scenes.items():
        means = np.unique(open_sequence(Path(path)).frame(0).means, axis=0)
        rows += [compare(name, means, bits) for bits in BITS]
    write_result(RESULTS / "positions.json", {"rows": rows})
    print(*rows, sep="\n")


if __name__ == "__main__":
    main()
