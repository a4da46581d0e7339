"""Contracts of exported policies: every value out of range is refused in one sentence that names its place.

A stored policy is held against the environment that it is to act in.
"""

from __future__ import annotations

import copy
import json
import logging
import math
from dataclasses import asdict, astuple, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from brainbench.core.errors import BrainbenchError, DataError, UsageError
from brainbench.core.files import to_plain, write_json
from robotics_bridge import hands, tasks
from robotics_bridge.policies.contract import (
    PolicyContract,
    check_fit,
    check_hand,
    trained_contacts,
    with_contacts_of,
    world_of,
)
from robotics_bridge.policies.shipped import stored
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.settings import CONTACTS, ContactModel
from robotics_bridge.tasks.task import TASK_VERSION
from tests.factories.damage import damaged, mutate
from tests.factories.hand_gallery import GALLERY
from tests.factories.policies import contract_of, teacher_in

NAN, INF = math.nan, math.inf


def _set(contract, place, value):
    *path, last = place.split(".")
    part = contract
    for name in path:
        part = part[name]
    part[last] = value
    return contract


def _read(folder, contract):
    path = folder / "policy.onnx.json"
    path.write_text(json.dumps(contract))
    return PolicyContract.read(path)


def test_a_contract_is_read_as_it_was_written(tmp_path) -> None:
    found = _read(tmp_path, contract_of())
    assert (found.rate, found.joints, found.moved, found.frozen) == (40.0, ("a", "b", "c"), ("a", "c"), {"b": 0.3})
    assert found.inputs == {"proprio": (8,), "command": (1,), "tactile": (5, 2, 3)}
    assert found.action_map.scale == (0.5, -0.5)
    assert found.contacts == CONTACTS["published"]
    firm = _set(contract_of(), "deployment.contacts", asdict(CONTACTS["firm"]))
    assert _read(tmp_path, firm).contacts == CONTACTS["firm"]


@pytest.mark.parametrize(
    ("place", "values"),
    [
        ("format", ["pickle", 1, None, ["onnx"]]),
        ("inputs", [[], {}, "proprio", [["proprio"]], [["proprio", [8]], ["proprio", [8]]], [[1, [8]]]]),
        ("inputs", [[["proprio", shape]] for shape in ([7], [0], [-8], [8.0], [True], [], [1, 1, 1, 8], "8")]),
        ("inputs", [[["command", [9_000_000]], ["thermal", [9_000_000]]]]),
        ("inputs", [[["tactile", shape]] for shape in ([5, 2], [5, 3, 3], [5, 2, 1], [5, 2, 10**9])]),
        ("deployment.rate", [NAN, INF, -INF, 0, -40, 1e9, 10**400, "40", True, None, [40]]),
        ("deployment.hand", ["", 1, None, "x" * 5000]),
        ("deployment.joints", [[], ["a"], ["a", "b", "b"], ["a", "b", 3], "abc", ["a", "b", "c", "d"], ["j"] * 300]),
        ("deployment.action_map", [[], None, {}]),
        ("deployment.action_map.names", [["a"], ["a", "a"], ["a", "x"], []]),
        ("deployment.action_map.default", [[0.1, NAN], [0.1], [0.1, 100.0], [0.1, "0"], 0.1, [[0.1, 0.1]]]),
        ("deployment.action_map.scale", [[0.5, INF], [0.5, 0.0], [1e6, 0.5], [0.5, True], [None, 0.5]]),
        ("deployment.action_map.low", [[NAN, 0.0], [-1.0, 0.4], [2.0, 0.0], [-INF, 0.0]]),
        ("deployment.action_map.high", [[1.0, INF], [1e3, 0.4], [1.0, NAN]]),
        ("deployment.frozen", [{"b": NAN}, {"b": 1e3}, {"b": "0"}, {}, [], {"b": 0.1, "a": 0.1}, {"x": 0.1}]),
        ("deployment.links", [[], ["l", "l"], ["l"], "l"]),
        ("deployment.observe", ["agg_farce", "bool", 3]),
        ("deployment.sub_steps", [0, -5, 5.0, 10**6, NAN]),
        ("deployment.contacts", [[1], "firm", {"time_constant": NAN}, {"substeps": 2.5}, {"impedance": [0.9]}]),
        ("sha256", [1, None]),
    ],
)  # fmt: skip
def test_values_out_of_range_are_refused_with_their_place(tmp_path, place, values) -> None:
    for value in values:
        with pytest.raises(DataError, match=rf"{place.rpartition('.')[2]}|joints|tactile|default") as caught:
            _read(tmp_path, _set(contract_of(), place, value))
        text = str(caught.value)
        assert len(text) < 450, text
        assert "\n" not in text


