"""Length of a group, and frames between independent groups: size, quality and time of a walk of 150 frames.

usage: python -m bench.gop [--gop 20,30] [--random-access 60,150] [--preset fast] [--data FOLDER]

The walk is that of lumberjack, five times round, at half its size. Two training cameras are held out and measured,
since the lengths are chosen by them. bench/results/gop.json has an entry for each pair of lengths: PSNR of the decoded
subject over all frames, in each group, and at the edges of groups; kB/frame of the first and of later groups. Every
independent group begins with a keyframe, as `gscodec encode` trains it.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np

from gscodec.capture import Capture

from .machine import update_entries
from .train import CASES, coded, evaluate, held_out, sequence, shown

HELD_OUT = ("cam08", "cam12")
RESULTS = Path("bench/results/gop.json")
KEY = ("capture", "preset", "gop", "random_access")  # identity of an entry


def walk(data: Path) -> Capture:
    """The capture, without its test cameras."""
    return held_out(replace(CASES["lumberjack-150"], scale=0.5).open(data), HELD_OUT)


def measure(gop: int, random_access: int, preset: str, data: Path) -> dict:
    """The entry of one pair of lengths."""
    from gscodec.encode.settings import EncodeSettings
    from gscodec.train.settings import coding_loss, train_settings

    capture, settings = walk(data), train_settings(preset, gop=gop)
    groups, trained = sequence(capture, settings, random_access)
    encoding = EncodeSettings(None, loss=coding_loss(preset, capture), random_access=random_access)
    size, decoded, seconds, report = coded(capture, groups, settings, encoding)
    result = evaluate(capture, decoded)
    psnr = np.array([f["psnr_fg"] for f in result["per_frame"]])
    starts = np.cumsum([0, *(len(g) for g in groups)])
    edges = sorted({int(t) for a, b in pairwise(starts) for t in (a, b - 1)})
    first, later = report.group_rates()
    return {
        "capture": "lumberjack-150, half size",
        "held_out": list(HELD_OUT),
        "preset": preset,
        "gop": gop,
        "random_access": random_access,
        "seconds_per_frame": round((sum(trained) + seconds) / len(decoded), 2),
        "psnr_of_model": round(evaluate(capture, shown(groups))["psnr_fg"], 3),
        "psnr": round(result["psnr_fg"], 3),
        "psnr_of_group": [round(float(psnr[a:b].mean()), 3) for a, b in pairwise(starts)],
        "psnr_at_edges": round(float(psnr[edges].mean()), 3),
        "flicker": result["flicker"],
        "coded_quality": round(report.quality, 2),
        "kb_per_frame": round(size / 1000 / len(decoded), 3),
        "kb_per_frame_of_first_group": round(first, 3),
        "kb_per_frame_of_later_groups": later and round(later, 3),
        "groups": report.group_list,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gop", default="20,30", help="lengths of a group, comma-separated")
    parser.add_argument("--random-access", default="60,150", help="frames from one independent group to the next")
    parser.add_argument("--preset", default="fast", choices=("fast", "medium", "slow"))
    parser.add_argument("--data", type=Path, default=os.environ.get("GSCODEC_DATA"), help="folder with the captures")
    parser.add_argument("--out", type=Path, default=RESULTS, help="the result file; its other entries stay")
    args = parser.parse_args()
    if args.data is None:
        parser.error("needs the data folder, set --data or GSCODEC_DATA")
    pairs = product(*([int(n) for n in lengths.split(",")] for lengths in (args.gop, args.random_access)))
    entries = (measure(gop, random_access, args.preset, Path(args.data)) for gop, random_access in pairs)
    for e in update_entries(args.out, entries, lambda e: [e[k] for k in KEY]):
        print({k: v for k, v in e.items() if k != "groups"}, flush=True)


if __name__ == "__main__":
    main()
