"""Fuzzes the demuxer, the unit parser and the entropy decoders; bench/results/fuzz.json counts the executions.

usage: python -m bench.fuzz [--seconds 180]        seconds per target; needs a nightly toolchain and cargo-fuzz

Each target runs in libFuzzer without a sanitizer, since the code has no unsafe block, and with limits on the time and
memory of one input. A finding ends the run. Counts add up over runs, per state of the code (git tree of gsv/src).
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys

from .machine import RESULTS, ROOT, write_result

FUZZ = ROOT / "codec" / "native" / "fuzz"
TARGETS = ("demux", "group", "units")
SECONDS_OF_INPUT, MEGABYTES = 10, 512  # of one input; more is a finding


def fuzz(target: str, seconds: int) -> int:
    """Runs one target; returns the number of executions."""
    corpus = FUZZ / "corpus" / target
    corpus.mkdir(parents=True, exist_ok=True)
    limits = [f"-max_total_time={seconds}", f"-timeout={SECONDS_OF_INPUT}", f"-rss_limit_mb={MEGABYTES}"]
    command = ["cargo", "+nightly", "fuzz", "run", "-s", "none", target, corpus, "--", *limits, "-max_len=8192"]
    done = subprocess.run(command, cwd=FUZZ, stderr=subprocess.PIPE, text=True)
    found = re.search(r"Done (\d+) runs", done.stderr)
    if done.returncode or not found:
        sys.exit(f"error: target {target} found something or did not run:\n{done.stderr[-3000:]}")
    return int(found[1])


def main() -> None:
    """Runs all targets and adds their executions to the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=int, default=180, help="of each target")
    seconds = parser.parse_args().seconds
    path = RESULTS / "fuzz.json"
    tree = ["git", "rev-parse", "HEAD:codec/native/gsv/src"]
    source = subprocess.run(tree, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    runs = json.loads(path.read_text())["runs"] if path.exists() else {}
    own = runs.setdefault(source, dict.fromkeys(TARGETS, 0))
    for target in TARGETS:
        own[target] += fuzz(target, seconds)
    write_result(path, {"executions": sum(sum(r.values()) for r in runs.values()), "findings": 0, "runs": runs})
    print(path.read_text())


if __name__ == "__main__":
    main()
