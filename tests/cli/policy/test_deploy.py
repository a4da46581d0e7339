"""``brainbench policy export|deploy``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from brainbench.core.errors import BrainbenchError, UsageError
from brainbench.core.files import write_json
from tests.factories.policies import export_small, run_policy

TOLD = ("--input", "command=1")


SHORT = ("--seconds", 2, *TOLD)


@pytest.mark.slow
def test_deploy_runs_on_the_simulated_hand_and_stops_it_when_readings_are_absurd(tmp_path) -> None:
    path = export_small(tmp_path)
    found = json.loads(run_policy("deploy", path, *SHORT, "--timeout", 1, "--record", tmp_path / "ep", "--json"))
    assert found["status"] == "finished", found["reason"]
    assert list(found["unmeasured"]) == ["command"]
    assert found["ticks"] > 40
    info = json.loads((tmp_path / "ep" / "meta" / "info.json").read_text())
    assert info["total_frames"] == found["ticks"]
    stopped = json.loads(run_policy("deploy", path, *SHORT, "--fault", "absurd=0.5", "--json", code=1))
    assert "beyond its limits" in stopped["reason"]


def test_deploy_refuses_files_without_a_contract_and_unknown_faults(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="brainbench policy export writes a policy"):
        run_policy("deploy", tmp_path / "policy.onnx")
    path = tmp_path / "policy.onnx"
    path.write_bytes(b"")
    contract = {"inputs": [["proprio", [36]]], "format": "onnx", "deployment": {"rate": 40}}
    write_json(tmp_path / "policy.onnx.json", contract)
    with pytest.raises(UsageError, match="does not say 'action_map'"):
        run_policy("deploy", path)


@pytest.mark.slow
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
            run_policy("deploy", path, *words)


@pytest.mark.slow
def test_a_student_plays_with_its_own_touch_and_is_exported(tmp_path: Path) -> None:
    from robotics_bridge.deploy.controller import read_deployed
    from robotics_bridge.tasks.settings import CONTACTS

    name, file = "in_palm_rotate.student", tmp_path / "policy.onnx"
    out = json.loads(run_policy("play", "in_palm_rotate", "--agent", name, "--seconds", "0.2", "--json"))
    assert (out["agent"], out["contacts"]) == (name, "firm")
    run_policy("export", name, "--out", str(file))
    deployed = read_deployed(file)
    assert (deployed.contract.observe, deployed.contract.contacts) == ("force_torque", CONTACTS["firm"])
    # What a hand measures or is told is all that it reads: nothing but touch is asked for.
    assert list(deployed.contract.inputs) == ["proprio", "command", "tactile"]
    assert list(deployed.require({"tactile"})) == ["tactile"]
