"""Source of each figure of README.md and docs/: its file in bench/results, command, commit, and load by other work.

Figures are measured at the commit, without uncommitted changes. Load: the number of cores that other work kept busy.

usage: python -m bench.sources        writes the table into docs/figures.md; a test compares both
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator

from .machine import RESULTS, ROOT

PAGE = ROOT / "docs" / "figures.md"
HEAD = "| figures | file in bench/results | command | commit | busy beside |\n|---|---|---|---|---|\n"
FILES = {  # figures -> file, command
    "bundled lumberjack": ("demo.json", "python -m bench.run demo"),
    "statue, 20 frames": ("statue.json", "python -m bench.run statue"),
    "statue, 40 frames": ("statue40.json", "python -m bench.run statue40"),
    "yellow_clip3.splatv": ("splatv.json", "python -m bench.run splatv"),
    "rasterizer": ("raster.json", "gscodec bench raster"),
    "tiles": ("tiles.json", "python -m bench.tiles"),
    "training and decoding by cores": ("cores.json", "python -m bench.cores"),
    "layers": ("layers.json", "python -m bench.layers"),
    "rate term beside the bits of the coder": ("rate_term.json", "python -m bench.rate_term"),
}


def table() -> str:
    """The table in markdown, one row per figure or group of figures."""
    return HEAD + "".join(f"| {' | '.join(row)} |\n" for row in _rows())


def _rows() -> Iterator[tuple[str, ...]]:
    for what, (file, command) in FILES.items():
        yield what, file, f"`{command}`", _commits([json.loads((RESULTS / file).read_text())]), "-"
    for e in _entries("train.json"):
        quality = "" if e["quality"] is None else f"{e['quality']:g}"
        what = f"{e['capture']}, {e['preset']}, {e['recipe']}" + (quality and f", quality {quality}")
        recipe = e["recipe"].removesuffix("-coded").replace("model", "gscodec")
        command = f"gscodec bench train --capture {e['capture']} --preset {e['preset']} --recipe {recipe}"
        first, stop, step = e["frames"]
        command += f" --frames {first}:{stop}:{step}" if step > 1 else ""
        command += quality and f" --also {quality}"
        yield what, "train.json", f"`{command}`", _commits([e]), f"{e['measured'].get('busy_beside', '-')}"
    for file, what, command in (
        ("rd.json", "other codecs", "gscodec bench rd"),
        ("ablation.json", "losses and tools", "gscodec bench ablation"),
        ("stress.json", "stress", "gscodec bench stress"),
        (
            "fast_motion.json",
            "fast motion, 12 frames",
            'gscodec bench stress --case "fast motion" --frames 12 --out FILE',
        ),
        ("gop.json", "length of groups", "python -m bench.gop"),
        ("rig.json", "a rig", "python -m bench.rig"),
        ("fuzz.json", "fuzzing", "python -m bench.fuzz"),
    ):
        yield what, file, f"`{command}`", _commits(_entries(file)), "-"
    for file, what, module in (
        ("player.json", "page", "player FOLDER"),
        ("player_decode.json", "page, decoding shared by workers", "player_decode FOLDER"),
        ("player_tiles.json", "page, tiles in view", "player_tiles FOLDER"),
        ("points.json", "sparse points", "sparse_points"),
        ("depth.json", "depth images", "depth"),
        ("tracks.json", "a capture in tracks", "capture_tracks"),
    ):
        yield what, file, f"`python -m bench.{module}`", _commits(_entries(file)), "-"


def _entries(file: str) -> list[dict]:
    return json.loads((RESULTS / file).read_text())["entries"]


def _commits(results: list[dict]) -> str:
    """The commits of some results, in alphabetical order; "not recorded" where there is none."""
    found = {r.get("measured", r).get("commit") or r.get("commit") for r in results}
    return ", ".join(sorted(c for c in found if isinstance(c, str))) or "not recorded"


def with_table(page: str) -> str:
    """The text of the page with the current table."""
    return re.sub(re.escape(HEAD) + r"(\|.*\n)*", lambda _: table(), page)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.split("\n")[0], usage="python -m bench.sources").parse_args()
    PAGE.write_text(with_table(PAGE.read_text()))
