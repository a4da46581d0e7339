"""Optional folders come off: without any one of them, or all, the rest imports, lists its commands and scores.

The table is ``protected_modules`` of the contract "Optional folders are imported by nobody" in ``pyproject.toml``.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from brainbench.core.plugins import OptionalPart

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = ("brainbench", "robotics_bridge", "leaderboards")
OPTIONAL: list[str] = next(
    contract["protected_modules"]
    for contract in PYPROJECT["tool"]["importlinter"]["contracts"]
    if contract["type"] == "protected"
)
ENTRIES = [
    (group, name, target)
    for group, entries in PYPROJECT["project"]["entry-points"].items()
    for name, target in entries.items()
]


@pytest.fixture
def without(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that makes a copy of the tree, of links, without some folders."""

    def make(*packages: str) -> Path:
        tree = tmp_path / "tree"
        tree.mkdir()
        _link(ROOT, tree, {tuple(package.split(".")) for package in packages})
        return tree

    return make


def _link(source: Path, copy: Path, off: set[tuple[str, ...]]) -> None:
    """Link what stands in ``source``, and enter the folders that hold something to be taken off."""
    for item in source.iterdir():
        inner = {parts[1:] for parts in off if parts[0] == item.name}
        if () in inner or (source == ROOT and item.name not in PACKAGES):
            continue
        if inner:
            (copy / item.name).mkdir()
            _link(item, copy / item.name, inner)
        else:
            (copy / item.name).symlink_to(item)


def _run(tree: Path, *words: str) -> subprocess.CompletedProcess[str]:
    place = {**os.environ, "PYTHONPATH": str(tree), "COLUMNS": "200"}
    return subprocess.run([sys.executable, *words], env=place, cwd=tree, capture_output=True, text=True, check=False)


def _commands(package: str) -> list[str]:
    return [
        name
        for group, name, target in ENTRIES
        if group == "brainbench.commands" and target.startswith((f"{package}.", f"{package}:"))
    ]


def _listed(tree: Path, *missing: str) -> tuple[set[str], list[tuple[int, str]]]:
    """Return the commands that the help shows, as entry points name them, and what becomes of calls of missing ones."""
    code = """
import contextlib, io, json, sys, typer
from brainbench.cli import app, main
commands, ends = typer.main.get_command(app).commands, []
for command in sys.argv[1:]:
    sys.argv = ["brainbench", *command.split(".")]
    with contextlib.redirect_stderr(io.StringIO()) as words:
        try:
            main()
        except SystemExit as end:
            ends.append((end.code, words.getvalue()))
inner = [f"{name}.{word}" for name, one in commands.items() for word in getattr(one, "commands", [])]
print(json.dumps([[*commands, *inner], ends]))
"""
    done = _run(tree, "-c", code, *missing)
    assert done.returncode == 0, done.stderr
    shown, ends = json.loads(done.stdout)
    return set(shown), ends


def _check_commands(tree: Path, *packages: str) -> None:
    """Without some folders their commands alone are missing, and each says in a line which folder it was in."""
    off = {command: package for package in packages for command in _commands(package)}
    everything, _ = _listed(ROOT)
    inner = {name for name in everything if name.partition(".")[0] in off}
    rest, ends = _listed(tree, *off)
    assert rest == everything - {*off} - inner
    for (command, package), (status, words) in zip(off.items(), ends, strict=True):
        assert status == 1
        assert package.replace(".", "/") in words
        assert command.replace(".", " ") in words
        assert len(words.strip().splitlines()) == 1


def _check_score(tree: Path, files: dict[str, str]) -> None:
    words = ["score", files["features"], "-r", files["recordings"], "--conditions", "trials:texture"]
    done = _run(tree, "-m", "brainbench", *words, "--out", files["out"], "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["record"]["score"]["stimuli"] == list("abcd")


def test_the_installed_entry_points_are_those_of_the_project():
    installed = {
        (entry.group, entry.name, entry.value)
        for group in PYPROJECT["project"]["entry-points"]
        for entry in entry_points(group=group)
        if entry.dist is not None and entry.dist.name == "brainbench"
    }
    assert installed == set(ENTRIES), "install the project again: pip install --no-deps -e ."


def test_every_entry_point_is_there_and_belongs_to_an_optional_folder():
    for group, name, target in ENTRIES:
        part = OptionalPart(group, name, target)
        assert part.present, target
        assert any(target.startswith(f"{package}.") for package in OPTIONAL), target


@cache
def _imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


@pytest.mark.parametrize("package", OPTIONAL)
def test_nobody_imports_an_optional_folder(package: str):
    own = ROOT.joinpath(*package.split("."))
    for path in (file for name in PACKAGES for file in (ROOT / name).rglob("*.py") if not file.is_relative_to(own)):
        assert not any(f"{name}.".startswith(f"{package}.") for name in _imports(path)), f"{path} imports {package}"


def test_without_any_optional_folder_their_commands_alone_are_missing_and_a_model_is_scored(without, files):
    tree = without(*OPTIONAL)
    _check_commands(tree, *OPTIONAL)
    _check_score(tree, files)


@pytest.mark.slow
@pytest.mark.parametrize("package", OPTIONAL)
def test_without_a_folder_the_rest_lists_its_commands_imports_and_scores_a_model(package: str, without, files):
    tree = without(package)
    _check_commands(tree, package)
    # Kernels of derivatives are a part of the rod's and are imported with them alone.
    modules = sorted(
        path.relative_to(tree).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
        for name in PACKAGES
        for path in (Path(where) / file for where, _, some in os.walk(tree / name, followlinks=True) for file in some)
        if path.suffix == ".py" and path.name != "__main__.py" and "fitting/kernels" not in path.as_posix()
    )
    code = f"import importlib, brainbench.core\nfor name in {modules!r}:\n    importlib.import_module(name)"
    done = _run(tree, "-W", "ignore", "-c", code)
    assert done.returncode == 0, done.stderr
    _check_score(tree, files)
