"""Attribute maps -> .gsv: the inverse of decode/maps.py, to the same bytes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from .. import _native
from ..bitstream.hilbert_layout import HilbertLayout
from ..bitstream.quantized_group import (
    QuantizedChannels,
    QuantizedGroup,
    QuantizedNodes,
    QuantizedRig,
    QuantizedTrajectories,
)
from ..decode.maps import FORMAT, SOUND
from ..errors import UsageError, require
from .audio import AudioTrack, GroupSound
from .writer import StreamWriter


def encode_maps(folder: Path, out: Path, audio: AudioTrack | None = None) -> tuple[int, int]:
    """Codes the planes in `folder`, with their sound. Returns frames and bytes.

    Args:
        audio: sound that replaces the sound of the maps.

    Raises:
        UsageError: maps.json or an image is missing, is not such a file, or does not fit the others.
    """
    folder, out = Path(folder), Path(out)
    try:
        facts = json.loads((folder / "maps.json").read_text())
        if facts["format"] != FORMAT:
            raise ValueError(f"the format is {facts['format']}, expected {FORMAT}")
        groups = [_group(folder, i, g) for i, g in enumerate(facts["groups"])]
        payloads = _payloads(groups)
        config = facts["config"] | {"fps": tuple(facts["config"]["fps"])}
        for camera in config["cameras"]:
            camera |= {name: np.array(camera[name]) for name in ("K", "viewmat")}
        syncs = [g["sync"] for g in facts["groups"]]
        own = _sound(folder, config.pop("audio", None), facts["groups"])
    except (OSError, ValueError, KeyError, IndexError, TypeError) as e:
        reason = f"{type(e).__name__} {e}" if isinstance(e, KeyError) else str(e)
        raise UsageError(f"{folder}: no attribute maps as `gscodec decode --maps` writes them: {reason}") from None
    made_of = hashlib.sha256(b"".join(payloads)).hexdigest()[:16]
    writer = StreamWriter(out, config, {"maps": made_of}, audio or own)
    there = writer.groups  # groups of an interrupted run
    for q, payload, sync in zip(groups[there:], payloads[there:], syncs[there:], strict=True):
        writer.append(payload, q.frames, sync=sync)
    writer.finish()
    return sum(q.frames for q in groups), out.stat().st_size


def _sound(folder: Path, config: dict | None, groups: list[dict]) -> GroupSound | None:
    """The sound beside the maps; None where there is none."""
    if config is None:
        return None
    data, at, frame, runs = (folder / SOUND).read_bytes(), 0, 0, {}
    for g in groups:
        samples = [(int(size), int(duration)) for size, duration in g["sound"]["samples"]]
        size = sum(s for s, _ in samples)
        if samples:
            runs[frame] = int(g["sound"]["time"]), samples, data[at : at + size]
        at, frame = at + size, frame + g["frames"]
    if at != len(data):
        raise ValueError(f"{SOUND} has {len(data)} bytes, expected {at} as maps.json says")
    return GroupSound(config | {"entry": bytes.fromhex(config["entry"])}, runs)


def _payloads(groups: list[QuantizedGroup]) -> list[bytes]:
    decoded, out = [], []
    for i, q in enumerate(groups):
        reference = decoded[i - q.reference] if q.reference else None
        out.append(_native.encode_group(q, reference)[0])
        independent = None if q.reference else _native.DecodedGroup(out[-1], len(_native.levels()))
        decoded.append(independent)
    return out


def _group(folder: Path, i: int, g: dict) -> QuantizedGroup:
    side = 1 << g["tile_side_log2"]
    maps = [HilbertLayout.of(tiles, side) for tiles in g["tiles"]]

    def plane(name: str) -> np.ndarray:
        parts = []
        for k, layout in enumerate(maps):
            low = g["planes"].get(f"{k} {name}")
            file = folder / f"group{i:04d}_layer{k}_{name}"
            none = np.zeros(len(layout.x), np.int64)
            parts.append(none if low is None else layout.collect(_read_plane(file, layout)) + low)
        return np.concatenate(parts)

    array = lambda v, dtype: None if v is None else np.array(v, dtype)  # noqa: E731
    channels = {n: _channels(n, c, plane) for n, c in g["channels"].items()}
    trajectories = {n: _trajectories(n, t, plane) for n, t in g["trajectories"].items()}
    positions = np.stack([plane(f"means_{a}") for a in range(3)], 1).astype(np.uint32)
    return QuantizedGroup(
        frames=g["frames"],
        origin=np.array(g["origin"], np.float32),
        grid_step=g["grid_step"],
        grid_bits=g["grid_bits"],
        positions=positions,
        channels=channels,
        trajectories=trajectories,
        nodes=_nodes(g["nodes"]) if g["nodes"] else None,
        lifetimes=np.stack([plane(f"lifetimes_{e}") for e in range(2)], 1).astype(np.uint16)
        if g["lifetimes"]
        else None,
        layers=tuple(g["layers"]),
        shifts=array(g["shifts"], np.uint8),
        corrections=array(g["corrections"], np.float32),
        scale_exponents=np.array(g["scale_exponents"], np.int32),
        tile_side_log2=g["tile_side_log2"],
        reference=g["reference"],
        parents=plane("parents").astype(np.int32) if g["reference"] else None,
        turned_harmonics=g.get("turned_harmonics", False),  # maps of earlier versions do not have it
    )


def _channels(name: str, c: dict, plane) -> QuantizedChannels:
    values = np.stack([plane(f"{name}_{k}") for k in range(len(c["steps"]))]).astype(np.int32)
    companding = None if c["companding"] is None else np.array(c["companding"], np.float32)
    return QuantizedChannels(values, np.array(c["steps"], np.float32), np.array(c["offsets"], np.float32), companding)


def _trajectories(name: str, t: dict, plane) -> QuantizedTrajectories:
    rows = [[plane(f"trajectory_{name}_{k}_{c}") for c in range(t["channels"])] for k in range(t["coefficients"])]
    return QuantizedTrajectories(np.array(rows, np.int32), t["step"])


def _nodes(n: dict) -> QuantizedNodes:
    positions, coefficients = np.array(n["positions"], np.uint32), np.array(n["coefficients"], np.int32)
    steps, rig = (n["rotation_step"], n["translation_step"]), n.get("rig")
    return QuantizedNodes(positions, coefficients, *steps, n["neighbors"], rig and _rig(rig))


def _rig(r: dict) -> QuantizedRig:
    arrays = {n: np.array(r[n], np.int32) for n in ("joints", "bind", "poses")}
    arrays |= {n: np.array(r[n], np.uint8) for n in ("parents", "weights")}
    return QuantizedRig(**arrays, rotation_step=r["rotation_step"], translation_step=r["translation_step"])


def _read_plane(path: Path, layout: HilbertLayout) -> np.ndarray:
    """[H, W] i64 of PATH.png and, where it is there, PATH.high.png."""
    plane = _read_png(path.with_name(path.name + ".png"), layout)
    high = path.with_name(path.name + ".high.png")
    return plane + (_read_png(high, layout) << 16 if high.exists() else 0)


def _read_png(path: Path, layout: HilbertLayout) -> np.ndarray:
    oiio = require("OpenImageIO", "reading maps")
    image = oiio.ImageInput.open(str(path))
    if image is None:
        raise ValueError(f"{path.name} is missing or no image ({oiio.geterror() or 'unknown format'})")
    spec = image.spec()
    values = image.read_image(oiio.UINT16)
    image.close()
    if values is None or (spec.height, spec.width, spec.nchannels) != (layout.height, layout.width, 1):
        size = f"{spec.width} x {spec.height} pixels of {spec.nchannels} channels"
        raise ValueError(f"{path.name} has {size}, expected {layout.width} x {layout.height} of 1 channel")
    return np.asarray(values).reshape(layout.height, layout.width).astype(np.int64)
