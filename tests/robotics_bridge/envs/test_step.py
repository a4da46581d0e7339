"""Tasks as data: registry, goals, objects, scenes, step, thermometers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.envs import step
from robotics_bridge.envs.step import step_context
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.scenes import build
from robotics_bridge.tasks.task import ObjectRandomisation, Task
from tests.factories.task_worlds import calm_task, make_env, random_actions


def test_the_carriage_moves_no_faster_than_an_arm() -> None:
    task = tasks.load("hot_ball")
    env = tasks.make(task, num_envs=2, threads=1)
    slides = [env.action_names.index(f"carriage_{axis}") for axis in "xyz"]
    targets = env.state.actuators.target
    before = targets[:, slides].clone()
    env.step(torch.full((2, env.num_actions), 2.0))
    most = task.carriage_speed * env.step_dt
    assert (targets[:, slides] - before).flatten().tolist() == pytest.approx([most] * 6)
    # As high as published, counted from a lower start.
    published = tasks.load("hot_ball", "published")
    reach = [t.hand_poses["xhand1"][0][2] + np.array(t.carriage["z"][0]) for t in (task, published)]
    assert reach[0] == pytest.approx(reach[1])


def test_groups_have_the_sizes_of_table_4_7() -> None:
    env = make_env(3)
    joints, actions, tips = 12, 5, 5
    assert env.observation_shapes == {
        "proprio": (2 * joints + actions,), "command": (1,), "goal": (1,),
        "priv_proprio": (2 * joints + actions + 3 * tips,),
        "priv_obj_state": (3 + 6 + 3 + 3,), "priv_obj_props": (2 + tips,), "aux_obj_size": (3,), "aux_goal_dist": (1,),
    }  # fmt: skip
    assert (env.step_dt, env.max_episode_length) == (0.025, 400)
    observations, reward, terminated, truncated, info = env.step(torch.zeros(3, actions))
    assert all(value.dtype == torch.float32 and value.isfinite().all() for value in observations.values())
    assert reward.shape == terminated.shape == truncated.shape == info["diverged"].shape == (3,)


def test_targets_at_rated_speed_are_those_that_deployment_sends() -> None:
    env = make_env(2, task=calm_task(rated_speed=True))
    moved, limits = env.state.moved, SafetyLimits.of_hand(env.hand, env.state.model.moved)
    target = env.state.actuators.target
    for action in random_actions(env, 6):
        before, wanted = target[:, moved].clone().numpy(), env.action_map.targets(action.numpy())
        env.step(action)
        assert np.abs(wanted - before).max() > 0.025 * limits.speed.max()
        np.testing.assert_allclose(target[:, moved], limits.limit(wanted, before, env.step_dt), atol=1e-6)


def test_an_environment_that_diverges_is_reset_and_counted_and_the_others_are_unharmed() -> None:
    one, two = make_env(3, seed=5), make_env(3, seed=5)
    for env in (one, two):
        for a in random_actions(env, 3):
            env.step(a)
    two.simulation.engine.data[1].qpos[:] = np.nan
    action = random_actions(one, 1, seed=9)[0]
    _, _, _, _, _ = one.step(action)
    observations, reward, terminated, truncated, info = two.step(action)
    assert info["diverged"].tolist() == [False, True, False]
    assert bool(terminated[1])
    assert not bool(truncated[1])
    assert float(reward[1]) == 0.0
    assert all(value.isfinite().all() for value in observations.values())
    for env in (0, 2):
        assert torch.equal(one.simulation.qpos[env], two.simulation.qpos[env])
    assert two.statistics()["diverged"] == 1.0
    two.step(action)
    assert two.simulation.qpos.isfinite().all()


def test_episodes_end_when_their_time_is_up_and_say_so() -> None:
    env = make_env(2, calm_task(episode=0.1))
    flags = [env.step(torch.zeros(2, 5)) for _ in range(4)]
    assert [bool(step[3].all()) for step in flags] == [False, False, False, True]
    assert not any(bool(step[2].any()) for step in flags)
    assert env.episode_length_buf.tolist() == [0, 0]
    assert env.statistics()["length"] == 4.0


def test_actions_map_to_targets_within_the_joints_limits() -> None:
    env = make_env(1, config="published")
    low, high = np.array(env.action_map.low), np.array(env.action_map.high)
    targets = env.action_map.targets(np.array([1.0, 1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(targets, np.clip(0.5 * (high - low), low, high))
    assert (env.action_map.targets(np.full(5, -9.0)) == low).all()


def test_an_action_beyond_the_limit_counts_as_the_limit_and_moves_the_same_joints() -> None:
    far, near = make_env(2, calm_task(action_limit=100.0)), make_env(2, calm_task(action_limit=100.0))
    free = make_env(2, calm_task())
    for env, size in ((far, 1e9), (near, 100.0), (free, 1e9)):
        env.reset()
        env.step(torch.full((2, env.num_actions), -size))
    assert far.observations["proprio"][:, -5:].unique().tolist() == [-100.0]
    assert free.observations["proprio"][:, -5:].unique().tolist() == [-1e9]
    assert torch.equal(far.simulation.qpos, near.simulation.qpos)
    assert torch.equal(far.simulation.qpos, free.simulation.qpos)
    with pytest.raises(UsageError, match=r"action_limit .* received 0"):
        calm_task(action_limit=0.0)


@pytest.mark.shared
@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_grasps_are_sought_as_released(reference: Path, hand: str) -> None:
    yaml = pytest.importorskip("yaml")
    from robotics_bridge.envs.step import SETTINGS
    from robotics_bridge.tasks.turning import POSES, REST

    c = yaml.safe_load((reference / "tasks" / f"screwdrivers_{hand}.yaml").read_text())
    g, robot, ours = c["grasp_generation"], c["scene_options"]["robot"], SETTINGS[hand]
    assert (ours.count, ours.perturb, ours.near_fingers, ours.near, ours.max_penetration, ours.max_displacement) == (
        g["num_grasps"], g["perturb_range"], g["required_num_surface_distance_fingers"],
        g["surface_distance_threshold"], g["max_penetration"], g["max_displacement"],
    )  # fmt: skip
    assert POSES[hand][0] == pytest.approx(robot["default_root_pos"])
    assert POSES[hand][1] == pytest.approx(robot["default_root_quat"])
    rest = {name: angle for name, angle in robot["default_dofs_pos"].items() if angle}
    assert REST[hand] == pytest.approx(rest)


def test_sampled_grasps_hold_without_any_action() -> None:
    task = replace(tasks.load("screwdriver"), push=None, object_changes=ObjectRandomisation())
    env = tasks.make(task, num_envs=8, threads=1)
    start = env.object_pose[:, 0, :3].clone()
    # In published terms: three finger tips nearer than 2 cm, and the tool does not move by a centimetre.
    assert ((env.state.contacts.surface_distance < 0.02).sum(dim=1) >= 3).all()
    for _ in range(20):
        env.step(torch.zeros(8, env.num_actions))
    moved = (env.object_pose[:, 0, :3] - start).norm(dim=1)
    assert float(moved.quantile(0.8)) < 0.01
    assert float(terms.alignment(step_context(env.state), (0.0, 1.0, 0.0)).median()) > 0.98


def test_grasps_of_another_friction_or_solver_are_sampled_anew(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    task, hand, sampled = tasks.load("screwdriver"), hands.load("xhand1"), []

    def sample(task: Task, *others: Any) -> dict[str, np.ndarray]:
        sampled.append((task.friction, task.solver.timestep))
        return {"joints": np.zeros((16, 12)), "target": np.zeros((16, 12)), "object": np.zeros((16, 7))}

    monkeypatch.setattr(step, "sample", sample)
    for changes in ([], ["friction=0.8"], ["solver.timestep=0.004"], [], ["friction=0.8"]):
        changed = apply_overrides(task, changes)
        step.grasps_for(changed, hand, build(changed, hand))
    assert sampled == [(1.0, 0.005)] * 4 + [(0.8, 0.005)] * 4 + [(1.0, 0.004)] * 4


def test_a_seed_fixes_what_is_drawn_once_too() -> None:
    changes = ObjectRandomisation(friction=(0.5, 2.0), mass_offset=(0.0, 0.1), each_reset=False)
    found = []
    for first in (0, 7):
        env = make_env(4, calm_task(object_changes=changes), seed=first)
        env.seed(1)
        env.reset()
        found.append(torch.stack((env.state.episode.friction, env.state.episode.mass)))
    assert torch.equal(*found)
    env.reset()
    assert torch.equal(torch.stack((env.state.episode.friction, env.state.episode.mass)), found[1])


def test_a_mask_resets_only_its_environments() -> None:
    env = make_env(3)
    for a in random_actions(env, 4):
        env.step(a)
    before, steps = env.simulation.qpos.clone(), env.episode_length_buf.clone()
    env.reset(torch.tensor([False, True, False]))
    assert torch.equal(env.simulation.qpos[[0, 2]], before[[0, 2]])
    assert not torch.equal(env.simulation.qpos[1], before[1])
    assert env.episode_length_buf.tolist() == [steps[0], 0, steps[2]]


def test_objects_of_different_kinds_share_one_batch() -> None:
    env = make_env(17)
    names = [env.model.shapes[number].name for number in env.simulation.shape_of]
    assert sum(name.startswith("cylinder") for name in names) == 2
    assert env.observations["aux_obj_size"].tolist() == [pytest.approx(shape.extent) for shape in env.model.shapes]
