"""Fingerprint of a result: program, inputs and settings. A second run continues the work of a first run only if all are
equal; otherwise it names the differences."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from . import __version__


@cache
def program() -> dict:
    """Version of the package, and a digest of its code, the native module included."""
    digest, root = hashlib.sha256(), Path(__file__).parent
    for path in sorted([*root.rglob("*.py"), *root.glob("_native*")]):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return {"version": __version__, "code": digest.hexdigest()[:16]}


def inputs(source: Path, output: Path | None = None) -> dict:
    """Path of the input; size and modification time of each of its files, without those of `output` and NAME.part."""
    source = Path(source).resolve()
    files = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]
    if output is not None:
        files = [p for p in files if not str(p).startswith(str(Path(output).resolve()))]
    root = source if source.is_dir() else source.parent
    stats = {str(p.relative_to(root)): p.stat() for p in files}
    return {"path": str(source), "files": {n: [s.st_size, s.st_mtime_ns] for n, s in stats.items()}}


def differences(before: dict, now: dict, where: str = "") -> list[str]:
    """Differences between two fingerprints, one phrase each, e.g. "settings.quality was 50, is 80"."""
    found = []
    for key in sorted({*before, *now}):
        name = f"{where}{key}"
        a, b = before.get(key), now.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found += differences(a, b, "" if key == "files" else f"{name}.")
        elif a != b:
            plain = not isinstance(a, list) and not isinstance(b, list)
            found.append(f"{name} was {a}, is {b}" if plain else f"{name} has changed")
    return found


def sentence(before: dict, now: dict, most: int = 3) -> str:
    """The first `most` differences in words."""
    found = differences(before, now)
    more = f" and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + more
