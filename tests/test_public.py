"""docs/public.md lists exactly the names that the packages export, and the commands that exist."""

from __future__ import annotations

import importlib
import re
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
