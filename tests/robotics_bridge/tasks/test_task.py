"""Parts of a task that would be ignored, or would change it in silence, are refused by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.physics import Geometry
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.goals import SteppingRotation, TimedRotation
from robotics_bridge.tasks.settings import TeacherSettings
from robotics_bridge.tasks.task import ActuatorRandomisation, Ending, ObjectRandomisation, Placement, Push, Success


def _changed(**changes: Any) -> tasks.Task:
    return replace(tasks.load("in_palm_rotate"), **changes)


@pytest.mark.parametrize(
    ("changes", "suggested"),
    [
        ({"success": Success(metric="goal")}, "goals"),
        ({"success": Success(metric="turn")}, "turned"),
        ({"success": Success(metric="contact")}, "goals"),
        ({"starts": "grasp"}, "grasps"),
        ({"command": ("onn",)}, "on"),
        ({"goal_terms": ("angel",)}, "angle"),
        ({"distances_in": "priv_obj_prop"}, "priv_obj_props"),
        ({"auxiliary": ("aux_objsize",)}, "aux_obj_size"),
        ({"carriage": {"w": ((-0.1, 0.1), 1.0, 1.0, 1.0)}}, "'x'"),
    ],
)
def test_names_within_a_task_are_known(changes, suggested) -> None:
    with pytest.raises(UsageError, match=f"'in_palm_rotate'.*{suggested}|{suggested}"):
        _changed(**changes)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (tasks.Reward(1.0, terms.near_surface, {"nearestk": 1, "sigma": 0.1}), "'nearestk'.*'nearest_k'"),
        (tasks.Reward(1.0, terms.near_surface, {"nearest_k": 1}), "'sigma'"),
        (tasks.Reward(1.0, lambda m, scale: scale, {"scael": 1}), "'scael'.*'scale'"),
        (tasks.Reward(1.0, lambda m: m, {"m": 1}), "'m'"),
        (tasks.Reward(1.0, lambda: 0), "too many"),
        (tasks.Reward(1.0, "work"), "'work'"),
        (tasks.Reward(1.0, terms.ended, {"names": ("obj_droped",)}), "'obj_droped'.*'obj_dropped'"),
        (Ending(terms.below, {"hight": 0.4}), "'hight'.*'height'"),
    ],
)
def test_terms_are_called_by_their_parameters(part, message) -> None:
    kind = "rewards" if isinstance(part, tasks.Reward) else "endings"
    rotate = tasks.load("in_palm_rotate")
    with pytest.raises(UsageError, match=f"{kind[:-1]} 'mine' of task 'in_palm_rotate'.*{message}|{message}.*'mine'"):
        replace(rotate, **{kind: {**getattr(rotate, kind), "mine": part}})


def test_terms_with_defaults_or_any_parameters_are_taken() -> None:
    given = {"a": tasks.Reward(1.0, lambda m, k=1: k), "b": tasks.Reward(1.0, lambda m, **rest: 0, {"any": 2})}
    assert _changed(rewards=given).rewards == given


def test_turns_are_counted_about_an_axis() -> None:
    with pytest.raises(UsageError, match="turn_axis"):
        _changed(success=Success(metric="turned"))
    assert _changed(success=Success(metric="turned"), turn_axis=(0.0, 0.0, 1.0)).turns


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *((ActuatorRandomisation, name) for name in ("stiffness", "damping", "strength", "position_bias", "deadband",
                                                     "backlash", "kick_ratio")),
        *((ObjectRandomisation, name) for name in ("friction", "mass_offset", "size")),
        *((Push, name) for name in ("x", "y", "z", "interval")),
        *((Placement, name) for name in ("x", "y", "yaw")),
        (TimedRotation, "tilt"), (SteppingRotation, "deadline"),
        (TeacherSettings, "std_range"), (TeacherSettings, "learning_rate_range"),
    ],
)  # fmt: skip
def test_ranges_are_two_numbers_in_order(kind, name) -> None:
    with pytest.raises(UsageError, match=f"{name}.* is a range"):
        kind(**{name: (0.002, 0.001)})


@pytest.mark.parametrize("value", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (1.0, 0, 0), "wxyz"])
def test_orientations_have_a_length(value) -> None:
    makers = (
        lambda: Placement(quaternion=value),
        lambda: Geometry(kind="sphere", size=(0.01,), quaternion=value),
        lambda: _changed(hand_poses={"xhand1": ((0, 0, 0.5), value)}),
    )
    for make in makers:
        with pytest.raises(UsageError, match=r"quaternion|hand_poses"):
            make()


def test_a_carriage_has_a_range_and_positive_numbers() -> None:
    for slide in (((0.1, -0.1), 1.0, 1.0, 1.0), ((-0.1, 0.1), -1.0, 1.0, 1.0), ((-0.1, 0.1), 1.0, np.nan, 1.0)):
        with pytest.raises(UsageError, match=r"carriage of a task \(x\)"):
            _changed(carriage={"x": slide})


@pytest.mark.parametrize("name", tasks.list_tasks())
@pytest.mark.parametrize("config", ["default", "published"])
def test_tasks_of_the_package_keep_their_numbers(name, config) -> None:
    task = tasks.load(name, config)
    assert all(abs(float(np.linalg.norm(pose[1])) - 1) < 1e-6 for pose in task.hand_poses.values())
    assert replace(task) == task
