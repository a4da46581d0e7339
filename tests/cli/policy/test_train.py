from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import lock_folder, read_json
from robotics_bridge import hands
from robotics_bridge.hands.layouts import write_probes
from tests.factories.policies import run_policy, teacher_in


@pytest.mark.slow
def test_a_task_of_ones_own_is_trained_and_evaluated(tmp_path: Path, quick: Path) -> None:
    run = tmp_path / "run"
    out = run_policy(
        "train", "quick", "--task-file", str(quick), "--envs", "2", "--iterations", "1", "--out", str(run), "--json"
    )
    assert json.loads(out)["control_steps"] == 8
    from robotics_bridge import tasks

    tasks.forget("quick")
    arguments = ["quick", str(run), "--task-file", str(quick), "--envs", "2", "--episodes", "2", "--seeds", "1"]
    found = json.loads(run_policy("evaluate", *arguments, "--json"))
    assert [row["agent"] for row in found] == ["zero", "random", str(run)]
    assert {row["contacts"] for row in found} == {"firm"}
    assert all(row["episodes"] == 2 for row in found)
    tasks.forget("quick")
    student = ("--task-file", str(quick), "--envs", "2", "--iterations", "1", "--episodes", "0", "--json")
    senses = ("--observe", "agg_bool", "--placement", "tips", "--encoder", "mlp")
    words = ("--teacher", str(run), *senses, *student, "--out", str(tmp_path / "student"))
    assert json.loads(run_policy("distill", "quick", *words))["iterations"] == 1
    tasks.forget("quick")
    _sweep_that_two_processes_share(tmp_path, str(run), str(quick))


def _sweep_that_two_processes_share(folder: Path, teacher: str, task: str) -> None:
    from robotics_bridge import tasks

    plan, out = folder / "plan.toml", folder / "students"
    plan.write_text(
        f'teacher = "{teacher}"\n[settings]\nnum_envs = 2\niterations = 2\n[[entries]]\ntask = "quick"\n'
        'hand = "xhand1"\n[[students]]\nobserve = "none"\n[[students]]\nobserve = "none"\nembedder = "none"\n'
    )
    common = (str(plan), "--task-file", task, "--episodes", "2", "--seeds", "1", "--out", str(out), "--json")
    names = json.loads(run_policy("sweep", *common, "--list"))
    tasks.forget("quick")

    def statuses(*words: str) -> list[str]:
        rows = json.loads(run_policy("sweep", *common, *words))
        tasks.forget("quick")
        return [row["status"] for row in rows]

    with lock_folder(out / ".taken" / names[0]):
        assert statuses("--stop-at", "1") == ["at another process", "stopped"]
    assert statuses("--stop-at", "1") == ["stopped", "there already"]
    assert statuses() == ["finished", "finished"]
    assert {len(read_json(out / name / "evaluation.json")) for name in names} == {1}


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


def test_sweep_counts_table_4_10() -> None:
    counted = json.loads(run_policy("sweep", "--count", "--json"))
    assert (counted["students"], counted["published"]) == (244, 214)
    assert "244 students in table-4.10, all (214 without agg_bool)" in run_policy("sweep", "--count")
    parts = [
        json.loads(run_policy("sweep", "--list", "--json", "--shard", f"{i}/3", "--subset", "types")) for i in range(3)
    ]
    assert sum(map(len, parts)) == len({name for part in parts for name in part}) == 44
    with pytest.raises(UsageError, match="such as 0/4; received '4/4'"):
        run_policy("sweep", "--shard", "4/4")


@pytest.mark.slow
def test_a_student_is_distilled_evaluated_and_exported(tmp_path) -> None:
    teacher = tmp_path / "teacher"
    run_policy("train", "in_palm_rotate", "--out", teacher, "--envs", 2, "--iterations", 1, "--steps", 4)
    common = ("--teacher", teacher, "--envs", 2, "--iterations", 1, "--episodes", 2)
    run = tmp_path / "students" / "one"
    found = json.loads(
        run_policy(
            "distill", "in_palm_rotate", *common, "--observe", "agg_bool", "--placement", "tips", "--out", run, "--json"
        )
    )
    assert (found["status"], found["episodes"]) == ("finished", 6)
    assert json.loads(run_policy("export", run, "--json"))["difference"] < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("senses", "encoder"),
    [
        (("--observe", "elastomer", "--placement", "tips"), ("--encoder", "tactile_convrnn")),
        (("--observe", "proximity", "--placement", "tips"), ("--encoder", "rnn", "--units", 9)),
        (("--resolution", "own.json"), ("--encoder", "reservoir", "--draw", 7)),
        (("--placement", "fingers"), ("--encoder", "zhuang-small.simclr", "--time", "resampled")),
    ],
)
def test_a_student_of_any_touch_and_encoder_runs_to_the_recorded_episode(
    tmp_path, monkeypatch, senses: tuple, encoder: tuple
) -> None:
    monkeypatch.chdir(tmp_path)
    write_probes("own.json", hands.load("xhand1").layout("low", "tips"))
    teacher, task = ("--teacher", "in_palm_rotate.teacher"), "in_palm_rotate"
    small = ("--envs", 2, "--iterations", 1, "--episodes", 0)
    run_policy("distill", task, *teacher, *small, *senses, *encoder, "--out", "run")
    assert json.loads(run_policy("play", task, "--agent", "run", "--seconds", 0.1, "--json"))["agent"] == "run"
    assert json.loads(run_policy("export", "run", "--json"))["difference"] < 1e-4
    deployed = run_policy(
        "deploy", "run/policy.onnx", "--shadow", "--seconds", 1, "--timeout", 1, "--record", "ep", "--json"
    )
    assert json.loads(deployed)["status"] == "finished"


@pytest.mark.slow
def test_a_policy_plays_in_the_contacts_that_it_was_trained_in_unless_told_otherwise(tmp_path: Path) -> None:
    other = str(teacher_in("published", tmp_path / "other"))

    def contacts(agent: str, *more: str) -> str:
        words = ("--agent", agent, "--seconds", "0.05", *more)
        return json.loads(run_policy("play", "in_palm_rotate", *words, "--json"))["contacts"]

    firm = ("--change", "contacts=firm")
    assert contacts("random") == contacts("in_palm_rotate.teacher") == contacts(other, *firm) == "firm"
    assert contacts(other) == contacts("in_palm_rotate.teacher", "--change", "contacts=published") == "published"
    with pytest.raises(UsageError, match="counted from"):
        contacts("in_palm_rotate.teacher", "--config", "published")
    with pytest.raises(UsageError, match="different contacts"):
        run_policy("evaluate", "in_palm_rotate", other, "in_palm_rotate.teacher")


def test_wrong_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'random'"):
        run_policy("play", "in_palm_rotate", "--agent", "randm", "--seconds", "0.1")
    with pytest.raises(UsageError, match="--seconds must be"):
        run_policy("play", "in_palm_rotate", "--seconds", "0")
    with pytest.raises(DataError, match=r"none\.py"):
        run_policy("play", "in_palm_rotate", "--task-file", str(tmp_path / "none.py"))
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        run_policy("play", "in_palm_rotate", "--task-file", str(broken))
