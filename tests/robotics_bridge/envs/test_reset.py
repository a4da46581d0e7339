"""The published configurations equal the thesis (tables by number) and the settings released with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from robotics_bridge import hands, tasks
from robotics_bridge.envs import Env, reset
from robotics_bridge.envs.step import step_context
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.scenes import build
from robotics_bridge.tasks.task import ObjectRandomisation, Task


@pytest.mark.shared
@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_grasps_are_sought_as_released(reference: Path, hand: str) -> None:
    yaml = pytest.importorskip("yaml")
    from robotics_bridge.envs.reset import SETTINGS
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

    monkeypatch.setattr(reset, "sample", sample)
    for changes in ([], ["friction=0.8"], ["solver.timestep=0.004"], [], ["friction=0.8"]):
        changed = apply_overrides(task, changes)
        reset.grasps_for(changed, hand, build(changed, hand))
    assert sampled == [(1.0, 0.005)] * 4 + [(0.8, 0.005)] * 4 + [(1.0, 0.004)] * 4


def _make(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def _actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def _calm(**changes: Any) -> Any:
    """The rotation task without anything random but where the object lies."""
    still = {"actuators": None, "push": None, "object_changes": ObjectRandomisation()}
    return replace(tasks.load("in_palm_rotate", "published"), **(still | changes))


def test_a_seed_fixes_what_is_drawn_once_too() -> None:
    changes = ObjectRandomisation(friction=(0.5, 2.0), mass_offset=(0.0, 0.1), each_reset=False)
    found = []
    for first in (0, 7):
        env = _make(4, _calm(object_changes=changes), seed=first)
        env.seed(1)
        env.reset()
        found.append(torch.stack((env.state.episode.friction, env.state.episode.mass)))
    assert torch.equal(*found)
    env.reset()
    assert torch.equal(torch.stack((env.state.episode.friction, env.state.episode.mass)), found[1])


def test_a_mask_resets_only_its_environments() -> None:
    env = _make(3)
    for a in _actions(env, 4):
        env.step(a)
    before, steps = env.simulation.qpos.clone(), env.episode_length_buf.clone()
    env.reset(torch.tensor([False, True, False]))
    assert torch.equal(env.simulation.qpos[[0, 2]], before[[0, 2]])
    assert not torch.equal(env.simulation.qpos[1], before[1])
    assert env.episode_length_buf.tolist() == [steps[0], 0, steps[2]]


def test_objects_of_different_kinds_share_one_batch() -> None:
    env = _make(17)
    names = [env.model.shapes[number].name for number in env.simulation.shape_of]
    assert sum(name.startswith("cylinder") for name in names) == 2
    assert env.observations["aux_obj_size"].tolist() == [pytest.approx(shape.extent) for shape in env.model.shapes]
