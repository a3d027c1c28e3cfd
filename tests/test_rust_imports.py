"""The modules of each Rust crate depend on each other in one direction: no cycle through `use` or paths.

Source text -> graph of modules -> a cycle or None. Test code is left out: it may use everything.
"""

import re
from pathlib import Path

import pytest

NATIVE = Path(__file__).parent.parent / "codec" / "native"
CRATES = ("gsv", "raster", "bindings")
COMMENT_OR_STRING = re.compile(r'//[^\n]*|/\*.*?\*/|b?r#"(?:.|\n)*?"#|b?"(?:\\.|[^"\\])*"', re.DOTALL)
TEST_ITEM = re.compile(r"#\[cfg\(test\)\]\s*")
ANCHORED = re.compile(r"(?<![\w:])\$?(crate|self|super)::")


def source_without_tests(text):
    """Rust source without comments, strings and items under #[cfg(test)]."""
    text = COMMENT_OR_STRING.sub(lambda m: '""' if m[0].endswith(('"', "#")) else "", text)
    while found := TEST_ITEM.search(text):
        end, depth = found.end(), 0
        while end < len(text):
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
            if depth == 0 and text[end - 1] in ";}":
                break
        text = text[: found.start()] + text[end:]
    return text


def expand_tree(text, start):
    """Paths of a use tree or an inline path from `start` on, as lists of names: `a::{b, c::d}` -> a b, a c d."""
    name = re.compile(r"\s*([A-Za-z_]\w*|\*)").match(text, start)
    if name:
        if text.startswith("::", name.end()):
            paths, end = expand_tree(text, name.end() + 2)
            return [[name[1], *path] for path in paths], end
        return [[name[1]]], name.end()
    if not text.startswith("{", start):
        return [[]], start
    paths, at = [], start + 1
    while not re.compile(r"\s*\}").match(text, at):
        more, at = expand_tree(text, at)
        paths += more
        at = re.compile(r"(\s+as\s+\w+)?[\s,]*").match(text, at).end()
    return paths, text.index("}", at) + 1


def module_of(file, root):
    """Path of a module as a tuple of names: src/a/b.rs and src/a/b/mod.rs -> (a, b), src/lib.rs -> ()."""
    parts = file.relative_to(root).with_suffix("").parts
    return parts[:-1] if parts[-1] in ("mod", "lib") else parts


def dependencies(module, text, modules):
    """The modules that the source `text` of `module` names: by crate::, self::, super:: or as its own children."""
    found = set()
    for match in ANCHORED.finditer(text):
        base = {"crate": (), "self": module, "super": module[:-1]}[match[1]]
        for path in expand_tree(text, match.end())[0]:
            at = base
            while path and path[0] == "super":
                at, path = at[:-1], path[1:]
            names = (*at, *path)
            found.add(max((names[:n] for n in range(len(names) + 1) if names[:n] in modules), key=len))
    for child in (m[-1] for m in modules if m and m[:-1] == module):
        if re.search(rf"(?<![\w:]){child}::", text):
            found.add((*module, child))
    return found - {module}


def graph_of(root):
    """{module: modules that it depends on} of the crate with its sources in `root`."""
    texts = {module_of(f, root): source_without_tests(f.read_text()) for f in root.rglob("*.rs") if f.stem != "tests"}
    # the root only declares modules and exports their items
    return {m: dependencies(m, text, texts) if m else set() for m, text in texts.items()}


def find_cycle(graph):
    """Modules of a cycle, the first one repeated at the end; None if there is none."""
    done, path = set(), []

    def visit(module):
        if module in path:
            return [*path[path.index(module) :], module]
        if module in done:
            return None
        path.append(module)
        cycle = next(filter(None, (visit(m) for m in sorted(graph[module]))), None)
        path.pop()
        done.add(module)
        return cycle

    return next(filter(None, (visit(m) for m in sorted(graph))), None)


@pytest.mark.parametrize("crate", CRATES)
def test_modules_have_no_cycle(crate):
    graph = graph_of(NATIVE / crate / "src")
    assert sum(map(len, graph.values())) >= 5, "expected dependencies between modules: has the layout changed?"
    cycle = find_cycle(graph)
    names = [f"{crate}::{'::'.join(module)}" for module in cycle or ()]
    assert cycle is None, f"cycle of modules: {' -> '.join(names)}; move what both need to a module below them"


def test_a_cycle_is_found():
    sources = {
        ("a",): "use crate::{b::{self, One}, c as d};",
        ("b",): "mod inner;\npub use inner::Two;",
        ("b", "inner"): "fn f() { super::super::c::g() }",
        ("c",): "// use crate::b;\n#[cfg(test)]\nmod tests {\n    use crate::a::A;\n}\n",
    }
    graph = {m: dependencies(m, source_without_tests(text), sources) for m, text in sources.items()}
    assert graph == {("a",): {("b",), ("c",)}, ("b",): {("b", "inner")}, ("b", "inner"): {("c",)}, ("c",): set()}
    assert find_cycle(graph) is None
    graph[("c",)] = dependencies(("c",), "fn f() -> crate::b::inner::Two { 0 }", sources)
    assert find_cycle(graph) == [("b", "inner"), ("c",), ("b", "inner")]
