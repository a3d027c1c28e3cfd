"""Description of a splat input for `gscodec info`: its format in words, frames, Gaussians, harmonics and bytes."""

from __future__ import annotations

from pathlib import Path

from ..ply_table import read_header
from .archive import unpacked
from .files import splat_size
from .sequence import is_scene, open_sequence, splat_paths
from .splatv import splatv_header
from .spz import spz_header
from .videogs import find_checkpoints

FORMATS = {
    ".sog": "SOG version 2 (PlayCanvas)",
    ".drc": "Draco point cloud",
    ".splat": ".splat (antimatter15)",
    ".splatv": ".splatv (Spacetime Gaussians, antimatter15)",
}
HARMONICS = {0: 0, 3: 1, 8: 2, 15: 3}


def describe_splats(path: Path) -> dict:
    """Keys: format, frames, fps, mode, gaussians (of the first frame), sh_degree, bytes.

    Raises:
        CaptureError: the input is not splats, or damaged.
    """
    inner = unpacked(path) if path.suffix.lower() == ".zip" else path
    name = format_of(inner) + (" in a zip" if inner != path else "")
    sequence = open_sequence(inner)
    if inner.suffix.lower() == ".splatv":
        gaussians, degree = splatv_header(inner).count, 0
    elif is_scene(inner):
        first = sequence.frame(0)
        gaussians, degree = len(first), first.sh_degree
    else:
        gaussians, k = splat_size(splat_paths(inner)[0])
        degree = HARMONICS.get(k, 0)
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return {
        "format": name,
        "frames": sequence.frame_count,
        "fps": sequence.fps,
        "mode": sequence.mode,
        "gaussians": gaussians,
        "sh_degree": degree,
        "bytes": sum(p.stat().st_size for p in files),
    }


def format_of(path: Path) -> str:
    """The format of a file, or of the frames of a folder, in words."""
    ending = path.suffix.lower()
    if ending == ".splatv":
        return FORMATS[ending]
    if path.is_dir() and find_checkpoints(path):
        return "VideoGS checkpoints, 3DGS .ply"
    if is_scene(path):
        return "VideoGS packed maps"
    first = splat_paths(path)[0]
    ending = first.suffix.lower()
    if ending == ".ply":
        _, elements, _ = read_header(first)
        return "SuperSplat compressed .ply" if "chunk" in elements else "3DGS .ply"
    if ending == ".spz":
        return f".spz version {spz_header(first).version} (Niantic)"
    return FORMATS.get(ending, FORMATS[".sog"])
