"""Firm contacts: less overlap, the same motion of a free finger, and the same rate of drives and senses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.tasks.goals import SteppingRotation
from robotics_bridge.tasks.hot_ball import ThermalSettings
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.settings import CONTACTS, ContactModel, TeacherSettings

TASK = tasks.load("in_palm_rotate")


def _make(contacts: str, **changes: object) -> Env:
    quiet = replace(TASK, contacts=CONTACTS[contacts], actuators=None, push=None, **changes)  # type: ignore[arg-type]
    return tasks.make(quiet, num_envs=2, threads=1, seed=1)


def test_a_block_at_rest_sinks_less_into_the_palm() -> None:
    depth = {}
    for name in CONTACTS:
        env = _make(name)
        for _ in range(40):
            env.step(torch.zeros(2, env.num_actions))
        state = env.simulation.state
        depth[name] = -float(state.contact_distance.numpy()[: int(state.contact_count.numpy()[0])].min())
    # At rest the overlap goes with the square of the time constant: (6 / 20)².
    assert 0 < depth["firm"] < 0.2 * depth["published"]


def test_a_free_finger_moves_as_before_and_is_observed_as_often() -> None:
    ways = []
    for name in CONTACTS:
        env = _make(name, placement=replace(TASK.placement, x=(0.5, 0.5)), endings={}, rewards={})
        columns, way = env.state.actuators.qpos_columns, []
        for _ in range(20):
            env.step(torch.full((2, env.num_actions), 0.3))
            way.append(env.simulation.qpos[:, columns].clone())
        assert env.simulation.timestep == pytest.approx(0.005)
        ways.append(torch.stack(way))
    moved = (ways[0][-1] - ways[0][0]).abs().max()
    assert moved > 0.2
    # Links and gravity weigh a little more beside weaker drives.
    assert (ways[0] - ways[1]).abs().max() < 0.03


@pytest.mark.parametrize("name", tasks.list_tasks())
def test_tasks_are_firm_by_default_and_published_where_they_say_so(name: str) -> None:
    assert tasks.load(name).contacts == CONTACTS["firm"]
    assert tasks.load(name, "published").contacts == CONTACTS["published"] == ContactModel()


def test_words_name_contacts_and_their_numbers() -> None:
    assert apply_overrides(TASK, ["contacts=published"]).contacts == CONTACTS["published"]
    assert apply_overrides(TASK, ["contacts=firm", "contacts.substeps=3"]).contacts.substeps == 3
    for word, culprit in (
        ("contacts=firn", "did you mean 'firm'"), ("contacts.substeps=0", "received 0"),
        ("contacts.impedance=0.9,0.8,0.001", "two shares"), ("contacts.time_constant=0.001", "more contacts.substeps"),
    ):  # fmt: skip
        with pytest.raises(UsageError, match=culprit):
            apply_overrides(TASK, [word])


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (ThermalSettings, "hot", 10.0), (ThermalSettings, "emissivity", 3.0), (ThermalSettings, "ball", "aluminum"),
        (SteppingRotation, "start_threshold", 0.01), (TeacherSettings, "learning_rate", 0.1),
    ],
)  # fmt: skip
def test_numbers_of_a_part_fit_one_another(kind, name, value) -> None:
    expected = {"hot": "hotter", "ball": "aluminium", "learning_rate": "learning rate"}.get(name, name)
    with pytest.raises(UsageError, match=expected):
        kind(**{name: value})