@pytest.mark.parametrize("name", ["rate", "hand", "joints", "action_map", "frozen", "twist", "contacts"])
def test_what_a_hand_needs_must_stand_in_it(tmp_path, name) -> None:
    contract = contract_of()
    del contract["deployment"][name]
    with pytest.raises(UsageError, match=name):
        _read(tmp_path, contract)


@pytest.mark.parametrize(
    "text", ["", "[]", "null", "{", "[" * 100_000, '{"a": ' * 100_000, "1" * 5000, "\xff\xfe", "NaN", '{"inputs": 1}']
)
def test_files_that_are_no_contract_are_refused(tmp_path, text) -> None:
    path = tmp_path / "policy.onnx.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"policy\.onnx\.json"):
        PolicyContract.read(path)
    with pytest.raises(DataError, match=tmp_path.name):
        PolicyContract.read(tmp_path)


def _check_mutants(folder, cases: int) -> None:
    refused = longest = 0
    for seed in range(cases):
        contract = contract_of()
        path = folder / "policy.onnx.json"
        if seed % 2:
            path.write_bytes(damaged(json.dumps(contract).encode(), seed))
        else:
            path.write_text(json.dumps(mutate(copy.deepcopy(contract), seed)))
        try:
            found = PolicyContract.read(path)
        except BrainbenchError as error:
            refused += 1
            longest = max(longest, len(str(error)))
            continue
        numbers = [
            found.rate,
            *found.frozen.values(),
            *(n for row in astuple(found.action_map)[1:] for n in row),
        ]
        assert all(math.isfinite(number) for number in numbers)
        assert 1 <= found.rate <= 1000
        assert all(abs(number) <= 4 * math.pi for number in numbers[1:])
        assert all(0 < math.prod(shape) <= 10_000_000 for shape in found.inputs.values())
        assert found.inputs.get("proprio", (8,)) == (8,)
    assert refused > cases // 3
    assert longest < 600


def test_damaged_contracts_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 30)


@pytest.mark.slow
def test_many_damaged_contracts_are_refused_or_sound(tmp_path) -> None:
    _check_mutants(tmp_path, 500)


def _env(contacts: str = "published") -> Any:
    hand = SimpleNamespace(name="xhand1", source="xhand1")
    return SimpleNamespace(hand=hand, task=SimpleNamespace(contacts=CONTACTS[contacts]))


def test_another_version_of_the_tasks_or_another_hand_is_refused() -> None:
    with pytest.raises(DataError, match=r"'old'.*version 99.*brainbench 0\.0\.7"):
        check_fit({"task_version": 99, "provenance": {"version": "0.0.7"}}, _env(), "old")
    with pytest.raises(DataError, match="'unstated' is of version 1 of the tasks"):
        check_fit({}, _env(), "unstated")
    for described in ({"hand": "sharpa"}, {"distill": {"hand": "sharpa"}}):
        with pytest.raises(UsageError, match="'sharpa'; received 'xhand1'"):
            check_fit({"task_version": TASK_VERSION, **described}, _env(), "other")


