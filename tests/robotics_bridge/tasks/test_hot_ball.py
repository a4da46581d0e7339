"""The published configurations equal the thesis (tables by number) and the settings released with it."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks


def test_hot_ball_is_that_of_section_4_6_3() -> None:
    from robotics_bridge.tasks.hot_ball import BALLS, DIAMETER, SIDE, ThermalSettings

    task, thermal = tasks.load("hot_ball", "published"), ThermalSettings()
    assert (SIDE, BALLS, DIAMETER, task.copies, task.episode) == (0.5, 8, 0.08, 8, 20.0)
    assert (thermal.ambient, thermal.hot, thermal.margin) == (22.0, 45.0, 0.12)
    assert thermal.threshold == pytest.approx(42.24)


def test_the_latch_needs_the_heat_of_the_hot_ball() -> None:
    from robotics_bridge.tasks.hot_ball import ThermalSettings, progress

    thermal = ThermalSettings()
    reading = torch.tensor([10.0, 22.0, 33.5, 42.3, 60.0])
    assert progress(reading, thermal).tolist() == pytest.approx([0.0, 0.0, 0.5, 0.8826, 1.0], abs=1e-4)
    env = tasks.make("hot_ball", num_envs=2, threads=1)
    thermometers: Any = env.state.task_state
    assert (thermometers.temperature() == 22.0).all()
    assert env.observations["thermal"].abs().max() < 1e-5
    env.step(torch.zeros(2, env.num_actions))
    assert not thermometers.latched.any()
    assert env.state.episode.metric.tolist() == [0.0, 0.0]
    with pytest.raises(UsageError, match=r"received 10\.0 and 22\.0"):
        ThermalSettings(hot=10.0)


@pytest.mark.slow
def test_a_hand_that_holds_the_hot_ball_succeeds_by_default_alone() -> None:
    from robotics_bridge.tasks.hot_ball import ThermalSettings, Thermometers

    env = tasks.make("hot_ball", num_envs=2, seed=0, threads=1)
    thermometers: Any = env.state.task_state
    published = Thermometers(env.state, ThermalSettings(), chooses=False)
    slides = [env.action_names.index(f"carriage_{axis}") for axis in "xyz"]
    scale = torch.tensor(env.action_map.scale)[slides]
    middle = env.state.contacts.tip_links[list(env.model.tips).index("right_hand_mid_link2")]
    at, pressed, held = torch.zeros(2, 3), torch.zeros(2), torch.zeros(2)
    for step in range(250):
        # The middle finger follows the ball from above, and is pressed down once it is there.
        way = env.state.target_pose[:, :3] - env.state.simulation.pose[:, middle, :3]
        over = way[:, :2].norm(dim=1) < 0.02
        pressed = torch.where(over, pressed + 0.0015 * ~thermometers.touching, torch.zeros(2)) if step > 60 else pressed
        way[:, 2] += torch.where(over, 0.075 - pressed.clamp(max=0.05), torch.tensor(0.12))
        at = at + 0.2 * way.clamp(-0.05, 0.05) * (step > 60)
        action = torch.zeros(2, env.num_actions)
        action[:, slides] = at / scale
        _, _, _, _, info = env.step(action)
        published.after_physics_step(env.step_dt)
        published.update_latch(env.step_dt)
        held += env.step_dt * thermometers.touching
    assert (held > 3).all()
    assert (info["metric"] > 0).float().mean() >= 0.75
    assert not published.latched.any()
