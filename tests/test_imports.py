"""Imports follow the data flow: the allowed imports between parts of codec/, resolved by path, without cycles.

A part is a folder of codec/ or a single module in it; a module is named by its path, e.g. "encode.coder". Imports in
codec/ are relative. bench/ and tests/ may import everything; only two commands may import bench.
"""

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CODEC = ROOT / "codec"
BASE = {"errors", "_native"}
ALLOWED = {  # part -> parts that it may import, besides itself
    "errors": set(),
    "progress": set(),
    "frame_range": {"errors"},
    "farthest_point_sampling": set(),
    "atomic_write": set(),
    "ply_table": {"errors", "atomic_write"},
    "threads": set(),
    "fingerprint": set(),
    "model": BASE | {"threads"},
    "bitstream": BASE | {"model"},
    "render": BASE | {"model", "bitstream"},
    "decode": BASE | {"model", "bitstream", "render"},
    "capture": BASE | {"model", "ply_table"},
    "splats": BASE | {"model", "capture", "atomic_write", "ply_table"},
    "metrics": BASE | {"model", "render", "capture", "splats"},
    "fit": BASE | {"model", "bitstream", "farthest_point_sampling", "threads"},
    "train": BASE | {"model", "bitstream", "render", "capture", "farthest_point_sampling", "atomic_write"},
    "encode": BASE | {"model", "bitstream", "render", "decode", "threads", "fingerprint", "atomic_write"},
}
ANYTHING = {"cli", "commands"}
MAY_IMPORT_BENCH = {"commands.bench", "commands.chart"}
PLAYER_ENTRIES = ("cli", "decode", "decode.report", "render.movie", "splats")
STUDIO = {
    "torch",
    "cv2",
    "OpenImageIO",
    "skimage",
    "DracoPy",
    "imageio_ffmpeg",
    "scipy",
    "ray",
    "matplotlib",
    "zstandard",
}


@cache
def modules() -> dict[str, Path]:
    """Module of codec/ -> its file; a package has the name of its folder, codec/__init__.py the name ""."""
    found = {}
    for path in CODEC.rglob("*.py"):
        parts = path.relative_to(CODEC).with_suffix("").parts
        if parts[0] not in ("native", "player"):
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def nodes_of(path: Path, top_level: bool) -> list[ast.AST]:
    tree = ast.parse(path.read_text())
    return tree.body if top_level else list(ast.walk(tree))


def inside(module: str, top_level: bool = False) -> set[str]:
    """Modules of codec/ that a module imports relatively; only outside of functions and conditions if `top_level`."""
    path = modules()[module]
    folder = path.relative_to(CODEC).parent.parts
    found = set()
    for node in nodes_of(path, top_level):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        above = folder[: len(folder) - (node.level - 1)]
        base = ".".join([*above, *(node.module.split(".") if node.module else [])])
        for alias in node.names:
            name = f"{base}.{alias.name}".lstrip(".")
            found.add(name if name in modules() or name == "_native" else base)
    return found - {module}


def outside(path: Path, top_level: bool = False) -> set[str]:
    """Absolute imports of a file, dotted."""
    found = set()
    for node in nodes_of(path, top_level):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return found


def part_of(module: str) -> str:
    return module.split(".")[0]


@pytest.mark.parametrize("part", ALLOWED)
def test_parts_import_one_way(part):
    own = [m for m in modules() if part_of(m) == part]
    assert own, f"codec/{part} does not exist"
    for module in own:
        for name in inside(module) - {""}:
            assert part_of(name) in ALLOWED[part] | {part}, f"{module} imports {name}"


def test_every_part_has_a_rule():
    assert {part_of(m) for m in modules()} - {""} <= set(ALLOWED) | ANYTHING


def test_every_package_is_in_the_wheel():
    listed = (ROOT / "pyproject.toml").read_text()
    for module, path in modules().items():
        if module and path.name == "__init__.py":
            assert f'"gscodec.{module}"' in listed, f"pyproject.toml does not list gscodec.{module}"


def test_nothing_imports_the_command_line():
    for module in modules():
        if part_of(module) not in ANYTHING:
            assert not {part_of(n) for n in inside(module)} & ANYTHING, module
        elif part_of(module) == "commands":
            assert "cli" not in inside(module), module


def test_training_takes_only_facts_from_the_bitstream():
    allowed = {"bitstream.color", "bitstream.quantization"}
    for module in modules():
        if part_of(module) == "train":
            taken = {n for n in inside(module) if part_of(n) == "bitstream"}
            assert taken <= allowed, f"{module} imports {taken - allowed}"


def test_imports_have_no_circles():
    graph = {m: {n for n in inside(m, top_level=True) if n in modules()} for m in modules()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as e:
        pytest.fail("modules import each other in a circle: " + " <- ".join(e.args[1]))


def test_imports_inside_the_package_are_relative():
    for module, path in modules().items():
        for name in outside(path):
            if part_of(name) == "gscodec":
                assert module == "commands.play", f"{module} imports {name}"
                assert name.startswith("gscodec.player."), f"{module} imports {name}"
            if part_of(name) == "bench":
                assert module in MAY_IMPORT_BENCH, f"{module} imports {name}"


def test_the_player_imports_only_decoding_and_base_modules():
    for path in (ROOT / "player").glob("*.py"):
        for name in outside(path):
            if name.startswith("gscodec."):
                assert name.split(".")[1] in {"player", "errors", "atomic_write", "decode"}, f"{path} imports {name}"


def test_the_players_side_needs_no_extra_to_import():
    reached, todo = set(), list(PLAYER_ENTRIES)
    while todo:
        module = todo.pop()
        if module in modules() and module not in reached:
            reached.add(module)
            todo += [*inside(module, top_level=True), module.rpartition(".")[0]]
    assert {"model.gaussians", "decode.stream", "render.workspace", "commands.encode"} <= reached
    for path in [*(modules()[m] for m in reached), *(ROOT / "player").glob("*.py")]:
        heavy = {part_of(n) for n in outside(path, top_level=True)} & STUDIO
        assert not heavy, f"{path} imports {heavy} at the top"


def test_benchmarks_replace_nothing_by_mocks():
    for path in (ROOT / "bench").rglob("*.py"):
        assert not any(n.startswith("unittest") for n in outside(path)), path
