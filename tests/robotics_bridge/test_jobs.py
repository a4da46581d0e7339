"""The list of campaigns: what it names can be given as it stands."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path

import pytest

from brainbench.core.errors import UsageError
from tests.factories.benchmark_programs import benchmark_program

JOBS = benchmark_program("policies.jobs")
read_jobs = JOBS.read_jobs


def test_every_job_has_a_command_that_exists_and_minutes() -> None:
    jobs = read_jobs()
    assert len(jobs) > 5
    words = [shlex.split(job["command"].replace(";", " ; ")) for job in jobs]
    known = {"train", "distill", "probe", "evaluate", "sweep"}
    for line in words:
        named = [line[at + 2] for at, word in enumerate(line[:-2]) if (word, line[at + 1]) == ("brainbench", "policy")]
        assert set(named) <= known


def test_a_list_with_a_job_twice_or_an_unknown_key_is_refused(tmp_path: Path) -> None:
    job = '[[jobs]]\nname = "a"\ncommand = "c"\nminutes = 1\nresult = ""\n'
    (tmp_path / "twice.toml").write_text(job + job)
    (tmp_path / "odd.toml").write_text(job + "minuts = 3\n")
    with pytest.raises(ValueError, match="'a' needs a name of its own"):
        read_jobs(tmp_path / "twice.toml")
    with pytest.raises(ValueError, match="'minuts'"):
        read_jobs(tmp_path / "odd.toml")


def test_a_machine_that_lacks_a_package_is_told_before_a_minute_is_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match=r"lacks no_such_package, nor_this; .*pack\.sh msgspec"):
        JOBS.check_machine(("torch", "no_such_package.part", "nor_this"))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(UsageError, match="no GPU"):
        JOBS.check_machine(("torch",))
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    JOBS.check_machine(("torch",))
    assert all(importlib.util.find_spec(name.partition(".")[0]) for name in JOBS.NEEDED if name != "mujoco_warp")
