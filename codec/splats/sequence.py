"""A folder, a file or a zip of splats -> GaussianSequence with lazy frames; sequence_writer.py is its mirror.

A folder with sequence.json contains its groups, lifetimes and nodes. VideoGS and .splatv have their own groups, in
which index i is one Gaussian. Other inputs: either index i is verified to be the same Gaussian from frame to frame
(tracked), or the Gaussians are matched, or each frame is a group of its own. Frames are read on demand; a few stay in
memory.
"""

from __future__ import annotations

import hashlib
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..capture.detect import LOOKED_FOR, find_capture
from ..capture.images import SUFFIXES as PICTURES
from ..capture.rig import VIDEOS
from ..errors import CaptureError, UsageError
from ..model.camera import LOW_PASS, NEAR, Camera
from ..model.gaussian_sequence import DenseGroup, GaussianSequence
from ..model.gaussians import GOP
from ..model.parametric_group import ParametricGroup
from . import parametric_file
from .archive import unpacked
from .files import EXPECTED, is_splat, read_means, splat_size
from .lazy_frames import Frames
from .spacetime import spacetime_groups
from .splatv import read_splatv, splatv_header
from .tracking import relate
from .videogs import find_checkpoints, find_packed, open_packed

FPS = 30.0  # frames per second of folders without sequence.json
SCENES = "a .splatv, VideoGS's checkpoint, feature_image or feature_video, or a zip of any of these"


@dataclass(frozen=True)
class SplatSequence(GaussianSequence):
    """A sequence read from files.

    Attributes:
        mode: "stored" (groups of sequence.json), "scene" (groups of a .splatv or of VideoGS), "tracked" (index i is
            verified to be the same Gaussian), "matched" (Gaussians of some frames were reordered) or "independent"
            (groups of one frame).
        names: file name of each frame.
        training: facts that `gscodec train` wrote (`SequenceWriter`); None: another tool made the splats.
    """

    mode: str = "stored"
    names: Sequence[str] = ()
    training: dict | None = None


def splat_paths(path: Path) -> list[Path]:
    """The frames of a folder in natural order (2 before 10), or the one frame that `path` itself is."""
    if not path.is_dir() or (path / "meta.json").is_file():
        return [path] if is_splat(path) else []
    if found := find_checkpoints(path):
        return found
    found = [p for p in path.iterdir() if is_splat(p) and not p.name.startswith(".")]  # macOS adds ._NAME
    return sorted(found, key=lambda p: [int(w) if w.isdigit() else w for w in re.split(r"(\d+)", p.name)])


def is_scene(path: Path) -> bool:
    """Whether `path` is a moving scene by itself: a .splatv, or a folder of VideoGS's packed maps."""
    return path.suffix.lower() == ".splatv" or (path.is_dir() and find_packed(path) is not None)


