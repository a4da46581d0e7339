"""``brainbench policy distill|sweep|export|deploy``."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from brainbench.cli import app
from brainbench.core.errors import BrainbenchError, UsageError
from brainbench.core.files import write_json
from robotics_bridge import hands
from robotics_bridge.hands.layouts import write_probes
from tests.factories.policies import export_small


def _run(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["policy", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.stdout


def test_sweep_counts_table_4_10() -> None:
    counted = json.loads(_run("sweep", "--count", "--json"))
    assert (counted["students"], counted["published"]) == (244, 214)
    assert "244 students in table-4.10, all (214 without agg_bool)" in _run("sweep", "--count")
    parts = [json.loads(_run("sweep", "--list", "--json", "--shard", f"{i}/3", "--subset", "types")) for i in range(3)]
    assert sum(map(len, parts)) == len({name for part in parts for name in part}) == 44
    with pytest.raises(UsageError, match="such as 0/4; received '4/4'"):
        _run("sweep", "--shard", "4/4")


TOLD = ("--input", "command=1")


SHORT = ("--seconds", 2, *TOLD)


@pytest.mark.slow
def test_deploy_runs_on_the_simulated_hand_and_stops_it_when_readings_are_absurd(tmp_path) -> None:
    path = export_small(tmp_path)
    found = json.loads(_run("deploy", path, *SHORT, "--timeout", 1, "--record", tmp_path / "ep", "--json"))
    assert found["status"] == "finished", found["reason"]
    assert list(found["unmeasured"]) == ["command"]
    assert found["ticks"] > 40
    info = json.loads((tmp_path / "ep" / "meta" / "info.json").read_text())
    assert info["total_frames"] == found["ticks"]
    stopped = json.loads(_run("deploy", path, *SHORT, "--fault", "absurd=0.5", "--json", code=1))
    assert "beyond its limits" in stopped["reason"]


def test_deploy_refuses_files_without_a_contract_and_unknown_faults(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="brainbench policy export writes a policy"):
        _run("deploy", tmp_path / "policy.onnx")
    path = tmp_path / "policy.onnx"
    path.write_bytes(b"")
    contract = {"inputs": [["proprio", [36]]], "format": "onnx", "deployment": {"rate": 40}}
    write_json(tmp_path / "policy.onnx.json", contract)
    with pytest.raises(UsageError, match="does not say 'action_map'"):
        _run("deploy", path)


def test_deploy_asks_for_what_is_missing_before_a_hand_is_started(tmp_path, monkeypatch) -> None:
    path = export_small(tmp_path)

    def started(*_: object, **__: object) -> None:
        pytest.fail("a hand was started")

    monkeypatch.setattr("robotics_bridge.deploy.links.simulated_hand.simulated_hand", started)
    monkeypatch.setattr("robotics_bridge.deploy.links.udp.UdpDriver", started)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    refused = [
        ((), r"command \("),
        (("--input", "comand=1"), "'command'"),
        (("--input", "command"), "'command'"),
        (("--input", "command=nan"), "nan"),
        (("--input", "command=inf"), "inf"),
        (("--input", "command=1,2"), "2.0"),
        ((*TOLD, *TOLD), "'command' more than once"),
        ((*TOLD, "--seconds", "nan"), "nan"),
        ((*TOLD, "--seconds", -1), "-1"),
        ((*TOLD, "--record", tmp_path / "full"), "full"),
        ((*TOLD, "--driver", "hand"), "'hand'"),
        ((*TOLD, "--driver", "hand:99999999"), "99999999"),
        ((*TOLD, "--driver", ":5000"), "--key"),
        ((*TOLD, "--driver", ":5000", "--key", tmp_path / "none.key"), r"none\.key"),
    ]
    for words, culprit in refused:
        with pytest.raises(BrainbenchError, match=culprit):
            _run("deploy", path, *words)


@pytest.mark.slow
def test_a_student_is_distilled_evaluated_and_exported(tmp_path) -> None:
    teacher = tmp_path / "teacher"
    _run("train", "in_palm_rotate", "--out", teacher, "--envs", 2, "--iterations", 1, "--steps", 4)
    common = ("--teacher", teacher, "--envs", 2, "--iterations", 1, "--episodes", 2)
    run = tmp_path / "students" / "one"
    found = json.loads(
        _run(
            "distill", "in_palm_rotate", *common, "--observe", "agg_bool", "--placement", "tips", "--out", run, "--json"
        )
    )
    assert (found["status"], found["episodes"]) == ("finished", 6)
    assert json.loads(_run("export", run, "--json"))["difference"] < 1e-4


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
    _run("distill", task, *teacher, *small, *senses, *encoder, "--out", "run")
    assert json.loads(_run("play", task, "--agent", "run", "--seconds", 0.1, "--json"))["agent"] == "run"
    assert json.loads(_run("export", "run", "--json"))["difference"] < 1e-4
    deployed = _run("deploy", "run/policy.onnx", "--shadow", "--seconds", 1, "--timeout", 1, "--record", "ep", "--json")
    assert json.loads(deployed)["status"] == "finished"
