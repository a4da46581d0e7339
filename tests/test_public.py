"""docs/public.md lists exactly the names that the packages export, and the commands that exist."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import runpy
from pathlib import Path

import pytest
import typer

from brainbench.cli import app

PAGE = (Path(__file__).parents[1] / "docs" / "public.md").read_text()
SECTIONS = {
    package: re.findall(r"^\| `(.+?)` \|", text, re.M)
    for package, text in re.findall(r"^## `?([\w.]+)`?\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
}
PACKAGES = [name for name in SECTIONS if name != "Commands"]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_exports_the_listed_names_and_no_other(package):
    module = importlib.import_module(package)
    assert set(module.__all__) - {"__version__"} == set(SECTIONS[package])


@pytest.mark.parametrize("package", PACKAGES)
def test_every_listed_name_can_be_imported(package):
    module = importlib.import_module(package)
    assert [name for name in SECTIONS[package] if not hasattr(module, name)] == []


def test_the_listed_commands_are_those_of_the_program():
    commands = typer.main.get_command(app).commands.items()
    assert set(SECTIONS["Commands"]) == {f"brainbench {name}" for name, command in commands if not command.hidden}


@pytest.mark.shared
def test_scripts_that_others_keep_import_names_that_are_still_there(reference: Path) -> None:
    scripts = sorted((reference.parent / "cases").rglob("*.py"))
    assert len(scripts) > 20
    for script in scripts:
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith(("brainbench", "robotics_bridge")):
                module = importlib.import_module(str(node.module))
                absent = [name.name for name in node.names if not hasattr(module, name.name)]
                absent = [name for name in absent if importlib.util.find_spec(f"{node.module}.{name}") is None]
                assert not absent, (script.name, node.module, absent)


@pytest.mark.shared
def test_a_contract_made_by_a_script_of_others_still_guards_the_age_of_commands(reference: Path, capsys) -> None:
    runpy.run_path(str(reference.parent / "cases" / "doors" / "stale_command.py"))
    assert capsys.readouterr().out.count(": 0 commands from reports older than 0.1 s") == 3
