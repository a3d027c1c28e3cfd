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


def _transforms(path: Path) -> list[tuple[Path, str]]:
    if path.is_file():
        return [(path, "train")] if path.suffix == ".json" and path.name != TRAIN else []
    if (path / "transforms.json").is_file():
        return [(path / "transforms.json", "train")]
    train = path / "transforms_train.json"
    if not train.is_file():
        return []
    test = next((p for s in ("test", "val") if (p := path / f"transforms_{s}.json").is_file()), None)
    return [(train, "train"), *([(test, "test")] if test else [])]


def _qualisys(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name.endswith(".qca.txt") else None
    found = [f for pattern in ("calibration/*.qca.txt", "*.qca.txt") for f in sorted(path.glob(pattern))]
    return found[0] if found else None


def _open_qualisys(path: Path, calibration: Path) -> Capture:
    root = path if path.is_dir() else calibration.parent
    return open_qualisys(root.parent if root.name == "calibration" else root, calibration)


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
    "qualisys": ("calibration/*.qca.txt with videos/ (Qualisys)", _qualisys, _open_qualisys),
    "colmap": (
        "images/ with sparse/ (COLMAP), in the folder or in one for each frame",
        find_model,
        lambda path, _: open_colmap(path),
    ),
}
LOOKED_FOR = tuple(what for what, _, _ in LAYOUTS.values())


def find_capture(path: Path) -> str | None:
    """The layout of `path`, a key of `LAYOUTS`; None: not a capture."""
    return next((name for name, (_, find, _) in LAYOUTS.items() if find(Path(path))), None)


def open_capture(path: str | Path) -> Capture:
    """Opens a capture in any known layout.

    Args:
        path: its folder, or the calibration file itself (transforms.json, *.qca.txt).

    Raises:
        CaptureError: nothing is there, the layout is unknown or the calibration or the images are unusable.
        UsageError: a library of the `encode` extra is missing.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder, expected a capture")
    for _, find, read in LAYOUTS.values():
        if calibration := find(path):
            return read(path, calibration)
    empty = path.is_dir() and not any(path.iterdir())
    what = "the folder is empty" if empty else "not a capture"
    raise CaptureError(f"{path}: {what}; looked for {', for '.join(LOOKED_FOR)}")