def test_actions_counted_from_another_pose_are_refused() -> None:
    for name in ("in_palm_rotate.teacher", "in_palm_rotate.student"):
        described = stored(name)
        check_fit(described, tasks.make("in_palm_rotate", num_envs=1, threads=1, observe="force_torque"), name)
        with pytest.raises(UsageError, match=r"from \S*thumb_bend_joint = 1\.2 rad, and here 0 rad.*--config"):
            check_fit(described, tasks.make("in_palm_rotate", config="published", num_envs=1, threads=1), name)
        twice = apply_overrides(tasks.load("in_palm_rotate"), ["action_ratio=1"])
        with pytest.raises(UsageError, match=r"by \S*thumb_bend_joint = 0\.916 rad, and here 1\.832 rad"):
            check_fit(described, tasks.make(twice, num_envs=1, threads=1), name)
        with pytest.raises(UsageError, match="take the task of its training"):
            check_fit(described, tasks.make("screwdriver", num_envs=1, threads=1), name)
    with pytest.raises(DataError, match="action_map"):
        check_fit({**stored("in_palm_rotate.teacher"), "action_map": {"names": ["a"]}}, _env(), "damaged")


def test_actions_that_last_for_another_time_are_refused() -> None:
    faster = apply_overrides(tasks.load("in_palm_rotate"), ["solver.decimation=2"])
    halved = apply_overrides(tasks.load("in_palm_rotate"), ["solver.timestep=0.0025", "solver.decimation=10"])
    for name in ("in_palm_rotate.teacher", "in_palm_rotate.student"):
        with pytest.raises(UsageError, match=r"40\.?0? actions per second, and here are 100.*solver\.decimation"):
            check_fit(stored(name), tasks.make(faster, num_envs=1, threads=1), name)
    check_fit(stored("in_palm_rotate.teacher"), tasks.make(halved, num_envs=1, threads=1), "teacher")


