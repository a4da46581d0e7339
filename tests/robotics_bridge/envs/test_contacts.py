"""Options, seeds, actions and states that do not fit are refused; one seed gives one course of events."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.hands import load
from robotics_bridge.hands.observations import OBSERVATIONS, observation_type, observe, sensors_for
from robotics_bridge.hands.surface import cast_grid
from robotics_bridge.tasks.task import ObjectRandomisation


def _course(env, seed: int) -> list[torch.Tensor]:
    env.seed(seed)
    observations = env.reset()
    actions = torch.Generator().manual_seed(0)
    seen = [value.clone() for value in observations.values()]
    for _ in range(4):
        step = env.step(0.5 * torch.randn(2, env.num_actions, generator=actions))
        seen += [*(value.clone() for value in step[0].values()), step[1].clone()]
    return seen


def test_one_seed_gives_one_course_with_noisy_touch_too() -> None:
    options = {"num_envs": 2, "observe": "depth", "noisy": True, "resolution": "low", "threads": 1}
    env, other = (tasks.make("in_palm_rotate", seed=seed, **options) for seed in (0, 9))
    first = _course(env, 5)
    for again in (_course(env, 5), _course(other, 5)):
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, _course(env, 6), strict=True))
    # A kept state brings the seed of its noise along.
    action, kept = torch.zeros(2, env.num_actions), env.state_dict()
    fresh = tasks.make("in_palm_rotate", seed=3, **options)
    fresh.load_state_dict(kept)
    for one in (env, fresh):
        one.reset()
    assert torch.equal(env.step(action)[0]["tactile"], fresh.step(action)[0]["tactile"])


def test_readings_have_the_shape_of_their_type() -> None:
    layout = load("xhand1").layout("low", "tips")
    for name, wrong in (("force", ()), ("bool", (6,)), ("depth", (2,)), ("force", (3,))):
        readings = {link: torch.zeros(2, len(probes), *wrong) for link, probes in layout.items()}
        with pytest.raises(UsageError, match="shape"):
            observe(name, readings, layout)
    swapped = {link: torch.zeros(2, 6, len(probes)) for link, probes in layout.items()}
    with pytest.raises(UsageError, match="shape"):
        observe("force", swapped, layout)
    with pytest.raises(UsageError, match="at least one link"):
        observe("force", {}, {})
    assert observe("depth", {link: torch.zeros(0, len(p)) for link, p in layout.items()}, layout).shape[0] == 0


def test_settings_of_sensors_are_known_and_layouts_hold_probes() -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match="did you mean 'stiffness'"):
        sensors_for("force", hand.layout("low", "tips"), stifness=3)
    for layout in ({}, {hand.palm: np.zeros((1, 3))}):
        with pytest.raises(UsageError, match="layout"):
            hand.with_probes(layout)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("facing", (0, 0, 0)),
        ("facing", (np.nan, 0, 1)),
        ("extent", -1.0),
        ("extent", np.nan),
        ("rows", 0),
        ("rows", 1.5),
    ],
)  # fmt: skip
def test_grids_are_cast_by_numbers(name, value) -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match=name):
        cast_grid(hand.model, hand.palm, **{"rows": 2, "columns": 2, "facing": (1, 0, 0), "radius": 0.004, name: value})


def _make(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def _actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def _calm(**changes: Any) -> Any:
    """The rotation task without anything random but where the object lies."""
    still = {"actuators": None, "push": None, "object_changes": ObjectRandomisation()}
    return replace(tasks.load("in_palm_rotate", "published"), **(still | changes))


def test_without_touch_no_tactile_sensor_is_built() -> None:
    env = _make(1)
    assert env.touch is None
    assert "tactile" not in env.observations


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_every_observation_type_feels_the_objects_of_a_task(kind: str) -> None:
    # Blocks and cylinders share one batch: each has the other's solid as a grain.
    env = _make(2, observe=kind, placement="tips", resolution="low")
    observations = env.step(torch.zeros(2, env.num_actions))[0]
    assert ("tactile" in observations) == (observation_type(kind).sensor is not None)
    assert all(value.isfinite().all() for value in observations.values())


@pytest.mark.parametrize("kind", ["force_torque", "agg_bool", "agg_force"])
def test_touch_is_what_the_sensors_of_the_hand_read(kind: str) -> None:
    from robotics_bridge.sensors import SensorSuite

    # Springs remember what they held, which sensors that come later cannot know.
    knobs: dict = {"total": "engine"} if kind == "force_torque" else {}
    env = _make(2, observe=kind, placement="hand", resolution="low", knobs=knobs)
    assert env.touch is not None
    taxels = env.hand.layout("low", "hand")
    suite = SensorSuite(env.simulation.engine.scene, sensors_for(kind, taxels, track=("object",), **knobs), num_envs=2)
    suite.reset()
    env.reset()
    for a in _actions(env, 8):
        env.step(a)
    suite.update(env.simulation.state, 0.005)
    # The last physics step of the control step is the state that is still there, but for the refreshed poses.
    env.simulation.engine.forward()
    suite.update(env.simulation.state, 0.005)
    env.touch.update(env.simulation.state, 0.005, 4)  # type: ignore[union-attr]
    expected = observe(kind, {name: suite.read(name) for name in taxels}, taxels)
    assert torch.allclose(env.observations["tactile"][:, -1].flatten(1), expected, atol=1e-6)
    assert env.observations["tactile"].shape[1:] == (
        5,
        expected.shape[1] // observation_type(kind).channels,
        observation_type(kind).channels,
    )


def test_touch_is_felt_when_the_object_lies_on_the_palm() -> None:
    env = _make(2, _calm(), observe="force_torque", placement="palm", resolution="med")
    assert env.observations["tactile"].abs().sum() == 0
    for _ in range(20):
        env.step(torch.zeros(2, 5))
    reading = env.observations["tactile"]
    assert (reading[..., 0].sum(dim=(1, 2)).abs() > 0).all()
    before = reading[1].clone()
    env.reset(torch.tensor([True, False]))
    assert env.observations["tactile"][0].abs().sum() == 0
    assert torch.equal(env.observations["tactile"][1], before)
