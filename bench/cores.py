"""Time of training and of decoding on 1, 2, 4, ... cores of a machine that has more.

usage: GSCODEC_DATA=... python -m bench.cores [--cores 1,2,4,8,16]        writes bench/results/cores.json

Training: seconds a frame of the bundled lumberjack, its first frames, preset fast. Decoding: milliseconds of one frame
of the statue. Each number of cores is a process of its own, bound to so many logical processors.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import takewhile
from pathlib import Path

from gscodec.capture import open_capture
from gscodec.train.settings import train_settings

from .machine import RESULTS, ROOT, write_result
from .tiles import seconds, statue
from .train import sequence

FRAMES = 8
PRESET = "fast"


def measured(payload: bytes) -> dict:
    """Both times, on the cores of this process."""
    capture = open_capture(ROOT / "examples" / "lumberjack").frames(0, FRAMES)
    decoding = seconds(payload)
    _, training = sequence(capture, train_settings(PRESET))
    return {"train_s_per_frame": round(sum(training) / FRAMES, 2), "decode_ms": round(1e3 * decoding, 1)}


def bound_to(cores: int, payload: Path) -> dict:
    """Both times, measured by a process on the first `cores` logical processors."""
    usable = ",".join(str(c) for c in sorted(os.sched_getaffinity(0))[:cores])
    command = ["taskset", "--cpu-list", usable, sys.executable, "-m", "bench.cores", "--payload", str(payload)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return {"cores": cores, **json.loads(run.stdout)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    most = len(os.sched_getaffinity(0))
    powers = takewhile(lambda n: n <= most, (1 << k for k in range(16)))
    parser.add_argument("--cores", default=",".join(map(str, powers)), help="comma-separated numbers")
    parser.add_argument("--payload", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.payload:
        print(json.dumps(measured(args.payload.read_bytes())))
        return
    with tempfile.TemporaryDirectory() as folder:
        payload = Path(folder) / "statue.payload"
        payload.write_bytes(statue())
        rows = [bound_to(int(n), payload) for n in args.cores.split(",")]
    write_result(RESULTS / "cores.json", {"preset": PRESET, "frames": FRAMES, "rows": rows})


if __name__ == "__main__":
    main()
