"""``brainbench policy`` tasks, play, train and evaluate, as a user calls them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from tests.factories.policies import teacher_in

SMALL = """
from dataclasses import replace
from robotics_bridge import tasks

@tasks.register("quick")
def quick() -> tasks.Task:
    task = tasks.load("in_palm_rotate")
    return replace(task, name="quick", episode=0.1,
                   teacher=replace(task.teacher, hidden=(8,), epochs=1, minibatches=1, steps_per_env=4))
"""


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    from robotics_bridge import tasks

    file = tmp_path / "quick.py"
    file.write_text(SMALL)
    if "quick" in tasks.list_tasks():
        tasks.forget("quick")
    return file


def _run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["policy", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_tasks_are_listed() -> None:
    found = json.loads(_run("tasks", "--json"))
    assert {"in_palm_rotate", "in_hand_repose", "screwdriver", "hot_ball"} <= {row["task"] for row in found}


def test_what_a_shipped_policy_did_is_told_in_goals_turns_and_drops() -> None:
    words = ("play", "in_palm_rotate", "--agent", "in_palm_rotate.teacher", "--seconds", "2", "--seed", "2")
    told = {line.split("  ")[0]: line.split("  ")[-1].strip() for line in _run(*words).splitlines()}
    found = json.loads(_run(*words, "--json"))
    assert int(told["goals reached"]) == found["goals"] >= 1
    assert told["turned"].startswith(f"{found['turned']:.2f} rad")
    assert told["dropped"].startswith("0")


def _student(folder: Path) -> Path:
    """Return an untrained student of in_palm_rotate, as ``distill`` leaves it."""
    words = ("--teacher", "in_palm_rotate.teacher", "--observe", "force_torque", "--envs", "1", "--stop-at", "1")
    _run("distill", "in_palm_rotate", *words, "--iterations", "1", "--episodes", "0", "--out", str(folder / "felt"))
    return folder / "felt"


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
    _run("play", "quick", "--task-file", str(quick), "--seconds", "0.25")
    assert steps == [4, 4, 2]


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
    ended, told = play(f"{training} torch warp mujoco", "--agent in_palm_rotate.teachr", "--video x.mpx")
    assert (ended, told.count("\n")) == (["ended 2"] * 2, 2), told


def test_shipped_policies_are_listed_with_the_contacts_that_they_were_trained_in() -> None:
    found = {row["task"]: row["contacts"] for row in json.loads(_run("tasks", "--json"))}["in_palm_rotate"]
    assert found == {"in_palm_rotate.teacher": "firm", "in_palm_rotate.student": "firm"}
    told = [line.split() for line in _run("tasks").splitlines() if line.startswith("in_palm_rotate.")]
    assert {name: model for name, _, model, *_ in told} == found


def test_a_film_that_cannot_be_written_is_told_before_anything_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("brainbench.cli.policy.options.World.make", lambda *_, **__: pytest.fail("it was begun"))
    with pytest.raises(MissingDependencyError, match="imageio-ffmpeg"):
        _run("play", "in_palm_rotate", "--agent", "zero", "--video", str(tmp_path / "turn.mp4"))


def test_a_policy_plays_in_the_contacts_that_it_was_trained_in_unless_told_otherwise(tmp_path: Path) -> None:
    other = str(teacher_in("published", tmp_path / "other"))

    def contacts(agent: str, *more: str) -> str:
        words = ("--agent", agent, "--seconds", "0.05", *more)
        return json.loads(_run("play", "in_palm_rotate", *words, "--json"))["contacts"]

    firm = ("--change", "contacts=firm")
    assert contacts("random") == contacts("in_palm_rotate.teacher") == contacts(other, *firm) == "firm"
    assert contacts(other) == contacts("in_palm_rotate.teacher", "--change", "contacts=published") == "published"
    with pytest.raises(UsageError, match="counted from"):
        contacts("in_palm_rotate.teacher", "--config", "published")
    with pytest.raises(UsageError, match="different contacts"):
        _run("evaluate", "in_palm_rotate", other, "in_palm_rotate.teacher")


def test_a_student_plays_with_its_own_touch_and_is_exported(tmp_path: Path) -> None:
    from robotics_bridge.deploy.session import read_deployed
    from robotics_bridge.tasks.settings import CONTACTS

    name, file = "in_palm_rotate.student", tmp_path / "policy.onnx"
    out = json.loads(_run("play", "in_palm_rotate", "--agent", name, "--seconds", "0.2", "--json"))
    assert (out["agent"], out["contacts"]) == (name, "firm")
    _run("export", name, "--out", str(file))
    deployed = read_deployed(file)
    assert (deployed.contract.observe, deployed.contract.more["contacts"]) == ("force_torque", CONTACTS["firm"])
    # What a hand measures or is told is all that it reads: nothing but touch is asked for.
    assert list(deployed.contract.inputs) == ["proprio", "command", "tactile"]
    assert list(deployed.require({"tactile"})) == ["tactile"]
    with pytest.raises(UsageError, match=r"no longer shipped; 'in_palm_rotate\.student'"):
        _run("play", "in_palm_rotate", "--agent", "in_palm_rotate.force-torque-hand")


def test_a_task_of_ones_own_is_trained_and_evaluated(tmp_path: Path, quick: Path) -> None:
    run = tmp_path / "run"
    out = _run(
        "train", "quick", "--task-file", str(quick), "--envs", "2", "--iterations", "1", "--out", str(run), "--json"
    )
    assert json.loads(out)["control_steps"] == 8
    from robotics_bridge import tasks

    tasks.forget("quick")
    arguments = ["quick", str(run), "--task-file", str(quick), "--envs", "2", "--episodes", "2", "--seeds", "1"]
    found = json.loads(_run("evaluate", *arguments, "--json"))
    assert [row["agent"] for row in found] == ["zero", "random", str(run)]
    assert {row["contacts"] for row in found} == {"firm"}
    assert all(row["episodes"] == 2 for row in found)
    tasks.forget("quick")
    student = ("--task-file", str(quick), "--envs", "2", "--iterations", "1", "--episodes", "0", "--json")
    senses = ("--observe", "agg_bool", "--placement", "tips", "--encoder", "mlp")
    words = ("--teacher", str(run), *senses, *student, "--out", str(tmp_path / "student"))
    assert json.loads(_run("distill", "quick", *words))["iterations"] == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--hidden", "12,x"), "--hidden takes whole numbers joined by commas; received '12,x'"),
        (("--hidden", "12,-4"), "--hidden .*received -4"),
        (("--encoder", "rnn", "--unroll", "full"), "'options' = {'unroll': 'full'} is for .* network .*'rnn'"),
        (("--encoder", "mlp", "--time", "resampled"), "'time' = 'resampled' is for .* network .*'mlp'"),
        (("--encoder", "reservoir", "--units", "3"), "'units' = 3 is for .*'reservoir'"),
    ],
)
def test_settings_that_reach_nothing_are_refused(tmp_path: Path, words: tuple[str, ...], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        CliRunner().invoke(
            app, ["policy", "distill", "in_palm_rotate", "--teacher", "in_palm_rotate.teacher", *words,
                  "--envs", "2", "--out", str(tmp_path / "student")],
            catch_exceptions=False,
        )  # fmt: skip
    assert not (tmp_path / "student").exists()


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'random'"):
        _run("play", "in_palm_rotate", "--agent", "randm", "--seconds", "0.1")
    with pytest.raises(UsageError, match="--seconds must be"):
        _run("play", "in_palm_rotate", "--seconds", "0")
    with pytest.raises(DataError, match=r"none\.py"):
        _run("play", "in_palm_rotate", "--task-file", str(tmp_path / "none.py"))
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        _run("play", "in_palm_rotate", "--task-file", str(broken))
