"""The data flow has one direction: which package may import which (DESIGN: the listing is the diagram)."""

import ast
from pathlib import Path

import pytest

import bench
import gscodec
import gscodec.player

ROOT = Path(gscodec.__file__).parent
FOLDERS = {"bench": Path(bench.__file__).parent, "player": Path(gscodec.player.__file__).parent}
BASE = {"errors", "gaussians", "camera", "frames", "sampling", "part_file", "_native"}
ALLOWED = {
    "bench": BASE | {"bitstream", "capture", "decode", "encode", "metrics", "player", "render", "splats", "train"},
    "bitstream": BASE,
    "capture": BASE,
    "splats": BASE | {"capture"},
    "render": BASE | {"bitstream", "decode", "progress"},
    "metrics": BASE | {"render", "capture", "splats"},
    "decode": BASE | {"bitstream", "render"},
    "encode": BASE | {"bitstream", "capture", "decode", "render"},
    "player": BASE | {"decode"},
    "train": BASE | {"bitstream", "render", "capture"},
}
STUDIO = {"torch", "cv2", "OpenImageIO", "skimage", "DracoPy", "imageio_ffmpeg", "scipy", "ray"}


def imports(path: Path, *, top_level: bool = False) -> set[str]:
    """Modules that a file imports, dotted; only those of the module's own level if `top_level`."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level else ast.walk(tree)
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return found


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_packages_import_one_way(package):
    files = list(FOLDERS.get(package, ROOT / package).rglob("*.py"))
    assert files, f"{package} has no modules"
    for path in files:
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "gscodec" and len(parts) > 1:
                target = parts[1]
                assert target == package or target in ALLOWED[package] | {"__version__"}, f"{path} imports {name}"


def test_training_takes_only_facts_from_the_bitstream():
    for path in (ROOT / "train").glob("*.py"):
        taken = {n.split(".")[2] for n in imports(path) if n.startswith("gscodec.bitstream.")}
        assert taken <= {"color", "quantization", "transform"}, f"{path} imports {taken}"


def test_the_players_side_needs_no_extra_to_import():
    files = [ROOT / n for n in ("cli.py", "frames.py", "gaussians.py", "camera.py", "errors.py", "progress.py")]
    files += [*(ROOT / "decode").glob("*.py"), *(ROOT / "bitstream").glob("*.py"), ROOT / "splats" / "ply.py"]
    files += FOLDERS["player"].glob("*.py")
    files += [ROOT / "render" / n for n in ("__init__.py", "image.py", "movie.py", "png.py")]
    for path in files:
        heavy = {n.split(".")[0] for n in imports(path, top_level=True)} & STUDIO
        assert not heavy, f"{path} imports {heavy} at the top"
