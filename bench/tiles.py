"""Cost and gain of tiles: bytes by tile side, decoding on one core and all, views of a tenth of the Gaussians, damage.

usage: GSCODEC_DATA=... python -m bench.tiles [PAYLOAD]        writes bench/results/tiles.json

One frame of the statue at the default quality, or the independent group in the file PAYLOAD. The million Gaussians are
13 copies of its integers, so only their bytes and times are valid: their rotations follow other neighbours.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from gscodec import _native
from gscodec.bitstream.quantized_group import QuantizedGroup
from gscodec.encode.coder import GroupCoder
from gscodec.encode.settings import EncodeSettings
from gscodec.model.parametric_group import ParametricGroup
from gscodec.splats import read_splat

from .data import data_folder
from .machine import RESULTS, ROOT, write_result

LEVEL, QUALITY, COPIES, RUNS = 4, 50, 13, 15
SIDES = (4, 5, 6, 7)  # log2


def statue() -> bytes:
    """One frame of the statue, coded."""
    group = ParametricGroup(1, read_splat(data_folder() / "splats" / "statue.ply"))
    coder = GroupCoder(EncodeSettings(refine=0))
    coded, _ = coder.code(None, group, coder.measure(group, 0), QUALITY, 0)
    return coded.payload


def sizes(q: QuantizedGroup) -> list[dict]:
    """Bytes by the side of a tile."""
    payloads = {1 << side: _native.encode_group(replace(q, tile_side_log2=side))[0] for side in SIDES}
    tiles = {side: sum(map(len, _native.DecodedGroup(p, LEVEL).tiles())) for side, p in payloads.items()}
    return [{"side": side, "tiles": tiles[side], "bytes": len(p)} for side, p in payloads.items()]


def seconds(payload: bytes, tiles: list[list[bool]] | None = None) -> float:
    """Time of decoding: the fastest of several runs, which other work on the machine disturbs least."""
    times = []
    for _ in range(RUNS):
        start = perf_counter()
        _native.DecodedGroup(payload, LEVEL, tiles=tiles)
        times.append(perf_counter() - start)
    return min(times)


def by_threads(payload: bytes) -> list[dict]:
    """Time of decoding on one core, and on all."""
    rows = []
    with tempfile.NamedTemporaryFile(suffix=".payload") as f:
        f.write(payload)
        f.flush()
        for threads in sorted({1, os.cpu_count() or 1}):
            command = [sys.executable, "-m", "bench.tiles", f.name, "--only-decode"]
            env = os.environ | {"RAYON_NUM_THREADS": str(threads)}
            run = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=True)
            rows.append({"threads": threads, "ms": round(1e3 * float(run.stdout), 1)})
    return rows


def copies(q: QuantizedGroup) -> QuantizedGroup:
    """13 copies beside each other, on a grid of four times the side."""
    side = 1 << q.grid_bits
    places = [np.array([x, 0, z]) * side for x in range(4) for z in range(4)][:COPIES]
    positions = np.concatenate([q.positions + p for p in places]).astype(np.uint32)
    order = _native.morton_order(positions)
    channels = {n: replace(c, values=np.tile(c.values, COPIES)[:, order]) for n, c in q.channels.items()}
    return replace(
        q,
        grid_bits=q.grid_bits + 2,
        positions=positions[order],
        channels=channels,
        layers=None,
        corrections=None,
        shifts=None,
        trajectories={},
        nodes=None,
        lifetimes=None,
    )


def lens_of_view(group, share: float) -> tuple[np.ndarray, float]:
    """Eye [3] of a pinhole camera above the copies that looks down (-y) on about `share` of the Gaussians, and the
    tangent of half its angle."""
    means = group.frame(0)["means"]
    low, high = means.min(0), means.max(0)
    eye = (low + high) / 2 + np.array([0.11, 0, 0.07]) * (high - low)
    eye[1] = high[1] + (high - low).max()
    for slope in np.geomspace(2, 0.01, 200):
        if _inside(means[::50], planes_of_view(eye, slope)).mean() <= share:
            break
    return eye, float(slope)


def planes_of_view(eye: np.ndarray, slope: float) -> np.ndarray:
    """[5, 4] planes (inside: n x + d >= 0) of the camera of `lens_of_view`."""
    normals = np.array([[1, -slope, 0], [-1, -slope, 0], [0, -slope, 1], [0, -slope, -1], [0, -1, 0]])
    return np.column_stack([normals, -normals @ eye])


def _inside(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    return (points @ planes[:, :3].T + planes[:, 3] >= 0).all(1)


def touched(tile: dict, planes: np.ndarray) -> bool:
    """Whether the box of a tile is not wholly behind one of the planes."""
    low, high = (np.nan_to_num(np.array(tile[k]), posinf=1e9, neginf=-1e9) for k in ("low", "high"))
    far = np.where(planes[:, :3] > 0, high, low)  # the corner that is farthest along each normal
    return bool(((far * planes[:, :3]).sum(1) + planes[:, 3] >= 0).all())


def view(q: QuantizedGroup) -> dict:
    """Bytes and time of a view of a tenth of the copies, compared with all of them."""
    payload, _ = _native.encode_group(copies(q))
    whole = _native.DecodedGroup(payload, LEVEL)
    planes = planes_of_view(*lens_of_view(whole, 0.1))
    wanted = [[touched(tile, planes) for tile in own] for own in whole.tiles()]
    fetched = bytearray(len(payload))
    total = 0
    for u in _native.units(payload):
        if u["type"] != "tile" or u["index"] == 0 or wanted[u["layer"]][u["index"]]:
            start = 0 if u["unit"] == 0 else u["offset"]
            end = u["offset"] + u["bytes"]
            fetched[start:end] = payload[start:end]
            total += end - start
    part = _native.DecodedGroup(bytes(fetched), LEVEL, tiles=wanted)
    seen = lambda g: int(_inside(g.frame(0)["means"], planes).sum())  # noqa: E731
    times = seconds(payload), seconds(bytes(fetched), wanted)
    return {
        "gaussians": whole.count,
        "gaussians_in_view": seen(whole),
        "gaussians_in_view_of_part": seen(part),
        "gaussians_decoded": part.count,
        "tiles": len(wanted[0]),
        "tiles_decoded": sum(t["gaussians"] > 0 for t in part.tiles()[0]),
        "bytes": len(payload),
        "bytes_fetched": total,
        "byte_share": round(total / len(payload), 4),
        "ms": round(1e3 * times[0], 1),
        "ms_part": round(1e3 * times[1], 1),
        "time_share": round(times[1] / times[0], 4),
    }


def damage(payload: bytes) -> list[dict]:
    """Cost of one flipped bit, in each tile unit in turn: share of Gaussians kept, reported tiles."""
    sound, rows = _native.DecodedGroup(payload, LEVEL), []
    for u in _native.units(payload):
        if u["type"] != "tile":
            continue
        bad = bytearray(payload)
        bad[u["offset"] + u["bytes"] // 2] ^= 4
        try:
            got = _native.DecodedGroup(bytes(bad), LEVEL, False)
            kept, told = got.count / sound.count, [d["tile"] for d in got.damage()]
        except Exception as e:
            kept, told = 0.0, str(e).split(":")[0]
        rows.append({"layer": u["layer"], "tile": u["index"], "kept": round(kept, 4), "reported": told})
    return rows


def main() -> None:
    """Writes the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("payload", nargs="?", type=Path)
    parser.add_argument("--only-decode", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    payload = options.payload.read_bytes() if options.payload else statue()
    if options.only_decode:
        print(seconds(payload))
        return
    q = _native.DecodedGroup(payload, LEVEL).quantized()
    found = {"scene": "statue" if options.payload is None else options.payload.stem, "gaussians": len(q)}
    for name, measure in {"sizes": sizes, "view": view}.items():
        found[name] = measure(q)
        print(name, found[name], flush=True)
    for name, measure in {"threads": by_threads, "damage": damage}.items():
        found[name] = measure(payload)
        print(name, found[name], flush=True)
    write_result(RESULTS / "tiles.json", found)


if __name__ == "__main__":
    main()
