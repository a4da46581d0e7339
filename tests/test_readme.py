"""Every row of the README's table of jobs runs with exactly the extras that the row names."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.factories.installations import EXTRAS, ROOT, NotInstalled, link_installation

ROW = re.compile(r"^\| (?P<job>[^|]+) \| (?P<commands>`[^|]+`) \| (?P<extras>[^|]*)\|$", flags=re.MULTILINE)
TABLE = [
    (match["job"], tuple(re.findall(r"`([^`]+)`", match["commands"])), tuple(re.findall(r"`(\w+)`", match["extras"])))
    for match in ROW.finditer((ROOT / "README.md").read_text(encoding="utf-8"))
]
MADE = {
    word: command
    for _, commands, _ in TABLE
    for command in commands
    if "--out" in command
    for word in [shlex.split(command)[shlex.split(command).index("--out") + 1]]
} | {"brainbench-results": "brainbench score activations.h5"}
"""File or folder → the row's command that makes it."""
PARSED_ONLY = {
    "mkdocs serve": "serves until it is stopped",
    "brainbench recordings fetch": "needs a network",
    "brainbench score zhuang-small --recordings dandi/000231": "needs the files of the command before",
    "brainbench train": "trains for hours",
    "brainbench policy train": "needs a GPU",
    "brainbench recovery": "takes minutes",
    "brainbench stimuli sweep thesis-low --objects": "simulates for minutes",
}
"""Commands that are not run here, with the reason; ``test_docs`` parses them like all others."""
FAST = ("brainbench stimuli objects", "brainbench power", "brainbench doctor", "brainbench recordings")
MODEL = """
from torch import nn

def make_model():
    return nn.Sequential(nn.Flatten(2), nn.Linear(1050, 8))
"""


def _reason(command: str) -> str | None:
    return next((why for start, why in PARSED_ONLY.items() if command.startswith(start)), None)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the README says are the reader's own, and the checkout's records."""
    from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, write_files
    from brainbench.models.features import write_features
    from brainbench.stimuli import get_recipe
    from tests.factories.whisker_measurements import write_ringdown

    folder = tmp_path_factory.mktemp("readme")
    (folder / "mine.py").write_text(MODEL)
    rng = np.random.default_rng(0)
    labels, names = ([scene.label for scene in get_recipe(name).scenes] for name in ("objects", "rodgers"))
    write_features(folder / "activations.h5", labels, {"layer": rng.normal(size=(len(labels), 20))})
    geometry = ResponseGeometry.from_features(rng.normal(size=(len(names), 4)), names)
    design = PopulationDesign(animals=3, units=20, trials=10, window=0.5)
    paths = write_files(folder / "data", geometry, design, seed=1)
    write_ringdown(folder / "ringdown.csv")
    (folder / "session.nwb").write_bytes(paths[0].read_bytes())
    (folder / "leaderboards").symlink_to(ROOT / "leaderboards")
    return folder


def _run(command: str, folder: Path, installed: Path, depth: int = 2) -> None:
    words = shlex.split(command)
    for word in words[1:]:
        maker = MADE.get(word)
        if depth and maker and maker != command and not (folder / word).exists():
            _run(maker, folder, installed, depth - 1)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{installed}", "BROWSER": "true"}
    called = [sys.executable, "-S", "-m", *words]
    done = subprocess.run(called, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stderr[-2000:]}"


def test_the_table_is_read_and_its_extras_exist():
    jobs = (ROOT / "README.md").read_text(encoding="utf-8").split("## Jobs")[1].split("\n## ")[0]
    lines = [line for line in jobs.splitlines() if line.startswith("|")][2:]
    assert len(TABLE) == len(lines) > 25
    # Whatever stands in code in the middle column is a command that some test here runs or names a reason for.
    assert sum(len(commands) for _, commands, _ in TABLE) == sum(line.split(" | ")[1].count("`") // 2 for line in lines)
    assert {extra for _, _, extras in TABLE for extra in extras} <= set(EXTRAS)
    assert all(any(command.startswith(start) for _, row, _ in TABLE for command in row) for start in PARSED_ONLY)


@pytest.mark.parametrize(
    ("command", "extras"),
    [
        pytest.param(command, extras, id=command, marks=[] if command.startswith(FAST) else [pytest.mark.slow])
        for _, commands, extras in TABLE
        for command in commands
        if _reason(command) is None
    ],
)
def test_a_command_runs_with_the_extras_of_its_row(
    command: str, extras: tuple[str, ...], workspace: Path, tmp_path: Path
):
    try:
        installed = link_installation(tmp_path / "installed", extras)
    except NotInstalled as missing:
        pytest.skip(str(missing))
    _run(command, workspace, installed)
