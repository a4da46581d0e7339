"""A student from its configuration alone."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import read_json, write_json
from robotics_bridge import tasks
from robotics_bridge.policies.contract import trained_contacts
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.policies.training.students import calibrated, is_done, train_student
from robotics_bridge.tasks.settings import CONTACTS
from robotics_bridge.tasks.task import TASK_VERSION
from tests.factories.policies import teacher_in
from tests.factories.task_worlds import Follower, TouchWorld


def _config(**changes) -> DistillConfig:
    plain = {"task": "follow", "placement": "tips", "resolution": "low", "encoder": "zhuang-small"}
    return DistillConfig(**{**plain, **changes})


def test_a_networks_hand_calibration_is_measured_while_the_teacher_acts_and_then_kept(tmp_path) -> None:
    config = calibrated(_config(), TouchWorld(16), Follower(), tmp_path)
    found = config.encoder_settings["calibration"]
    # Two taxels of a tip carry forces of 0.2 N times a standard normal aim, in sites of their own: rms of three axes.
    assert found["force"] == pytest.approx(0.2 / 3**0.5, rel=0.25)
    assert config.tactile is not None
    assert config.tactile.calibration.force == found["force"]
    write_json(tmp_path / "config.json", {"distill": asdict(config)})
    again = calibrated(_config(), TouchWorld(16, seed=5), Follower(), tmp_path)
    assert again == config


def test_learned_encoders_and_given_calibrations_are_left_alone(tmp_path) -> None:
    for config in (
        _config(encoder="mlp"), DistillConfig(task="follow", observe="none"),
        _config(encoder_settings={"calibration": {"force": 2.0}}),
    ):  # fmt: skip
        assert calibrated(config, TouchWorld(2), Follower(), tmp_path) is config


def test_a_teacher_that_touches_nothing_is_mentioned(tmp_path, caplog) -> None:
    class Numb(TouchWorld):
        def _observe(self):
            found = super()._observe()
            found["tactile"] = found["tactile"] * 0
            return found

    with caplog.at_level(logging.WARNING):
        config = calibrated(_config(), Numb(2), Follower(), tmp_path)
    assert config.encoder_settings["calibration"]["force"] == 0.5
    assert "touched nothing" in caplog.text


def test_a_student_needs_a_teacher(tmp_path) -> None:
    with pytest.raises(UsageError, match=r"teacher: .*brainbench policy train"):
        train_student(_config(), tmp_path)


@pytest.mark.parametrize(
    ("teacher", "changes", "contacts"),
    [
        ("published", {}, "published"),
        ("firm", {}, "firm"),
        ("published", {"contacts": "firm"}, "firm"),
        ("firm", {"variant": "published"}, "published"),
    ],
)
def test_a_student_is_taught_in_the_contacts_of_its_teacher_unless_told_otherwise(
    tmp_path, teacher, changes, contacts
) -> None:
    config = DistillConfig(
        task="in_palm_rotate", teacher=str(teacher_in(teacher, tmp_path / "teacher")), observe="none", hidden=(8,),
        num_envs=2, steps_per_env=2, iterations=1, epochs=1, **changes,
    )  # fmt: skip
    train_student(config, tmp_path / "run", episodes=0)
    described = read_json(tmp_path / "run" / "config.json")
    assert described["distill"]["contacts"] == contacts
    assert (described["deployment"]["twist"] is None) == (config.variant == "default")
    assert trained_contacts(described) == trained_contacts(described["deployment"]) == CONTACTS[contacts]


def test_a_student_is_done_once_the_very_one_was_evaluated_after_its_last_iteration(tmp_path) -> None:
    config = DistillConfig(task="in_palm_rotate", teacher="in_palm_rotate.teacher", observe="none", num_envs=2)
    stored = replace(config.resolved(tasks.load("in_palm_rotate").student), contacts="firm")
    assert not is_done(config, tmp_path)
    write_json(tmp_path / "config.json", {"distill": asdict(stored), "task_version": TASK_VERSION})
    for iterations, done in ((stored.iterations, True), (3, False)):
        write_json(tmp_path / "evaluation.json", [{"seed": 1000, "success": [0.0], "iterations": iterations}])
        assert is_done(config, tmp_path) is done
    assert is_done(config, tmp_path, stop_at=3)
    assert not is_done(config, tmp_path, stop_at=4)
    write_json(tmp_path / "evaluation.json", [{"seed": 1000, "success": [0.0]}])
    assert is_done(config, tmp_path)
    changes = ({"iterations": 3}, {"steps_per_env": 3}, {"contacts": "published"}, {"teacher": "runs/other"})
    assert not any(is_done(replace(config, **change), tmp_path) for change in changes)
    # What another version of the tasks trained is no student of this one.
    write_json(tmp_path / "config.json", {"distill": asdict(stored), "task_version": TASK_VERSION - 1})
    with pytest.raises(DataError, match=r"version 2 of the tasks.*train it again"):
        is_done(config, tmp_path)


def test_resampled_time_is_for_readings_as_often_as_the_encoder_assumes(tmp_path, monkeypatch) -> None:
    task = tasks.load("in_palm_rotate")
    slow = replace(task, solver=replace(task.solver, timestep=0.004))
    monkeypatch.setattr(tasks, "load", lambda name, variant: slow)
    config = _config(task="in_palm_rotate", teacher="in_palm_rotate.teacher", encoder_settings={"time": "resampled"})
    with pytest.raises(UsageError, match=r"every 0\.005 s; those of 'in_palm_rotate' come every 0\.004 s"):
        train_student(config, tmp_path)
