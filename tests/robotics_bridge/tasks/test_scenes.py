"""Compiled scenes of tasks: what a task adds to the file of a hand is as the task says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robotics_bridge import hands, tasks
from robotics_bridge.tasks.scenes import TaskModel, build

LEAKS = (
    '<general ctrllimited="true"/>', '<general gear="3" dyntype="filter"/>', '<geom contype="0" conaffinity="0"/>',
    '<geom mass="2" margin=".01"/>', '<joint damping="3" stiffness="2"/>', '<geom friction=".1 .1 .1" solref=".1 1"/>',
)  # fmt: skip
OWN = '<geom class="hand" type="box" size=".006 .013 .005" pos="0 .014 0" mass=".015"/>'
ADDED = (
    "body_mass", "body_inertia", "geom_contype", "geom_conaffinity", "geom_friction", "geom_solref", "geom_margin",
    "actuator_gear", "actuator_dyntype", "actuator_ctrllimited", "actuator_forcerange", "dof_damping", "jnt_stiffness",
)  # fmt: skip


def _model(path: Path, default: str, task: str) -> TaskModel:
    """The model of a task for a hand whose file states a main default that no part of the hand has."""
    undone = '<geom contype="1" conaffinity="1" friction="1 .005 .0001" solref=".02 1" margin="0"/>'
    hinge = 'class="hand" axis="1 0 0" range="0 1.5"'
    fingers = "".join(
        f'<body name="{name}_base" pos="{x} .03 0"><joint name="{name}_bend" {hinge}/>{OWN}'
        f'<body name="{name}_tip" pos="0 .033 0"><joint name="{name}_curl" {hinge}/>{OWN}'
        "</body></body>"
        for name, x in (("near", -0.02), ("mid", 0.0), ("far", 0.02))
    )
    drives = "".join(
        f'<position class="hand" joint="{name}_{part}" kp="2" kv=".1" ctrlrange="0 1.5"/>'
        for name in ("near", "mid", "far")
        for part in ("bend", "curl")
    )
    path.write_text(
        f'<mujoco model="hand"><compiler angle="radian" autolimits="true"/><default>{default}'
        f'<default class="hand">{undone}'
        '<joint damping="0" stiffness="0"/><general gear="1" dyntype="none"/></default></default><worldbody>'
        f'<body name="palm" pos="0 0 .2"><geom class="hand" type="box" size=".03 .03 .01" mass=".2"/>{fingers}</body>'
        f"</worldbody><actuator>{drives}</actuator></mujoco>"
    )
    return build(tasks.load(task), hands.load(path))


@pytest.mark.parametrize("task", ["in_hand_repose", "hot_ball"])
def test_defaults_of_a_hand_file_do_not_reach_what_a_task_adds(tmp_path, task) -> None:
    plain = _model(tmp_path / "plain.xml", "", task).models[0]
    for number, default in enumerate(LEAKS):
        model = _model(tmp_path / f"{number}.xml", default, task).models[0]
        for name in ADDED:
            np.testing.assert_array_equal(getattr(model, name), getattr(plain, name), err_msg=f"{name} under {default}")
