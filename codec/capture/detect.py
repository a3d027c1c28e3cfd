"""What layout a folder has: the files that give each away, and the one list of what was looked for."""

from __future__ import annotations

from pathlib import Path

from gscodec.capture.capture import Capture
from gscodec.capture.qualisys import open_qualisys
from gscodec.capture.transforms import open_transforms
from gscodec.errors import CaptureError

LOOKED_FOR = (
    "transforms.json or transforms_train.json (nerfstudio, instant-ngp)",
    "calibration/*.qca.txt with videos/ (Qualisys)",
)


def _transforms(path: Path) -> list[tuple[Path, str]]:
    if path.is_file():
        return [(path, "train")] if path.suffix == ".json" else []
    if (path / "transforms.json").is_file():
        return [(path / "transforms.json", "train")]
    train, test = path / "transforms_train.json", path / "transforms_test.json"
    return [(p, s) for p, s in ((train, "train"), (test, "test")) if p.is_file()] if train.is_file() else []


def _qualisys(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name.endswith(".qca.txt") else None
    found = [f for pattern in ("calibration/*.qca.txt", "*.qca.txt") for f in sorted(path.glob(pattern))]
    return found[0] if found else None


def find_capture(path: Path) -> str | None:
    """The layout of `path`, "transforms" or "qualisys"; None if it is not a capture."""
    path = Path(path)
    return "transforms" if _transforms(path) else "qualisys" if _qualisys(path) else None


def open_capture(path: str | Path) -> Capture:
    """Opens a capture in any layout that is known.

    Args:
        path: its folder, or the calibration file itself.

    Raises:
        CaptureError: nothing is there, the layout is unknown or the calibration or the images are unusable.
        UsageError: a library of the `encode` extra is missing.
    """
    path = Path(path)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder, expected a capture")
    if files := _transforms(path):
        return open_transforms(files)
    if calibration := _qualisys(path):
        root = path if path.is_dir() else calibration.parent
        return open_qualisys(root.parent if root.name == "calibration" else root, calibration)
    empty = path.is_dir() and not any(path.iterdir())
    what = "the folder is empty" if empty else "not a capture"
    raise CaptureError(f"{path}: {what}; looked for {' and for '.join(LOOKED_FOR)}")
