"""Rules of the house (docs/architecture.md) that no linter knows."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PRODUCT = [path for room in ("brainbench", "robotics_bridge", "leaderboards") for path in (ROOT / room).rglob("*.py")]
TESTS = list((ROOT / "tests").rglob("*.py"))
MOST_MODULES = 16
"""Modules of a folder, its ``__init__`` aside; about twelve are wanted."""
MOST_LINES = 500
"""Lines of a module; about 120 are wanted."""


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {_name(path): path for path in PRODUCT}


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in MODULES.items()}


def _imports(tree: ast.AST) -> Iterator[str]:
    """Modules that a file imports when it runs: not those under ``if TYPE_CHECKING``."""
    typing_only = {
        id(node)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and "TYPE_CHECKING" in ast.unparse(branch.test)
        for statement in branch.body
        for node in ast.walk(statement)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (item.name for item in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for item in node.names:
                inner = f"{node.module}.{item.name}"
                yield inner if inner in MODULES or inner.startswith("tests.") else node.module


def test_no_module_is_private():
    names = {path.relative_to(ROOT).as_posix() for path in PRODUCT if path.name.startswith("_")}
    assert {name for name in names if not name.endswith(("__init__.py", "__main__.py"))} == set()


def test_no_public_class_name_is_defined_twice(trees):
    homes = defaultdict(set)
    for name, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].add(name)
    assert {name: sorted(places) for name, places in homes.items() if len(places) > 1} == {}


def test_folders_and_modules_are_small():
    folders = defaultdict(list)
    for path in PRODUCT:
        if path.name != "__init__.py":
            folders[path.parent.relative_to(ROOT).as_posix()].append(path.name)
    assert {name: len(files) for name, files in folders.items() if len(files) > MOST_MODULES} == {}
    lines = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_every_folder_says_what_is_in_it(trees):
    mute = [path.parent.relative_to(ROOT).as_posix() for path in PRODUCT if path.name == "__init__.py"]
    assert [name for name in mute if not ast.get_docstring(trees[name.replace("/", ".")])] == []


def test_no_file_imports_in_a_circle(trees):
    graph = {name: {other for other in _imports(tree) if other in MODULES} - {name} for name, tree in trees.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle of imports: {' -> '.join(error.args[1])}")


def test_kernels_stand_in_folders_of_that_name(trees):
    found = []
    for name, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and ".kernels" not in name:
                kinds = [ast.unparse(item) for item in node.decorator_list]
                found += [name for kind in kinds if kind.startswith(("wp.func", "wp.kernel", "triton.jit"))]
    assert sorted(set(found)) == []


def test_tests_do_not_import_one_another_or_benchmarks():
    for path in TESTS:
        for module in _imports(ast.parse(path.read_text(encoding="utf-8"))):
            last = module.rpartition(".")[2]
            assert not (module.startswith("tests.") and last.startswith("test_")), f"{path.name} imports {module}"
            assert not module.startswith("benchmarks"), f"{path.name} imports {module}"
