"""A splat file of any known format <-> Gaussians. The ending of the name tells the format, for .ply also the header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import CaptureError, UsageError
from ..model.gaussians import Gaussians
from ..ply_table import read_header, read_table
from .compressed_ply import gaussians_of_compressed, is_compressed, write_compressed_ply
from .drc import read_drc, write_drc
from .glb import write_glb
from .ply import FIELDS, gaussians_of, sh_count, stack, write_ply
from .sog import SH_BANDS, read_sog, read_sog_meta, write_sog
from .splat import read_splat_rows, splat_count
from .spz import SH_DEGREES, read_spz, spz_header, write_spz

READ = (".ply", ".sog", ".drc", ".spz", ".splat")
ENDINGS = (".ply", ".compressed.ply", ".sog", ".spz", ".glb", ".drc")
EXPECTED = (
    ".ply (3DGS or SuperSplat compressed), .spz, .splat, .sog or an unpacked SOG folder (meta.json), .drc (points only)"
)


def is_splat(path: Path) -> bool:
    """Whether `path` looks like one frame: a known ending or an unpacked SOG folder."""
    return path.suffix.lower() in READ or (path / "meta.json").is_file() or path.name == "meta.json"


def read_splat(path: str | Path) -> Gaussians:
    """Reads one frame of any known format.

    Raises:
        CaptureError: the format is not known or the file is missing or damaged.
        UsageError: the format needs a library of the `encode` extra (.sog, .drc and .spz version 4 do).
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file, expected a splat: {EXPECTED}")
    if not is_splat(path):
        raise CaptureError(f"{path}: not a known splat format, expected {EXPECTED}")
    ending = path.suffix.lower()
    if ending == ".ply":
        table = read_table(path)
        return gaussians_of_compressed(table, path) if is_compressed(table) else gaussians_of(table, path)
    return {".drc": read_drc, ".spz": read_spz, ".splat": read_splat_rows}.get(ending, read_sog)(path)


def read_means(path: Path) -> np.ndarray:
    """[N, 3] f32, the positions of one frame; of a valid 3DGS .ply only these are converted.

    Raises:
        CaptureError, UsageError: see `read_splat`.
    """
    rows = read_table(path).get("vertex") if path.suffix.lower() == ".ply" else None
    if rows is not None and {"x", "y", "z"} <= set(rows.dtype.names or ()):
        means = stack(rows, FIELDS["means"])
        if np.isfinite(means).all():
            return means
    return read_splat(path).means


def splat_size(path: Path) -> tuple[int, int]:
    """(N, K) of a splat file, the number of Gaussians and of SH coefficients a channel, from the header alone.

    Raises:
        CaptureError: the file is missing or its header damaged.
    """
    if path.suffix.lower() == ".ply":
        _, elements, _ = read_header(path)
        count, dtype = elements.get("vertex", (0, None))
        names = elements["sh"][1].names if "sh" in elements else dtype.names if dtype else ()
        return count, sh_count(names or (), path)
    if path.suffix.lower() == ".drc":
        return len(read_drc(path)), 0  # its header does not have the count
    if path.suffix.lower() == ".splat":
        return splat_count(path), 0
    if path.suffix.lower() == ".spz":
        header = spz_header(path)
        return header.count, min(SH_DEGREES[header.degree], 15)
    meta, _ = read_sog_meta(path)
    return int(meta.get("count", 0)), SH_BANDS.get((meta.get("shN") or {}).get("bands", 0), 0)


def write_splat(path: str | Path, gaussians: Gaussians, up: str = "-y") -> None:
    """Writes one frame in the format of the name's ending, one of ENDINGS, or .../meta.json.

    Args:
        up: axis of the scene that points up, which a .glb needs.

    Raises:
        CaptureError: the format cannot hold these Gaussians.
        UsageError: the ending is unknown.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if path.name.lower().endswith(".compressed.ply"):
        write_compressed_ply(path, gaussians)
    elif ending == ".sog" or path.name == "meta.json":
        write_sog(path, gaussians)
    elif ending == ".glb":
        write_glb(path, gaussians, up)
    elif ending in (".ply", ".spz", ".drc"):
        {".ply": write_ply, ".spz": write_spz, ".drc": write_drc}[ending](path, gaussians)
    else:
        raise UsageError(f"{path}: cannot tell the format from the name, expected {', '.join(ENDINGS)} or meta.json")
