"""A capture in tracks beside the same capture as one track: bytes of each group, and PSNR at the test cameras.

usage: python -m bench.capture_tracks NAME WHOLE TRACKS.gsv ONE.gsv

WHOLE is the capture without masks; both streams were encoded from its frames, with the same options. NAME is the name
of the capture. bench/results/tracks.json holds the figures of docs/tracks.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from gscodec.capture import Capture, open_capture
from gscodec.decode import Scene, open_scene
from gscodec.metrics.evaluate import evaluate_capture

from .machine import RESULTS, update_entries


def entries(name: str, capture: Capture, paths: dict[str, Path]) -> Iterator[dict]:
    """Size and quality of each stream; `paths`: "tracks" and "one"."""
    for kind, path in paths.items():
        scene, size = open_scene(path), path.stat().st_size
        found = evaluate_capture(scene.frame, capture, size=size, with_vmaf=False)
        yield {
            "capture": name,
            "stream": kind,
            "frames": scene.frame_count,
            "bytes": size,
            "kb_per_frame": found["kb_per_frame"],
            "psnr": found["psnr"],
            "ssim": found["ssim"],
            "kb_per_frame_later": _later(scene),
            "room_share_later": _later(scene, "room") / _later(scene),
            "tracks": {t.placement.name: [g["size"] for g in t.stream.groups] for t in scene.tracks},
        }


def _later(scene: Scene, name: str | None = None) -> float:
    """kB per frame of all groups after the first ones; only of the track `name`, if it is given."""
    first = max(t.stream.groups[0]["frames"] for t in scene.tracks)
    own = [t for t in scene.tracks if name in (None, t.placement.name)]
    later = sum(g["size"] for t in own for g in t.stream.groups if g["start_frame"] > 0)
    return later / max(scene.frame_count - first, 1) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("name")
    for argument in ("whole", "tracks", "one"):
        parser.add_argument(argument, type=Path)
    a = parser.parse_args()
    found = entries(a.name, open_capture(a.whole), {"tracks": a.tracks, "one": a.one})
    for entry in update_entries(RESULTS / "tracks.json", found, lambda e: (e["capture"], e["stream"])):
        print({k: v for k, v in entry.items() if k != "measured"})


if __name__ == "__main__":
    main()
