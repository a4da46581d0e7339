"""Commands killed at any instant, given again, end with the bytes of an unbroken run and leave nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.factories.kill_jobs import JOBS

ROOT = Path(__file__).parents[3]


def _killed(name: str, folder: Path, *words: str) -> dict[str, Any]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.factories.kill_jobs", str(folder / "work"), name, *words]
    ended = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def _check(found: dict[str, Any]) -> None:
    assert {name: found[name] for name in ("different", "left", "failed", "together")} == {
        "different": [], "left": [], "failed": [], "together": []
    }  # fmt: skip


@pytest.mark.slow
def test_a_killed_addition_is_repeated(tmp_path):
    found = _killed("leaderboard add", tmp_path, "--kills", "1")
    _check(found)
    assert found["kills"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leaderboard add", "leaderboard build", "score, empty cache"])
def test_commands_that_are_ended_stopped_or_run_in_pairs_lose_nothing(name, tmp_path):
    found = _killed(name, tmp_path, "--kills", "27", "--signals", "TERM,HUP,STOP", "--pairs", "9")
    _check(found)
    assert (found["kills"], found["pairs"]) == (27, 9)


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_commands_killed_at_many_instants_end_with_the_bytes_of_unbroken_ones(job, tmp_path):
    if job.name == "policy train":
        pytest.importorskip("rsl_rl")
    found = _killed(job.name, tmp_path)
    _check(found)
    assert found["kills"] == job.kills