def detect_input(path: str | Path) -> str:
    """The kind of input at `path`.

    Returns:
        "capture" or "splats".

    Raises:
        CaptureError: neither; lists the known formats.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder, expected a capture or a folder of splats")
    inner = unpacked(path) if path.suffix.lower() == ".zip" else path
    if find_capture(inner):
        if inner != path:
            raise CaptureError(f"{path}: a zip of a capture, expected its folder; unpack the zip first")
        return "capture"
    if is_scene(inner) or splat_paths(inner):
        return "splats"
    looked = "; ".join([*LOOKED_FOR, f"splats, one per frame: {EXPECTED}", SCENES])
    raise CaptureError(f"{path}: {_instead(inner)}neither a capture nor splats; looked for {looked}")


def _instead(path: Path) -> str:
    """The start of an error message: the kind of file or folder at `path`; empty: unknown."""
    if path.is_file():
        return "a stream already, " if path.suffix.lower() == ".gsv" else ""
    suffixes = [p.suffix.lower() for p in path.iterdir()]
    if not suffixes:
        return "the folder is empty, "
    pictures, videos = (sum(s in known for s in suffixes) for known in (PICTURES, VIDEOS))
    if pictures or videos:
        found = f"{pictures} images" if pictures else f"{videos} videos"
        return f"{found}, but no calibration (COLMAP, say, makes one), "
    return ""


def open_sequence(
    path: str | Path,
    *,
    gop: int = GOP,
    fps: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SplatSequence:
    """Opens a folder of splats (or a single one, a moving scene or a zip) as a sequence.

    Args:
        gop: largest number of frames in a group, if there is no sequence.json.
        fps: frames per second; None: that of sequence.json, or 30.
        progress: called with (pairs of frames checked, pairs) while tracking is verified.

    Raises:
        CaptureError: there are no splats, or sequence.json does not fit them.
        UsageError: `gop` or `fps` is not positive.
    """
    path = named = Path(path)
    if gop < 1 or (fps is not None and not fps > 0):
        raise UsageError(f"gop {gop} and fps {fps} must be positive")
    if path.suffix.lower() == ".zip" and path.is_file():
        path = unpacked(path)
    paths = splat_paths(path) if path.exists() else []
    if not paths and path.exists() and is_scene(path):
        groups, names, rate = _scene(path, gop)
        return SplatSequence(fps or rate, groups, mode="scene", names=names)
    if not paths:
        raise CaptureError(f"{named}: no splats, expected one file per frame: {EXPECTED}; or {SCENES}")
    if path.is_dir() and (path / "sequence.json").is_file():
        return _stored(path, paths, fps)
    sizes = [splat_size(p) for p in paths]
    orders, cuts, mode = _tracks(paths, sizes, progress)
    frames = Frames(paths, orders)
    groups = []
    for start, stop in pairwise([*cuts, len(paths)]):
        same = np.arange(sizes[start][0], dtype=np.int32) if stop - start > gop else None
        spans = [frames[a : min(a + gop, stop)] for a in range(start, stop, gop)]
        groups += [DenseGroup(f, parents=same if k else None) for k, f in enumerate(spans)]
    return SplatSequence(fps or FPS, groups, mode=mode, names=[p.name for p in paths])


def _scene(path: Path, gop: int) -> tuple[list[DenseGroup], list[str], float]:
    """Groups of a file or a folder for which `is_scene` holds, the names of their frames, and frames per second."""
    if path.suffix.lower() != ".splatv":
        return *open_packed(find_packed(path), gop), FPS
    head = splatv_header(path)
    groups = spacetime_groups(read_splatv(path), np.arange(head.frames) / head.frames, gop)
    return groups, [f"{path.name}:{t}" for t in range(head.frames)], head.fps


def _tracks(
    paths: list[Path], sizes: list[tuple], progress: Callable | None
) -> tuple[dict[int, np.ndarray], list[int], str]:
    """Order of each frame that needs one, the frames at which tracks begin, and the mode."""
    orders: dict[int, np.ndarray] = {}
    cuts, before = [0], None
    for t in range(1, len(paths)):
        related: np.ndarray | bool = False
        if sizes[t] == sizes[t - 1]:
            before = read_means(paths[t - 1]) if before is None else before
            after = read_means(paths[t])
            related = relate(before, after)
            if related is not False and (t - 1 in orders or related is not True):
                # `after` is in file order: bring it into the order of the track
                last = orders.get(t - 1, np.arange(len(after)))
                orders[t] = last if related is True else related[last]
            before = after
        else:
            before = None
        if related is False:
            cuts.append(t)
        if progress:
            progress(t, len(paths) - 1)
    independent = len(paths) > 1 and len(cuts) == len(paths)
    return orders, cuts, "independent" if independent else "matched" if orders else "tracked"


def _stored(path: Path, paths: list[Path], fps: float | None) -> SplatSequence:
    """The sequence that sequence.json describes: of the .ply files, if there are any."""
    where = path / "sequence.json"
    paths = [p for p in paths if p.suffix.lower() == ".ply"] or paths
    try:
        data = json.loads(where.read_text())
        rate = float(fps or data["fps"])
        spans = [(int(g["start"]), int(g["frames"]), g.get("extra"), g.get("sha256")) for g in data["groups"]]
        cameras = [_camera(c) for c in data.get("cameras", [])]
    except (ValueError, KeyError, TypeError) as e:
        raise CaptureError(f"{where}: not valid ({type(e).__name__}: {e}), expected fps and groups") from e
    end = 0
    for i, (start, count, *_) in enumerate(spans):
        if start != end or count < 1 or start + count > len(paths):
            raise CaptureError(
                f"{where}: group {i} is {count} frames from {start}, expected to start at {end} "
                f"and to end within the {len(paths)} splats of the folder"
            )
        end = start + count
    if not spans or rate <= 0:
        raise CaptureError(f"{where}: {len(spans)} groups at {rate} frames a second, expected at least one group")
    groups = [_stored_group(path, paths, *span) for span in spans]
    names = [p.name for p in paths[:end]]
    return SplatSequence(rate, groups, cameras, names=names, training=data.get("training"))


def _stored_group(
    path: Path, paths: list[Path], start: int, count: int, extra: str | None, sha256: str | None
) -> DenseGroup | ParametricGroup:
    """A group as it was written; a group whose frames were edited since is dense."""
    own = paths[start : start + count]
    if not extra:
        return DenseGroup(Frames(own, {})[:])
    try:
        with np.load(path / Path(extra).name) as stored:
            arrays = {k: stored[k] for k in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError) as e:
        raise CaptureError(f"{path / extra}: missing or damaged ({e}), sequence.json refers to it") from e
    if sha256 is not None:
        if _digest(own) == sha256:
            return parametric_file.from_arrays(arrays)
        warnings.warn(
            f"{path}: frames {start} to {start + count - 1} were changed since they were written; they are coded as "
            f"they are, without the motion that training found",
            stacklevel=2,
        )
    lifetimes, hidden = arrays.get("lifetimes"), {}
    if lifetimes is not None:
        for t in range(count):
            away = (lifetimes[:, 0] > t) | (t >= lifetimes[:, 1])
            if away.any():
                hidden[t] = away, arrays[f"hidden_{t}"]
    return DenseGroup(Frames(own, {}, hidden)[:], lifetimes, arrays.get("parents"))


def _digest(paths: list[Path]) -> str:
    """SHA-256 of the bytes of all files, in hexadecimal."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _camera(c: dict) -> Camera:
    K, viewmat = (np.array(c[k], np.float64) for k in ("K", "viewmat"))
    return Camera(
        str(c["name"]),
        K,
        viewmat,
        int(c["width"]),
        int(c["height"]),
        split=str(c.get("split", "train")),
        near=float(c.get("near", NEAR)),
        low_pass=float(c.get("low_pass", LOW_PASS)),
    )
