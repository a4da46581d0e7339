"""The native environment, on C MuJoCo; what MuJoCo Warp does differently is in physics/test_gpu."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env


def _make(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def _actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def test_the_same_seed_gives_the_same_episode_and_another_seed_another() -> None:
    def run(seed: int) -> torch.Tensor:
        env = _make(2, seed=seed)
        return torch.stack([env.step(a)[0]["priv_obj_state"].clone() for a in _actions(env, 5)])

    first = run(1)
    assert torch.equal(first, run(1))
    assert not torch.equal(first, run(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "at least 1 and at most 1,000,000"),
        ({"engine": "mujoko"}, "did you mean 'mujoco'"),
        ({"observe": "forces"}, "did you mean 'force'"),
        ({"device": "cuda:0", "engine": "mujoco"}, "CUDA|processor"),
        ({"link_pose": True}, "choose an observation type"),
        ({"config": "publshed"}, "did you mean 'published'"),
    ],
)
def test_wrong_requests_say_what_is_allowed(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        tasks.make("in_palm_rotate", **options)


def test_actions_of_another_shape_are_refused() -> None:
    with pytest.raises(UsageError, match=r"\(2, 5\)"):
        _make(2).step(torch.zeros(2, 12))


def test_what_does_not_fit_the_environments_is_refused() -> None:
    one, two = (tasks.make("in_palm_rotate", num_envs=count, threads=1) for count in (1, 2))
    for seed in (np.nan, 1.5, -1, 2**70, None):
        with pytest.raises(UsageError, match="seed"):
            two.seed(seed)
    with pytest.raises(UsageError, match="tensor"):
        two.step(np.zeros((2, two.num_actions), np.float32))
    for mask in (np.array([True, False]), torch.tensor([1, 0]), torch.tensor([True])):
        with pytest.raises(UsageError, match="mask"):
            two.reset(mask)
    for values in ({}, one.state_dict()):
        with pytest.raises(UsageError, match="other environments"):
            two.load_state_dict(values)
    two.load_state_dict(two.state_dict())
    with pytest.raises(UsageError, match=r"\(2,\)"):
        two.episode_length_buf = torch.zeros(1, dtype=torch.long)
