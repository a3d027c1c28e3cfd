"""Fuzzes the demuxer, the unit parser and the entropy decoders; bench/results/fuzz.json counts the executions.

usage: python -m bench.fuzz [--seconds 180] [--targets units,group,demux] [--dry]

Each target runs in libFuzzer for its share of the time: most of it goes to `units` and `group`, below the checksums. No
sanitizer is needed, since the code has no unsafe block; arithmetic is checked, and so are the time and memory of one
input. Any Rust toolchain and C++ compiler will do. A finding ends the run with the file that reproduces it. Counts add
up over runs, per state of the code (git tree of gsv/src).
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable

from .machine import RESULTS, ROOT, update_entries

FUZZ = ROOT / "codec" / "native" / "fuzz"
SHARES = {"units": 0.8, "group": 0.15, "demux": 0.05}  # of the time
LENGTHS = {"units": 1024, "group": 4096, "demux": 8192}  # bytes of an input
SECONDS_OF_INPUT, MEGABYTES = 120, 512  # of one input; more is a finding. Wall-clock seconds, of a busy machine
COVERAGE = ("level=4", "inline-8bit-counters", "pc-table")


@functools.cache
def host() -> str:
    """The machine that rustc compiles for."""
    told = subprocess.run(["rustc", "-vV"], capture_output=True, text=True, check=True).stdout
    return re.search(r"host: (\S+)", told)[1]


def build(target: str) -> None:
    """Builds a target with coverage counters and checked arithmetic."""
    compares = ("trace-compares",) if target != "units" else ()  # of no use for bytes of arithmetic code
    coverage = [f"-Cllvm-args=-sanitizer-coverage-{option}" for option in COVERAGE + compares]
    flags = ["--cfg", "fuzzing", "-Cpasses=sancov-module", *coverage, "-Ccodegen-units=1", "-Cdebug-assertions"]
    command = ["cargo", "build", "--release", "--quiet", "--locked", "--target", host(), "--bin", target]
    subprocess.run(command, cwd=FUZZ, env=os.environ | {"RUSTFLAGS": " ".join(flags)}, check=True)


def fuzz(target: str, seconds: int) -> int:
    """Runs one target; returns the number of executions. A finding ends the program."""
    corpus = FUZZ / "corpus" / target
    corpus.mkdir(parents=True, exist_ok=True)
    limits = [f"-max_total_time={seconds}", f"-timeout={SECONDS_OF_INPUT}", f"-rss_limit_mb={MEGABYTES}"]
    artifacts = FUZZ / "artifacts" / target
    artifacts.mkdir(parents=True, exist_ok=True)
    program = FUZZ / "target" / host() / "release" / target
    command = [program, corpus, *limits, f"-max_len={LENGTHS[target]}", f"-artifact_prefix={artifacts}/"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors="replace")
    found = re.search(r"Done (\d+) runs", done.stderr)
    if done.returncode or not found:
        sys.exit(f"error: target {target} found something or did not run:\n{done.stderr[-3000:]}")
    return int(found[1])


def tree() -> str:
    """Hash of the git tree of gsv/src."""
    command = ["git", "rev-parse", "HEAD:codec/native/gsv/src"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    """Runs the targets and adds their executions to the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=int, default=180, help="of all targets together")
    parser.add_argument("--targets", default=",".join(SHARES), help="some of " + ",".join(SHARES))
    parser.add_argument("--dry", action="store_true", help="leave the results file as it is")
    options = parser.parse_args()
    targets = options.targets.split(",")
    if unknown := set(targets) - set(SHARES):
        parser.error(f"--targets {','.join(sorted(unknown))}: expected some of {','.join(SHARES)}")
    for target in targets:
        build(target)
    source, whole = tree(), sum(SHARES[t] for t in targets)
    path = RESULTS / "fuzz.json"
    old = {(e["tree"], e["target"]): e for e in json.loads(path.read_text())["entries"]} if path.exists() else {}

    def run(target: str) -> dict:
        seconds = max(1, round(options.seconds * SHARES[target] / whole))
        executions = fuzz(target, seconds)
        before = {} if options.dry else old.get((source, target), {})
        totals = {"executions": executions, "seconds": seconds}
        totals = {k: v + before.get(k, 0) for k, v in totals.items()}
        return {"tree": source, "target": target, **totals, "findings": 0}

    entries: Iterable[dict] = map(run, targets)
    if not options.dry:
        entries = update_entries(path, entries, lambda e: (e["tree"], e["target"]))
    for entry in entries:
        print(f"{entry['target']}: {entry['executions']:,} executions in {entry['seconds']} s, no finding", flush=True)


if __name__ == "__main__":
    main()
