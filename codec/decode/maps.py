"""Stream -> attribute maps: one picture of the planes with their tiles, or a folder of 16-bit images, the sound and
maps.json, from which encode/from_maps.py makes the same bytes again.

A plane has one integer per Gaussian (spec 7.2). Its image holds bits 0 to 15 of integer minus minimum; a second image
holds the higher bits if any is set; maps.json has the minimum. Planes of zeros are left out. The sound file is the
concatenation of all samples; maps.json has their sizes and durations by group, and the sample entry.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

import numpy as np

from ..bitstream.hilbert_layout import HilbertLayout
from ..bitstream.quantized_group import QuantizedGroup
from ..render.png import write_png
from .stream import Stream

FORMAT = "gscodec maps 2"
SOUND = "sound.bin"
EMPTY, BORDER = (24, 28, 48), (255, 150, 30)  # colours of cells without a Gaussian, and between tiles
MOST_COLUMNS = 9


def planes(q: QuantizedGroup) -> Iterator[tuple[str, np.ndarray]]:
    """Name and [N] i64 integers of every plane of a group."""
    for axis in range(3):
        yield f"means_{axis}", q.positions[:, axis].astype(np.int64)
    for name, channels in q.channels.items():
        for c, values in enumerate(channels.values):
            yield f"{name}_{c}", values.astype(np.int64)
    for name, t in q.trajectories.items():
        for k, rows in enumerate(t.coefficients):
            for c, values in enumerate(rows):
                yield f"trajectory_{name}_{k}_{c}", values.astype(np.int64)
    for edge in range(0 if q.lifetimes is None else 2):
        yield f"lifetimes_{edge}", q.lifetimes[:, edge].astype(np.int64)
    if q.parents is not None:
        yield "parents", q.parents.astype(np.int64)


def layouts(decoded) -> list[HilbertLayout]:
    """The maps of the layers of a `_native.DecodedGroup`."""
    side = 1 << decoded.quantized().tile_side_log2
    return [HilbertLayout.of([t["gaussians"] for t in tiles], side) for tiles in decoded.tiles()]


def write_maps(stream: Stream, folder: Path) -> int:
    """Writes all planes of all groups as 16-bit grey PNG images, the sound and, last, maps.json. Returns the number of
    images."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    groups, count = [], 0
    for i, g in enumerate(stream.groups):
        decoded = stream.group(i)
        q, own = decoded.quantized(), {}
        ends = [0, *accumulate(q.layers)]
        for k, layout in enumerate(layouts(decoded)):
            for name, values in planes(q):
                values = values[ends[k] : ends[k + 1]]
                if values.any():
                    low = int(values.min())
                    file = f"group{i:04d}_layer{k}_{name}"
                    count += _write_plane(folder / file, layout.arrange(values - low))
                    own[f"{k} {name}"] = low
        tiles = [[t["gaussians"] for t in tiles] for tiles in decoded.tiles()]
        _, time, samples = g.get("audio", (0, 0, []))
        sound = {"time": time, "samples": samples}
        groups.append({"sync": g["sync"], "tiles": tiles, "planes": own, "sound": sound} | _facts(q))
    config = {k: v for k, v in stream.config.items() if k not in ("track", "placement")}  # not in maps
    if audio := config.get("audio"):
        config["audio"] = audio | {"entry": audio["entry"].hex()}
        _write(folder / SOUND, b"".join(stream.sound(i) for i in range(len(stream.groups))))
    facts = {"format": FORMAT, "config": _plain(config), "groups": groups}
    _write(folder / "maps.json", json.dumps(facts, indent=1).encode())
    return count


def _write(path: Path, data: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    os.replace(part, path)


def _write_plane(path: Path, plane: np.ndarray) -> int:
    """Writes bits 0 to 15 to PATH.png, and the higher bits to PATH.high.png if any is set; returns how many images."""
    write_png(path.with_name(path.name + ".png"), (plane & 0xFFFF).clip(0).astype(np.uint16))
    high, more = plane.clip(0) >> 16, path.with_name(path.name + ".high.png")
    if not high.any():
        more.unlink(missing_ok=True)  # of earlier maps
        return 1
    write_png(more, high.astype(np.uint16))
    return 2


def _facts(q: QuantizedGroup) -> dict:
    """All fields of a group except its planes, JSON-able; f32 are exact as floats."""
    plain = ("frames", "origin", "grid_step", "grid_bits", "layers", "shifts", "corrections", "scale_exponents")
    facts = {name: _plain(getattr(q, name)) for name in (*plain, "tile_side_log2", "reference", "turned_harmonics")}
    facts["channels"] = {
        n: _plain({"steps": c.steps, "offsets": c.offsets, "companding": c.companding}) for n, c in q.channels.items()
    }
    facts["trajectories"] = {
        n: {"coefficients": len(t.coefficients), "channels": t.coefficients.shape[1], "step": t.step}
        for n, t in q.trajectories.items()
    }
    facts["lifetimes"] = q.lifetimes is not None
    facts["nodes"] = None if q.nodes is None else _plain({n: v for n, v in vars(q.nodes).items() if n != "rig"})
    if q.nodes is not None and q.nodes.rig is not None:
        facts["nodes"]["rig"] = _plain(vars(q.nodes.rig))
    return facts


def _plain(value):
    """Arrays, and tuples and dicts of them, as JSON types."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def draw_maps(stream: Stream, path: Path) -> list[str]:
    """Draws the planes of positions and channels of the first group with the borders of their tiles: a row for each
    attribute, layer below layer. Returns the names of the rows, from the top."""
    decoded = stream.group(0)
    q = decoded.quantized()
    ends, rows, names = [0, *accumulate(q.layers)], [], []
    shown = [("means", q.positions.T)] + [(n, c.values) for n, c in q.channels.items()]
    for k, layout in enumerate(layouts(decoded)):
        if not layout.height:
            continue
        zoom = max(1, 256 // layout.width)
        for name, channels in shown:
            tiles = [_tile_picture(layout, c[ends[k] : ends[k + 1]], zoom) for c in channels[:MOST_COLUMNS]]
            rows.append(np.concatenate(tiles, 1))
            names.append(f"{name}, layer {k}" if len(q.layers) > 1 else name)
    width = max((r.shape[1] for r in rows), default=1)
    canvas = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0))) for r in rows]
    write_png(Path(path), np.concatenate(canvas) if canvas else np.zeros((1, 1, 3), np.uint8))
    return names


def _tile_picture(layout: HilbertLayout, values: np.ndarray, zoom: int) -> np.ndarray:
    """[h, w, 3] u8: a plane from its 1st percentile (black) to its 99th (white)."""
    low, high = np.percentile(values, [1, 99])
    grey = np.clip((values - low) / max(high - low, 1) * 255, 0, 255).astype(np.uint8)
    picture = np.empty((layout.height, layout.width, 3), np.uint8)
    picture[:] = EMPTY
    picture[layout.y, layout.x] = grey[:, None]
    picture = picture.repeat(zoom, 0).repeat(zoom, 1)
    picture[:: layout.side * zoom] = BORDER
    picture[:, :: layout.side * zoom] = BORDER
    return np.pad(picture, ((0, 8), (0, 8), (0, 0)))
