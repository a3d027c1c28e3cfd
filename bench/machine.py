"""Result files: each opens with the machine and the commit of the measurement."""

from __future__ import annotations

import json
import os
import platform
import subprocess
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


def commit() -> str:
    """Short hash of the checkout, "+" if it has changes; empty outside of one."""
    git = lambda *a: subprocess.run(["git", *a], cwd=ROOT, capture_output=True, text=True).stdout.strip()  # noqa: E731
    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", "-uno") else "")


def write_result(path: Path, result: dict) -> None:
    """Writes machine, commit and `result` to `path`, complete or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with part_file(path) as part:
        part.write_text(json.dumps({"machine": machine(), "commit": commit(), **result}, indent=1) + "\n")


def update_entries(
    path: Path,
    entries: Iterable[dict],
    key: Callable[[dict], object],
    whole: Callable[[list[dict]], dict] = lambda entries: {"entries": entries},
) -> Iterator[dict]:
    """Yields `entries` and puts each into the list "entries" of the JSON `path` as it comes.

    Args:
        key: of an entry; an older entry with the same key is replaced.
        whole: list of entries -> content of the file.
    """
    for entry in entries:
        old = json.loads(path.read_text())["entries"] if path.exists() else []
        write_result(path, whole([*(e for e in old if key(e) != key(entry)), entry]))
        yield entry
