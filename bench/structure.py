"""Structure of a checkout in numbers: lines by package, long files and functions, constants that are settings.

usage: python -m bench.structure [FOLDER ...]

Prints a Markdown table with a column for each checkout (this one by default), so that a change can be shown before and
after. Python is read with `ast`, Rust as text. Tests, generated and vendored files are left out.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parent.parent
LONG_FILE, LONG_FUNCTION, MANY_PARAMETERS = 300, 60, 8
ATTRIBUTE_NAMES = ("log_scales|LogScales", "quats|Quats", "logit_opacities|LogitOpacities", "sh0|Sh0", "shN|sh_n|ShN")
RUST_FUNCTION = re.compile(r"^( *)(?:pub(?:\([a-z]+\))? )?(?:const )?fn \w+", re.M)


def sources(root: Path) -> list[Path]:
    """Python and Rust files of codec/ and bench/, without tests and fuzz targets."""
    found = [p for d in ("codec", "bench") for p in (root / d).rglob("*") if p.suffix in (".py", ".rs")]
    left_out = {"target", "tests", "fuzz", "player"}
    return [p for p in found if not left_out & set(p.relative_to(root).parts) and p.name != "tests.rs"]


def functions(path: Path) -> list[tuple[int, int]]:
    """(lines, parameters) of each function of a Python file."""
    tree = ast.parse(path.read_text())
    nodes = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    arguments = [[*n.args.posonlyargs, *n.args.args, *n.args.kwonlyargs] for n in nodes]
    own = [sum(a.arg not in ("self", "cls") for a in args) for args in arguments]
    return [(n.end_lineno - n.lineno + 1, count) for n, count in zip(nodes, own, strict=True)]


def rust_functions(path: Path) -> list[int]:
    """Lines of each function of a Rust file, up to the brace that closes it at its own indentation."""
    text, lengths = path.read_text(), []
    for match in RUST_FUNCTION.finditer(text):
        end = re.compile(rf"^{match[1]}}}", re.M).search(text, match.end())
        if end:
            lengths.append(text.count("\n", match.start(), end.start()) + 1)
    return lengths


def setting_constants(path: Path) -> int:
    """Module-level UPPER_CASE names of a Python file that are numbers, or tuples, lists and dicts of them."""
    count = 0
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and _numeric(node.value):
            names = [e for t in node.targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]
            count += sum(isinstance(n, ast.Name) and n.id.isupper() for n in names)
    return count


def _numeric(node: ast.AST) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp | ast.BinOp):
        return all(_numeric(n) for n in ast.iter_child_nodes(node) if isinstance(n, ast.expr))
    if isinstance(node, ast.Tuple | ast.List | ast.Set):
        return bool(node.elts) and all(map(_numeric, node.elts))
    return isinstance(node, ast.Dict) and bool(node.values) and all(map(_numeric, node.values))


def lists_attributes(path: Path) -> bool:
    """Whether a file names all of log_scales, quats, logit_opacities, sh0 and shN outside of docstrings."""
    text = re.sub(r'"""(.|\n)*?"""', "", path.read_text())
    return all(re.search(rf"\b({names})\b", text) for names in ATTRIBUTE_NAMES)


def package(path: Path, root: Path) -> str:
    """Folder by which lines are counted: "codec/train", "codec/native/gsv", "codec" for single modules."""
    parts = path.relative_to(root).parts
    if parts[:2] == ("codec", "native"):
        return "/".join(parts[:3])
    return "/".join(parts[:2]) if len(parts) > 2 and parts[0] == "codec" else parts[0]


def measure(root: Path) -> dict[str, int]:
    """Rows of the table."""
    files = sources(root)
    python = [p for p in files if p.suffix == ".py"]
    lines = {p: p.read_text().count("\n") for p in files}
    own = Counter()
    for p in files:
        own[f"lines of {package(p, root)}"] += lines[p]
    found = [f for p in python for f in functions(p)]
    rust = [n for p in files if p.suffix == ".rs" for n in rust_functions(p)]
    return {
        **dict(sorted(own.items())),
        "lines in all": sum(lines.values()),
        f"files above {LONG_FILE} lines, Python": sum(lines[p] > LONG_FILE for p in python),
        f"files above {LONG_FILE} lines, Rust": sum(lines[p] > LONG_FILE for p in files if p.suffix == ".rs"),
        f"functions above {LONG_FUNCTION} lines, Python": sum(n > LONG_FUNCTION for n, _ in found),
        f"functions above {LONG_FUNCTION} lines, Rust": sum(n > LONG_FUNCTION for n in rust),
        f"functions with more than {MANY_PARAMETERS} parameters, Python": sum(n > MANY_PARAMETERS for _, n in found),
        "files of codec/ that list the attributes": sum(lists_attributes(p) for p in files if "codec" in p.parts),
        "numeric constants of modules, codec/": sum(setting_constants(p) for p in python if "codec" in p.parts),
        "numeric constants of modules, codec/train": sum(setting_constants(p) for p in python if "train" in p.parts),
        "numeric constants of modules, codec/encode": sum(setting_constants(p) for p in python if "encode" in p.parts),
    }


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], usage="python -m bench.structure [FOLDER ...]")
    parser.add_argument("folders", nargs="*", type=Path, default=[ROOT])
    folders = parser.parse_args().folders
    columns = [measure(f) for f in folders]
    names = list(dict.fromkeys(n for c in columns for n in c))
    names.sort(key=lambda n: (not n.startswith("lines of"), n if n.startswith("lines of") else ""))
    print("| | " + " | ".join(f.name for f in folders) + " |")
    print("|---|" + "---|" * len(folders))
    for name in names:
        print(f"| {name} | " + " | ".join(str(c.get(name, 0)) for c in columns) + " |")


if __name__ == "__main__":
    main()
