"""Report on a stream, for people and scripts: bytes by unit and attribute."""

from __future__ import annotations

from .scene import Scene
from .stream import Stream


def describe(stream: Stream) -> dict:
    """Facts of a whole file.

    `units` maps the name of a unit, or of a stream of the tiles, to bytes, share of the file, and bits per Gaussian and
    group; `layers` has the bytes of each layer. Rates are None for a file without frames.
    """
    units: dict[str, int] = {}
    layers: dict[int, int] = {}
    groups, most, gaussian_frames = [], 0, 0
    for i, g in enumerate(stream.groups):
        decoded = stream.group(i)
        most = max(most, decoded.count)
        gaussian_frames += decoded.count * g["frames"]
        tiles = decoded.tiles()
        groups.append(
            {
                "start_frame": g["start_frame"],
                "frames": g["frames"],
                "bytes": g["size"],
                "gaussians": decoded.count,
                "tiles": [len(own) for own in tiles],
                "reference": i - decoded.reference if decoded.reference else None,
            }
        )
        for u in decoded.units():
            name = " ".join(x for x in (u["type"], u["attribute"]) if x)
            units[name] = units.get(name, 0) + u["bytes"]
            layers[u["layer"]] = layers.get(u["layer"], 0) + u["bytes"]
    total, frames = stream.byte_count, stream.frame_count
    sound = describe_audio(stream)
    if sound:
        units["sound"] = sound["bytes"]
    units["container"] = total - sum(units.values())
    coded = sum(g["gaussians"] for g in groups)
    per = {n: 8 * b / coded if coded else None for n, b in units.items()}
    return {
        "frames": stream.frame_count,
        "fps": stream.fps,
        "groups": len(groups),
        "gaussians": most,
        "bytes": total,
        "kb_per_frame": total / frames / 1000 if frames else None,
        "mbit_per_s": 8e-6 * total / frames * stream.fps if frames else None,
        "bits_per_gaussian_frame": 8 * total / gaussian_frames if gaussian_frames else None,
        "sh_degree": stream.config["sh_degree"],
        "level": stream.config["level"],
        "up": stream.config["up"],
        "cameras": [c["name"] for c in stream.config["cameras"]],
        "sound": sound,
        "complete": stream.complete,
        "units": {n: {"bytes": b, "share": b / max(total, 1), "bits_per_gaussian": per[n]} for n, b in units.items()},
        "layers": [{"bytes": layers[k]} for k in sorted(layers)],
        "per_group": groups,
    }


def describe_scene(scene: Scene) -> dict:
    """Facts of a file with tracks: for each track those of `describe`, and name, hidden, offset (seconds), repeats and
    number of keys."""
    frames = scene.frame_count
    tracks = []
    for t in scene.tracks:
        p = t.placement
        place = {"name": p.name, "hidden": p.hidden, "offset": p.offset / t.rate[0]}
        tracks.append(place | {"repeats": p.repeats, "keys": len(p.keys)} | describe(t.stream))
    return {
        "frames": frames,
        "fps": scene.fps,
        "bytes": scene.byte_count,
        "kb_per_frame": scene.byte_count / frames / 1000 if frames else None,
        "complete": scene.complete,
        "tracks": tracks,
    }


def describe_audio(stream: Stream) -> dict | None:
    """codec, rate (Hz), channels, seconds and bytes of the sound; None: there is none."""
    track = stream.config.get("audio")
    if track is None:
        return None
    runs = [g["audio"] for g in stream.groups if "audio" in g]  # (offset, time, samples)
    entry, samples = track["entry"], [s for _, _, run in runs for s in run]
    end = max((time + sum(d for _, d in run) for _, time, run in runs), default=track["media_start"])
    return {
        "codec": {b"mp4a": "AAC", b"Opus": "Opus"}[entry[4:8]],
        "rate": int.from_bytes(entry[32:34], "big") or track["timescale"],  # the entry has no room for 96 kHz
        "channels": int.from_bytes(entry[24:26], "big"),
        "seconds": max(end - track["media_start"], 0) / track["timescale"],
        "bytes": sum(size for size, _ in samples),
    }
