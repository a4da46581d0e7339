"""Additions and builds that are killed at any instant, or run twice at once, end with the bytes of a quiet run."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from leaderboards import build_leaderboard, read_records, write_record
from tests.factories.records import make_record
from tests.factories.sweep_batches import files_of

ROOT = Path(__file__).parents[2]
CODE = """
import sys
from brainbench.cli import main
from leaderboards.site import build
print("ready", flush=True)
sys.argv = ["brainbench", "leaderboard", *sys.argv[1:]]
main()
"""


def _start(*arguments: object) -> subprocess.Popen:
    """Start a command of the leaderboard and return when its modules are loaded."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", CODE, *map(str, arguments)]
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def _seconds(*arguments: object) -> float:
    """Run a command to its end and return how long it took after loading."""
    process = _start(*arguments)
    begin = time.monotonic()
    process.communicate(timeout=300)
    assert process.returncode == 0
    return time.monotonic() - begin


def _kill_after(seconds: float, *arguments: object) -> bool:
    """Kill a command so long after it is ready; return whether it still ran."""
    with _start(*arguments) as process:
        time.sleep(seconds)
        running = process.poll() is None
        process.send_signal(signal.SIGKILL)
    return running


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("source")
    for index in range(24):
        write_record(make_record(f"net-{index}", 0.3 + 0.02 * index), folder)
    return folder


def _check_build(source: Path, work: Path, kills: int) -> None:
    earlier, later = (work / name for name in ("earlier", "later"))
    build_leaderboard(read_records(sorted(source.iterdir())[:9]), earlier, title="earlier")
    whole = _seconds("build", source, "--out", later)
    known = {name: {files_of(site).get(name) for site in (earlier, later)} for name in files_of(later)}
    known = {name: known.get(name, set()) | {data} for name, data in files_of(earlier).items()} | known
    draw = random.Random(kills)
    site, cut = work / "site", 0
    for _ in range(kills):
        build_leaderboard(read_records(sorted(source.iterdir())[:9]), site, title="earlier")
        cut += _kill_after(draw.uniform(0, whole), "build", source, "--out", site)
        seen = {name: data for name, data in files_of(site).items() if not Path(name).name.startswith(".")}
        assert all(data in known[name] for name, data in seen.items() if name != "build-manifest.json")
        build_leaderboard(read_records(source), site)
        assert files_of(site) == files_of(later)
    assert cut > kills // 3


def _check_add(source: Path, work: Path, kills: int) -> None:
    expected = work / "expected"
    whole = _seconds("add", source, "--to", expected)
    draw = random.Random(kills)
    cut = 0
    for place in range(kills):
        to = work / str(place)
        cut += _kill_after(draw.uniform(0, whole), "add", source, "--to", to)
        if to.is_dir() and any(to.glob("[!.]*")):
            assert all(item.problem is None for item in read_records(to))
        _seconds("add", source, "--to", to)
        assert files_of(to) == files_of(expected)
    assert cut > kills // 3


@pytest.mark.slow
def test_a_killed_build_is_repeated_to_the_same_bytes(source, tmp_path):
    _check_build(source, tmp_path, kills=1)


@pytest.mark.slow
def test_builds_killed_at_many_instants_are_repeated_to_the_same_bytes(source, tmp_path):
    _check_build(source, tmp_path, kills=20)


@pytest.mark.slow
def test_additions_killed_at_many_instants_go_on_to_the_same_bytes(source, tmp_path):
    _check_add(source, tmp_path, kills=20)


@pytest.mark.slow
def test_two_processes_build_one_site_and_fill_one_folder(source, tmp_path):
    halves = [sorted(source.iterdir())[part::2] for part in (0, 1)]
    site, board = tmp_path / "site", tmp_path / "board"
    for commands in (
        [("build", source, "--out", site)] * 2,
        [("add", *half, "--to", board) for half in halves],
    ):
        processes = [_start(*command) for command in commands]
        for process in processes:
            process.communicate(timeout=300)
        assert [process.returncode for process in processes] == [0, 0]
    assert files_of(board) == files_of(source)
    build_leaderboard(read_records(source), tmp_path / "alone")
    assert files_of(site) == files_of(tmp_path / "alone")
