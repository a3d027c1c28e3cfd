"""Result files: results with their machine, commit and the load by other processes."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from gscodec.atomic_write import part_file

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results"


def machine() -> dict:
    """Processor, cores, system and Python."""
    model = platform.processor()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), model)
    return {"cpu": model, "cores": os.cpu_count(), "system": platform.system(), "python": platform.python_version()}


def peak_gib() -> float | None:
    """Peak memory of this process, GiB; None: the system does not report it."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    kib = [int(line.split()[1]) for line in lines if line.startswith("VmHWM")]
    return round(kib[0] / 2**20, 2) if kib else None


def commit() -> str:
    """Short hash of the checkout, with "+" if it has changes besides results and charts; empty outside a checkout."""
    git = lambda *a: subprocess.run(["git", *a], cwd=ROOT, capture_output=True, text=True).stdout.strip()  # noqa: E731
    return git("rev-parse", "--short", "HEAD") + (
        "+" if git("status", "--porcelain", "-uno", "--", ".", ":!bench/results", ":!bench/charts") else ""
    )


def write_result(path: Path, result: dict) -> None:
    """Writes `result` to `path`, complete or not at all, with machine, commit, seconds since the last result of this
    process, and the number of cores that other processes kept busy meanwhile."""
    _write(path, {"machine": machine(), "commit": commit(), **_SINCE_THE_LAST_RESULT.lap(), **result})


def update_entries(
    path: Path,
    entries: Iterable[dict],
    key: Callable[[dict], object],
    whole: Callable[[list[dict]], dict] = lambda entries: {"entries": entries},
) -> Iterator[dict]:
    """Yields `entries` and puts each into the list "entries" of the JSON `path` as it comes, with machine, commit,
    seconds, and the number of cores that other processes kept busy meanwhile. Other entries stay as they are.

    Args:
        key: entry -> its key; an older entry with the same key is replaced.
        whole: list of entries -> content of the file.
    """
    clock, entries = _Clock(), iter(entries)
    for entry in entries:
        measured = {**machine(), "commit": commit(), **clock.lap()}
        old = json.loads(path.read_text())["entries"] if path.exists() else []
        _write(path, whole([*(e for e in old if key(e) != key(entry)), {**entry, "measured": measured}]))
        yield entry


class _Clock:
    """Time of this process and of all other processes since the last lap."""

    def __init__(self):
        self._last = self._now()

    @staticmethod
    def _now() -> tuple[float, float, float]:
        """Wall-clock seconds, busy seconds of all cores (0: the system reports none), CPU seconds of this process."""
        stat, busy = Path("/proc/stat"), 0.0
        if stat.exists():
            user, nice, system, *_ = (int(x) for x in stat.read_text().split()[1:9])
            busy = (user + nice + system) / os.sysconf("SC_CLK_TCK")
        return time.perf_counter(), busy, sum(os.times()[:4])

    def lap(self) -> dict:
        """Seconds, and cores that other processes kept busy."""
        before, self._last = self._last, self._now()
        wall, busy, own = (b - a for a, b in zip(before, self._last, strict=True))
        return {"seconds": round(wall, 1), "busy_beside": round(max(0.0, busy - own) / max(wall, 1e-9), 2)}


_SINCE_THE_LAST_RESULT = _Clock()


def stamp(entries: Iterable[dict]) -> str:
    """One line for a chart: the machines and the commits of its entries."""
    measured = [e["measured"] for e in entries if "measured" in e]
    machines = sorted({f"{m['cpu']}, {m['cores']} cores" for m in measured})
    return "; ".join([*machines, "commit " + ", ".join(sorted({m["commit"] for m in measured}))])


def _write(path: Path, result: dict) -> None:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with part_file(path) as part:
        part.write_text(json.dumps(result, indent=1) + "\n")
