"""``brainbench policy probe``."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from brainbench.cli import app


def _run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["policy", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.stdout


@pytest.mark.slow
def test_a_probe_feels_as_its_student_does(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    teacher, small = ("--teacher", "in_palm_rotate.teacher"), ("--envs", 2, "--iterations", 1, "--episodes", 0)
    senses = ("--noisy", "--placement", "tips", "--resolution", "low", "--encoder", "rnn", "--units", 4)
    _run("distill", "in_palm_rotate", *teacher, *small, *senses, "--out", "run")
    felt = []
    monkeypatch.setattr("robotics_bridge.policies.readouts.probe.probe", lambda env, *_: felt.append(env.options) or [])
    for name, noisy in (("run", True), ("in_palm_rotate.teacher", False)):
        assert json.loads(_run("probe", "in_palm_rotate", "--agent", name, "--envs", 2, "--json"))["noisy"] is noisy
    assert [(one.noisy, one.placement, one.resolution) for one in felt] == [
        (True, "tips", "low"), (False, "hand", "med"),
    ]  # fmt: skip
