"""Path -> Capture: a layout is recognised by files that only this layout has."""

from __future__ import annotations

from pathlib import Path

from ..errors import CaptureError
from .actorshq import open_actorshq
from .capture import Capture
from .colmap import find_model, open_colmap
from .dynamic3dgs import TRAIN, open_dynamic3dgs
from .easyvolcap import find_calibration, open_easyvolcap
from .n3dv import open_n3dv
from .qualisys import open_qualisys
from .transforms import open_transforms
from .zju_mocap import FILE, open_zju_mocap

OTHERS = (TRAIN, "meta.json")  # JSON files of another layout, and of SOG
PARTS = ("intri.yml", "extri.yml", "cameras.bin", "cameras.txt", "images.bin", "images.txt")  # one file of several


def _transforms(path: Path) -> list[tuple[Path, str]]:
    if path.is_file() and path.name != "transforms_train.json":
        return [(path, "train")] if path.suffix == ".json" and path.name not in OTHERS else []
    folder = path.parent if path.is_file() else path
    if (path / "transforms.json").is_file():
        return [(path / "transforms.json", "train")]
    train = folder / "transforms_train.json"
    if not train.is_file():
        return []
    test = next((p for s in ("test", "val") if (p := folder / f"transforms_{s}.json").is_file()), None)
    return [(train, "train"), *([(test, "test")] if test else [])]


def capture_folder(path: Path) -> Path:
    """The folder of the capture at `path`, which is this folder or a calibration file in it."""
    if not path.is_file():
        return path
    if path.name in PARTS:  # up to four folders down: cameras/CAMERA/, colmap/sparse/0/
        places = path.absolute().parents[:4]
        return next((p for p in places if (p / "images").is_dir() or (p / "videos").is_dir()), path.parent)
    return path.parent.parent if path.match("calibration/*.qca.txt") else path.parent


def _qualisys(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name.endswith(".qca.txt") else None
    found = [f for pattern in ("calibration/*.qca.txt", "*.qca.txt") for f in sorted(path.glob(pattern))]
    return found[0] if found else None


def _file(path: Path, name: str) -> Path | None:
    """`path`, if it is a file `name`, or the one in the folder `path`."""
    if path.is_file():
        return path if path.name == name else None
    return path / name if (path / name).is_file() else None


# layout -> its files in words, path -> calibration or None, (path, calibration) -> Capture
LAYOUTS = {
    "transforms": (
        "transforms.json or transforms_train.json (nerfstudio, instant-ngp, D-NeRF)",
        _transforms,
        lambda _, files: open_transforms(files),
    ),
    "dynamic3dgs": (
        "train_meta.json with ims/ (Dynamic 3D Gaussians)",
        lambda path: _file(path, TRAIN),
        lambda _, calibration: open_dynamic3dgs(calibration),
    ),
    "zju_mocap": (
        "annots.npy (ZJU-MoCap)",
        lambda path: _file(path, FILE),
        lambda _, calibration: open_zju_mocap(calibration),
    ),
    "n3dv": (
        "poses_bounds.npy with a video for each camera (Neural 3D Video)",
        lambda path: _file(path, "poses_bounds.npy"),
        lambda _, poses: open_n3dv(poses),
    ),
    "easyvolcap": (
        "intri.yml and extri.yml, here or in cameras/CAMERA/, with images/ or videos/ (EasyVolcap, EasyMocap)",
        find_calibration,
        open_easyvolcap,
    ),
    "actorshq": (
        "calibration.csv with rgbs/ (ActorsHQ)",
        lambda path: _file(path, "calibration.csv"),
        lambda _, calibration: open_actorshq(calibration),
    ),
    "qualisys": (
        "calibration/*.qca.txt with videos/ (Qualisys)",
        _qualisys,
        lambda _, calibration: open_qualisys(capture_folder(calibration), calibration),
    ),
    "colmap": (
        "images/ with sparse/ (COLMAP), in the folder or in one for each frame",
        find_model,
        lambda path, _: open_colmap(path),
    ),
}
LOOKED_FOR = tuple(what for what, _, _ in LAYOUTS.values())


def find_capture(path: Path) -> str | None:
    """The layout of `path`, a key of `LAYOUTS`; None: not a capture."""
    path = _start(Path(path))
    return next((name for name, (_, find, _) in LAYOUTS.items() if find(path)), None)


def _start(path: Path) -> Path:
    """Where to look for a calibration: in the folder, if `path` is one of several files of it."""
    return capture_folder(path) if path.name in PARTS else path


def open_capture(path: str | Path) -> Capture:
    """Opens a capture in any known layout.

    Args:
        path: its folder, or the calibration file itself (transforms.json, intri.yml, *.qca.txt, cameras.bin).

    Raises:
        CaptureError: nothing is there, the layout is unknown or the calibration or the images are unusable.
        UsageError: a library of the `encode` extra is missing.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder, expected a capture")
    start = _start(path)
    for _, find, read in LAYOUTS.values():
        if calibration := find(start):
            return read(start, calibration)
    empty = path.is_dir() and not any(path.iterdir())
    what = "the folder is empty" if empty else "not a capture"
    raise CaptureError(f"{path}: {what}; looked for {', for '.join(LOOKED_FOR)}")
