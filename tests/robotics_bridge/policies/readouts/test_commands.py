"""``brainbench policy probe``."""

from __future__ import annotations

import json

import pytest

from tests.factories.policies import run_policy


@pytest.mark.slow
def test_a_probe_feels_as_its_student_does(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    teacher, small = ("--teacher", "in_palm_rotate.teacher"), ("--envs", 2, "--iterations", 1, "--episodes", 0)
    senses = ("--noisy", "--placement", "tips", "--resolution", "low", "--encoder", "rnn", "--units", 4)
    run_policy("distill", "in_palm_rotate", *teacher, *small, *senses, "--out", "run")
    felt = []
    monkeypatch.setattr("robotics_bridge.policies.readouts.probe.probe", lambda env, *_: felt.append(env.options) or [])
    for name, noisy in (("run", True), ("in_palm_rotate.teacher", False)):
        assert (
            json.loads(run_policy("probe", "in_palm_rotate", "--agent", name, "--envs", 2, "--json"))["noisy"] is noisy
        )
    assert [(one.noisy, one.placement, one.resolution) for one in felt] == [
        (True, "tips", "low"), (False, "hand", "med"),
    ]  # fmt: skip