def test_other_contacts_are_told(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        check_fit({"task_version": TASK_VERSION, "hand": "xhand1"}, _env(), "mine")
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        check_fit({"task_version": TASK_VERSION, "hand": "xhand1"}, _env("firm"), "mine")
    assert "published" in caplog.text
    assert "firm" in caplog.text


def test_a_policy_says_in_which_contacts_it_was_trained_and_earlier_ones_had_the_published() -> None:
    own = ContactModel(time_constant=0.011, impedance=(0.8, 0.9, 0.002))
    assert trained_contacts({"contacts": to_plain(asdict(own))}) == own
    assert trained_contacts({}) == CONTACTS["published"]
    for wrong in (
        {"time_constant": "1"},
        {"impedance": [1.0]},
        {"impedance": [0.9, 0.8, 1.0]},
        {"drive_scale": 0},
        [1],
    ):
        with pytest.raises(DataError):
            trained_contacts({"contacts": wrong})


def test_policies_act_in_the_contacts_that_they_were_trained_in(tmp_path: Path) -> None:
    task = tasks.load("in_palm_rotate")
    assert with_contacts_of(task, ("zero", "random")) == task
    other = str(teacher_in("published", tmp_path / "other"))
    for name, contacts in ((other, "published"), ("in_palm_rotate.teacher", "firm")):
        assert with_contacts_of(task, ("zero", name)).contacts == CONTACTS[contacts]
    own = ContactModel(time_constant=0.011)
    write_json(tmp_path / "config.json", {"contacts": asdict(own)})
    (tmp_path / "model_3.safetensors").touch()
    for path in (tmp_path, tmp_path / "model_3.safetensors"):
        assert with_contacts_of(task, [str(path)]).contacts == own
    with pytest.raises(
        UsageError, match=r"other \(published\), in_palm_rotate.teacher \(firm\).*--change contacts=firm"
    ):
        with_contacts_of(task, (other, "in_palm_rotate.teacher"))


def test_another_world_than_that_of_training_is_told(caplog: pytest.LogCaptureFixture) -> None:
    changes = ["goal.threshold=0.4", "rated_speed=false", "is_dropped=-1", "goal.start_threshold=0.5"]
    trained = apply_overrides(tasks.load("in_palm_rotate"), changes)
    described = {**stored("in_palm_rotate.teacher"), "world": json.loads(json.dumps(world_of(trained)))}
    with caplog.at_level(logging.WARNING):
        check_fit(described, tasks.make(trained, num_envs=1, threads=1), "mine")
        # Rewards and curricula are of learning alone.
        check_fit({**described, "world": world_of(tasks.load("in_palm_rotate", "careful"))}, _made(), "mine")
        assert not caplog.records
        check_fit(described, _made(), "mine")
    (record,) = caplog.records
    said = record.getMessage()
    assert "goal.threshold (trained with 0.4, here 0.1)" in said
    assert "rated_speed (trained with False, here True)" in said
    assert "dropped" not in said
    assert "start_threshold" not in said


def test_students_feel_by_the_law_of_forces_that_they_learned_with(tmp_path: Path) -> None:
    task = tasks.load("in_palm_rotate")
    for name, twist in (("own", 2.0), ("other", None)):
        write_json(tmp_path / name / "config.json", {"deployment": {"twist": twist}})
    assert with_contacts_of(task, [str(tmp_path / "own")]).taxel_twist == 2.0
    assert with_contacts_of(task, ["zero", "in_palm_rotate.student"]).taxel_twist is None
    with pytest.raises(UsageError, match=r"other learned from forces of different laws; take one at a time"):
        with_contacts_of(task, [str(tmp_path / "own"), str(tmp_path / "other")])
    write_json(tmp_path / "own" / "config.json", {"deployment": {"twist": [2]}})
    with pytest.raises(DataError, match="twist"):
        with_contacts_of(task, [str(tmp_path / "own")])


def _made() -> Any:
    return tasks.make("in_palm_rotate", num_envs=1, threads=1)


def test_a_student_that_reads_other_taxels_is_refused() -> None:
    # A convolution would find the taxels of the palm where it learned those of the finger tips.
    described = stored("in_palm_rotate.student")
    for senses, told in (({"observe": "force_torque", "placement": "tips"}, "100, 6"), ({"observe": "none"}, "none")):
        env = tasks.make("in_palm_rotate", num_envs=1, threads=1, **senses)
        with pytest.raises(UsageError, match=rf"tactile \[5, 199, 6\], and the environment gives .*{told}"):
            check_fit(described, env, "student")


def test_a_hand_whose_file_was_changed_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "hand.xml"

    def env(text: str) -> Any:
        file.write_text(text)
        return SimpleNamespace(hand=hands.load(str(file)))

    jaws = GALLERY["coupled-jaws"].text
    described = {"hand_physics": env(jaws).hand.physics}
    with caplog.at_level(logging.WARNING):
        check_hand(described, env(f"<!-- a remark -->{jaws}"), "mine")
        check_hand({}, env(jaws), "earlier")
    assert described["hand_physics"]
    assert not caplog.records
    for old, new in (
        ('damping="1', 'damping="2'),
        ('kp="', 'kp="1'),
        ('mass=".03"', 'mass=".04"'),
        ('mass=".03"', 'mass=".03" friction=".9"'),
    ):
        assert old in jaws
        with caplog.at_level(logging.WARNING):
            check_hand(described, env(jaws.replace(old, new)), "mine")
        assert "'mine' was trained" in caplog.text
        caplog.clear()


def test_a_contract_takes_the_rows_of_its_map_of_actions() -> None:
    rows: Any = {"default": (0.0, 0.1), "scale": (0.5, 0.4), "low": (-1.0, -0.5), "high": (1.0, 0.5)}
    contract = PolicyContract({"proprio": (6,)}, 40.0, "paper", ("a", "b"), ("b", "a"), rows, {})
    assert contract.moved == contract.action_map.names == ("b", "a")
    assert contract.action_map.targets(np.array([1.0, -2.0])).tolist() == [0.5, -0.5]
    with pytest.raises(ValueError, match="'scale' has 1 numbers for 2 joints"):
        replace(contract, action_map=rows | {"scale": (0.5,)})
