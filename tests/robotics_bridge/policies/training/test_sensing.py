"""Policies that train on what a hand has: recurrent PPO, and a student's folder at its end."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.evaluate import Policy, evaluate
from robotics_bridge.policies.shipped import SENSING
from robotics_bridge.policies.training.student_files import load_student
from robotics_bridge.policies.training.teacher import TeacherRun, train


def _env(observe: str = "agg_bool") -> Env:
    task = replace(tasks.load("in_palm_rotate"), episode=1.0)
    return tasks.make(task, num_envs=4, observe=observe, placement="tips", threads=1)


def _run(folder: Path, iterations: int, **options: object) -> dict[str, torch.Tensor]:
    made = TeacherRun(iterations=iterations, save_every=1, observe=("proprio", "touch", "command"), **options)  # type: ignore[arg-type]
    train(_env(), folder, made)
    student, _ = load_student(folder)
    return student.state_dict()


def test_a_policy_of_joints_and_touch_learns_goes_on_and_acts_as_a_student(tmp_path: Path) -> None:
    whole = _run(tmp_path / "whole", 2, loggers=("csv",))
    _run(tmp_path / "parts", 1)
    parts = _run(tmp_path / "parts", 2)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=0, msg=name)
    student, described = load_student(tmp_path / "whole" / SENSING)
    assert [name for name, _ in described["groups"]] == ["proprio", "command", "tactile"]
    assert described["deployment"]["command"] == [1.0]
    # Memory: the same observation is answered otherwise after another past.
    env = _env()
    policy, first = Policy(student), env.observations
    one = policy(first)
    assert not torch.equal(one, policy(first))
    assert len(evaluate(env, policy, episodes=4, seed=0).success) == 4
    with (tmp_path / "whole" / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    logged = [json.loads(line) for line in (tmp_path / "whole" / "log.jsonl").read_text().splitlines()]
    assert [float(row["reward"]) for row in rows] == [row["reward"] for row in logged]
    assert not list((tmp_path / "whole").glob("tensorboard"))


@pytest.mark.parametrize("encoder", [pytest.param("rnn", marks=pytest.mark.slow), "auto"])
def test_forces_of_all_taxels_are_learned_from_or_the_run_says_that_it_diverged(tmp_path: Path, encoder: str) -> None:
    env = tasks.make("in_palm_rotate", num_envs=4, observe="force_torque", threads=1)
    options = TeacherRun(iterations=2, observe=("proprio", "touch"), encoder=encoder, loggers=())
    if encoder == "rnn":
        losses = train(env, tmp_path, options).history[-1]
        assert all(np.isfinite(value) for name, value in losses.items() if name.startswith("loss/"))
        return
    # A convolutional GRU with layer norm: through 24 steps of an untouched map the gradient overflows.
    with pytest.raises(DataError, match=r"diverged: after iteration 1 .*another encoder"):
        train(env, tmp_path, options)
    assert not list(tmp_path.glob("*.safetensors"))


def test_what_a_hand_has_not_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    refused = [("tuch", "did you mean 'touch'"), ("goal", "'goal', which only"), ("priv_proprio", "'priv_proprio'")]
    for name, culprit in refused:
        with pytest.raises(UsageError, match=culprit):
            TeacherRun(observe=("proprio", name))
    with pytest.raises(UsageError, match="gives no 'thermal'"):
        train(_env(), tmp_path, TeacherRun(observe=("proprio", "thermal"), iterations=1))
    with pytest.raises(UsageError, match="gives no 'tactile'"):
        train(_env("none"), tmp_path, TeacherRun(observe=("proprio", "touch"), iterations=1))
