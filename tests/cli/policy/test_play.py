"""``brainbench policy`` tasks and play, as a user calls them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.factories.policies import run_policy


def test_tasks_are_listed() -> None:
    found = json.loads(run_policy("tasks", "--json"))
    assert {"in_palm_rotate", "in_hand_repose", "screwdriver", "hot_ball"} <= {row["task"] for row in found}


@pytest.mark.slow
def test_what_a_shipped_policy_did_is_told_in_goals_turns_and_drops() -> None:
    words = ("play", "in_palm_rotate", "--agent", "in_palm_rotate.teacher", "--seconds", "2", "--seed", "2")
    told = {line.split("  ")[0]: line.split("  ")[-1].strip() for line in run_policy(*words).splitlines()}
    found = json.loads(run_policy(*words, "--json"))
    assert int(told["goals reached"]) == found["goals"] >= 1
    assert told["turned"].startswith(f"{found['turned']:.2f} rad")
    assert told["dropped"].startswith("0")


def test_a_policy_that_plays_forgets_an_episode_that_ended(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    steps = []

    class Remembering:
        def __init__(self, _: str, env: Any, **__: Any) -> None:
            self.action = torch.zeros(1, env.num_actions)
            steps.append(0)

        def __call__(self, _: object) -> torch.Tensor:
            steps[-1] += 1
            return self.action

        def reset(self, mask: torch.Tensor) -> None:
            assert mask.tolist() == [True]
            steps.append(0)

    monkeypatch.setattr("brainbench.cli.policy.play.agent_of", Remembering)
    run_policy("play", "quick", "--task-file", str(quick), "--seconds", "0.25")
    assert steps == [4, 4, 2]


@pytest.mark.slow
def test_playing_needs_no_package_for_training_and_checks_names_first() -> None:
    code = """
import sys

lacking, *lines = sys.argv[1:]
sys.modules |= dict.fromkeys(lacking.split())
from brainbench.cli import main

for line in lines:
    sys.argv = ["brainbench", "policy", "play", "in_palm_rotate", *line.split()]
    try:
        main()
        ended = 0
    except SystemExit as stop:
        ended = stop.code or 0
    print("ended", ended)
"""

    def play(lacking: str, *lines: str) -> tuple[list[str], str]:
        """Play once for each line of arguments in a process that lacks modules: how each ended, and stderr."""
        command = [sys.executable, "-c", code, lacking, *lines]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return [line for line in done.stdout.splitlines() if line.startswith("ended")], done.stderr

    training = "rsl_rl tensordict tensorboard gymnasium"
    agents = [f"--agent in_palm_rotate.{kind} --seconds 0.1" for kind in ("teacher", "student")]
    ended, told = play(training, *agents)
    assert ended == ["ended 0"] * 2, told
    assert "CUDA" not in told
    ended, told = play(f"{training} torch warp", "--agent in_palm_rotate.teachr", "--video x.mpx")
    assert (ended, told.count("\n")) == (["ended 2"] * 2, 2), told


def test_shipped_policies_are_listed_with_the_contacts_that_they_were_trained_in() -> None:
    found = {row["task"]: row["contacts"] for row in json.loads(run_policy("tasks", "--json"))}["in_palm_rotate"]
    assert found == {"in_palm_rotate.teacher": "firm", "in_palm_rotate.student": "firm"}
    told = [line.split() for line in run_policy("tasks").splitlines() if line.startswith("in_palm_rotate.")]
    assert {name: model for name, _, model, *_ in told} == found
