"""Evaluation of agents."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from brainbench.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.evaluate import Evaluation, agent, evaluate


def _env() -> Env:
    return tasks.make(replace(tasks.load("in_palm_rotate"), episode=0.1), num_envs=3, threads=1)


def _made(won: int, of: int) -> Evaluation:
    success = (True,) * won + (False,) * (of - won)
    return Evaluation("a", "t", (0,), success, (1.0,) * of, tuple(map(float, range(of))), (4,) * of, 0, (won / of,))


def test_every_environment_contributes_equally_many_episodes_of_every_seed() -> None:
    env = _env()
    found = evaluate(env, agent("zero", env), episodes=5, seed=(0, 1, 2))
    assert len(found.success) == 3 * 2 * 3
    assert found.lengths == (4,) * 18
    assert found.success_rate == 0.0
    assert len(found.per_seed) == 3
    assert found.summary()["episodes"] == 18


def test_the_same_seed_gives_the_same_episodes() -> None:
    env = _env()
    one = evaluate(env, agent("random", env, seed=4), episodes=3, seed=8)
    two = evaluate(env, agent("random", env, seed=4), episodes=3, seed=8)
    assert one.returns == two.returns


def test_the_interval_is_wilsons() -> None:
    # Wilson (1927) as tabulated by Newcombe (1998), 81 of 263 and 0 of 20.
    assert _made(81, 263).interval() == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert _made(0, 20).interval() == pytest.approx((0.0, 0.1611), abs=1e-4)
    mean, half = _made(0, 5).mean("returns")
    assert (mean, half) == pytest.approx((2.0, 1.959964 * (2.5 / 5) ** 0.5))


def test_memories_of_a_policy_are_cleared_when_episodes_end() -> None:
    class Remembers:
        cleared = 0

        def __call__(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
            return torch.zeros(3, 5)

        def reset(self, mask: torch.Tensor) -> None:
            self.cleared += int(mask.sum())

    policy = Remembers()
    evaluate(_env(), policy, episodes=3, seed=0)
    assert policy.cleared == 6


def test_wrong_requests_are_refused() -> None:
    env = _env()
    with pytest.raises(UsageError, match="at least one episode"):
        evaluate(env, agent("zero", env), episodes=0)
    with pytest.raises(UsageError, match="did you mean 'zero'"):
        agent("zeros", env)
    with pytest.raises(UsageError, match="did you mean 'returns'"):
        _made(1, 2).mean("return")
