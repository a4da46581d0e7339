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


def _listed(tree: Path) -> set[str]:
    """Return the commands that the help of the program and of each group shows, as entry points name them."""
    code = """
import json, typer
from brainbench.cli import app
commands = typer.main.get_command(app).commands
print(json.dumps([*commands, *(f"{name}.{inner}" for name, one in commands.items() for inner in getattr(one, "commands", []))]))
"""  # noqa: E501
    done = _run(tree, "-c", code)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout))


@pytest.fixture(scope="module")
def everything() -> set[str]:
    return _listed(ROOT)


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


@pytest.mark.parametrize("package", OPTIONAL)
def test_nobody_imports_an_optional_folder(package: str):
    own = ROOT.joinpath(*package.split("."))
    for path in (file for name in PACKAGES for file in (ROOT / name).rglob("*.py") if not file.is_relative_to(own)):
        text = path.read_text(encoding="utf-8")
        if package.rpartition(".")[2] not in text:
            continue
        for node in ast.walk(ast.parse(text)):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            assert not any(f"{name}.".startswith(f"{package}.") for name in names), f"{path} imports {package}"


@pytest.mark.parametrize("package", OPTIONAL)
def test_without_a_folder_its_commands_alone_are_missing_and_say_which_folder_it_was(package: str, without, everything):
    tree, commands = without(package), _commands(package)
    inner = {name for name in everything if name.partition(".")[0] in commands}
    assert _listed(tree) == everything - {*commands} - inner
    for command in commands:
        done = _run(tree, "-m", "brainbench", *command.split("."))
        assert done.returncode == 1
        assert package.replace(".", "/") in done.stderr
        assert command.replace(".", " ") in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_without_any_optional_folder_a_model_is_scored(without, files):
    _check_score(without(*OPTIONAL), files)


@pytest.mark.slow
@pytest.mark.parametrize("package", OPTIONAL)
def test_without_a_folder_every_other_module_imports_and_a_model_is_scored(package: str, without, files):
    tree = without(package)
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
