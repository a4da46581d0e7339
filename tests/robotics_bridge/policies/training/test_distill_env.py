"""Distillation in a real task, and what a robot needs of it."""

from __future__ import annotations

import pytest
import torch

from robotics_bridge import tasks
from robotics_bridge.deploy.controller import read_deployed
from robotics_bridge.policies.evaluate import Policy
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.training.distill import distill, load_student
from robotics_bridge.policies.training.distill_config import DistillConfig

SETTINGS = {"task": "in_palm_rotate", "observe": "agg_force", "placement": "tips"}


class Pusher:
    """A teacher that reads what the student cannot."""

    def __init__(self, actions: int) -> None:
        self.actions = actions

    def __call__(self, obs) -> torch.Tensor:
        return torch.tanh(obs["priv_proprio"][:, : self.actions])


def _distil(out, noisy: bool, stop: int | None = None):
    env = tasks.make("in_palm_rotate", num_envs=2, observe="agg_force", placement="tips", noisy=noisy)
    teacher = Pusher(env.num_actions)
    if stop is not None:
        steps, original = [0], env.step

        def step(action):
            steps[0] += 1
            if steps[0] > stop:
                raise KeyboardInterrupt
            return original(action)

        env.step = step  # type: ignore[method-assign]
    config = DistillConfig(
        **SETTINGS, noisy=noisy, num_envs=2, steps_per_env=4, iterations=4, save_interval=2, encoder="zhuang-small"
    )  # type: ignore[arg-type]
    return distill(config, out, env=env, teacher=teacher)


@pytest.mark.slow
@pytest.mark.parametrize("noisy", [False, True])
def test_a_killed_run_in_a_task_goes_on_exactly(tmp_path, noisy) -> None:
    _distil(tmp_path / "a", noisy)
    with pytest.raises(KeyboardInterrupt):
        _distil(tmp_path / "b", noisy, stop=11)
    _distil(tmp_path / "b", noisy)
    first, second = (load_student(tmp_path / name)[0].state_dict() for name in "ab")
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, rtol=0, atol=0, msg=name)


@pytest.mark.slow
def test_an_exported_student_knows_its_hand(tmp_path) -> None:
    _distil(tmp_path / "run", noisy=False)
    student, described = load_student(tmp_path / "run")
    found = export_policy(student, tmp_path / "policy", deployment=described["deployment"])
    deployed = read_deployed(found.path)
    assert list(deployed.contract.inputs) == ["proprio", "command", "tactile"]
    assert (deployed.contract.rate, deployed.contract.hand) == (40, "xhand1")
    assert len(deployed.contract.links) == 5
    env = tasks.make("in_palm_rotate", num_envs=2, observe="agg_force", placement="tips")
    policy = Policy(student)
    observations = env.reset()
    for _ in range(3):
        observations, *_ = env.step(policy(observations))
