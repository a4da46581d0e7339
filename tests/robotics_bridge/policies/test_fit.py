"""A stored policy is held against the environment that it is to act in."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_plain, write_json
from robotics_bridge import hands, tasks
from robotics_bridge.policies.contract import trained_contacts
from robotics_bridge.policies.fit import check_fit, check_hand, with_contacts_of
from robotics_bridge.policies.shipped import stored
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.settings import CONTACTS, ContactModel
from robotics_bridge.tasks.task import TASK_VERSION
from tests.factories.policies import teacher_in
from tests.factories.robot_surfaces import MJCF


def _env(contacts: str = "published") -> Any:
    hand = SimpleNamespace(name="xhand1", path=None)
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

    described = {"hand_physics": env(MJCF).hand.physics}
    with caplog.at_level(logging.WARNING):
        check_hand(described, env(f"<!-- a remark -->{MJCF.strip()}"), "mine")
        check_hand({}, env(MJCF), "earlier")
    assert described["hand_physics"]
    assert not caplog.records
    for old, new in (
        ('damping="0', 'damping="1'),
        ('kp="', 'kp="1'),
        ('mass="0.05', 'mass="0.06'),
        ('on="0.8', 'on="0.9'),
    ):
        assert old in MJCF
        with caplog.at_level(logging.WARNING):
            check_hand(described, env(MJCF.replace(old, new)), "mine")
        assert "'mine' was trained" in caplog.text
        caplog.clear()
