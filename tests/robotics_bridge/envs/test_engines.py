"""The same task on C MuJoCo and on MuJoCo Warp (here on a processor, which takes minutes to compile)."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.tasks.settings import CONTACTS


def _pair(contacts: str) -> tuple[Env, Env]:
    task = replace(tasks.load("in_palm_rotate", "published"), push=None, contacts=CONTACTS[contacts])
    options = {"num_envs": 3, "observe": "force_torque", "resolution": "low", "seed": 3}
    one = tasks.make(task, engine="mujoco", threads=1, **options)
    return one, tasks.make(task, engine="warp", **options)


@pytest.mark.slow
@pytest.mark.parametrize("contacts", CONTACTS)
def test_both_engines_run_the_same_task_and_contain_a_diverging_environment(contacts: str) -> None:
    pytest.importorskip("mujoco_warp")
    one, two = _pair(contacts)
    assert one.simulation.timestep == pytest.approx(two.simulation.timestep)
    for name, value in one.simulation.fields.items():
        # Single against double precision.
        assert torch.allclose(value, two.simulation.fields[name], rtol=1e-5, atol=1e-6), name
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        action = 0.5 * torch.randn(3, one.num_actions, generator=generator)
        first, second = one.step(action), two.step(action)
        assert torch.allclose(first[0]["proprio"], second[0]["proprio"], atol=1e-3)
        assert torch.allclose(first[0]["priv_obj_state"][:, :3], second[0]["priv_obj_state"][:, :3], atol=3e-3)
    two.simulation.qpos[1] = float("nan")
    observations, reward, terminated, _, info = two.step(action)
    assert info["diverged"].tolist() == [False, True, False]
    assert terminated.tolist() == [False, True, False]
    assert float(reward[1]) == 0.0
    assert all(value.isfinite().all() for value in observations.values())
    assert not two.step(action)[4]["diverged"].any()


@pytest.mark.gpu
@pytest.mark.parametrize("contacts", CONTACTS)
def test_a_gpu_runs_many_environments_without_divergence(contacts: str) -> None:
    task = replace(tasks.load("in_palm_rotate"), contacts=CONTACTS[contacts])
    env = tasks.make(task, num_envs=256, device="cuda", observe="force_torque")
    for _ in range(20):
        observations, reward, _, _, info = env.step(torch.randn(256, env.num_actions, device="cuda"))
    assert reward.isfinite().all()
    assert int(info["diverged"].sum()) == 0
    assert observations["tactile"].shape == (256, 5, 199, 6)
