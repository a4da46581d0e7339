"""Evaluation of agents."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.core.rotations import about, multiply
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.evaluate import PolicyEvaluation, agent, evaluate, mean_of_episodes
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.task import Placement


def _env() -> Env:
    return tasks.make(replace(tasks.load("in_palm_rotate"), episode=0.1), num_envs=3, threads=1)


def _made(won: int, of: int) -> PolicyEvaluation:
    success = (True,) * won + (False,) * (of - won)
    return PolicyEvaluation(
        "a", "t", (0,), success, (1.0,) * of, tuple(map(float, range(of))), (4,) * of, 0, (won / of,)
    )


def test_every_environment_contributes_equally_many_episodes_of_every_seed() -> None:
    env = _env()
    found = evaluate(env, agent("zero", env), episodes=5, seed=(0, 1, 2))
    assert len(found.success) == 3 * 2 * 3
    assert found.lengths == (4,) * 18
    assert found.success_rate == 0.0
    assert len(found.per_seed) == 3
    assert found.summary()["episodes"] == 18


def test_one_episode_has_no_interval() -> None:
    assert math.isnan(mean_of_episodes([3.0])[1])
    assert mean_of_episodes([3.0, 5.0]) == (4.0, pytest.approx(1.959964))


def test_an_episode_that_diverged_is_no_success_whatever_it_reached() -> None:
    env = _env()

    def act(_: object) -> torch.Tensor:
        env.goals.count.fill_(2.0)
        actions = torch.zeros(3, 5)
        actions[1] = torch.nan
        return actions

    found = evaluate(env, act, episodes=3, seed=0)
    assert found.diverged == 1
    assert sorted(zip(found.lengths, found.success, found.dropped, strict=True)) == [
        (1, False, False), (4, True, False), (4, True, False),
    ]  # fmt: skip
    assert found.per_seed == pytest.approx((2 / 3,))
    assert env.statistics()["success"] < 0.5


def test_an_episode_that_ends_with_its_last_goal_is_no_drop() -> None:
    changes = ["episode=0.1", "reached_max_consecutive_successes.count=2", "obj_dropped.height=-1"]
    for task, dropped in ((changes, False), ([*changes[:2], "obj_dropped.height=2"], True)):
        env = tasks.make(apply_overrides(tasks.load("in_palm_rotate"), task), num_envs=2, threads=1)

        def act(_: object, env: Env = env, count: float = 2.0 - dropped) -> torch.Tensor:
            env.goals.count.fill_(count)
            return torch.zeros(2, 5)

        found = evaluate(env, act, episodes=2, seed=0)
        assert found.lengths == (1, 1)
        assert found.dropped == (dropped,) * 2


def test_success_is_told_for_each_object() -> None:
    names = ("a", "b", "a", "a")
    found = replace(_made(2, 4), goals=(3.0, 1.0, 0.0, 0.0), dropped=(True, False, False, True), objects=names)
    told = found.summary()["objects"]
    assert told["a"] == {"episodes": 3, "success_rate": 1 / 3, "goals": 1.0, "dropped": 2 / 3}
    assert told["b"] == {"episodes": 1, "success_rate": 1.0, "goals": 1.0, "dropped": 0.0}
    env = tasks.make(replace(tasks.load("in_palm_rotate"), episode=0.05), num_envs=18, threads=1)
    counts = {name: item["episodes"] for name, item in evaluate(env, agent("zero", env)).summary()["objects"].items()}
    # Seventeen objects in turn on eighteen environments: the first comes twice as often, in six rounds of three seeds.
    assert sum(counts.values()) == 18 * 6 * 3
    assert counts[env.model.shapes[0].name] == 2 * counts[env.model.shapes[-1].name]


def test_what_success_does_not_tell_is_graded() -> None:
    env = _env()
    found = evaluate(env, agent("zero", env), episodes=3, seed=0)
    assert found.seconds == pytest.approx((0.1,) * 3)
    assert found.dropped == (False,) * 3
    assert found.goals == (0.0,) * 3
    summary = found.summary()
    assert summary["seconds"] == pytest.approx(0.1)
    assert {"turn_rate", "goals_half_width", "dropped"} <= set(summary)
    # Beside the hand the block falls: nothing touches it, so nothing turns it.
    falls = replace(tasks.load("in_palm_rotate"), placement=Placement(height=1.0, x=(0.5, 0.5), y=(0.5, 0.5)))
    env = tasks.make(falls, num_envs=2, threads=1)
    fallen = evaluate(env, agent("zero", env), episodes=2, seed=0)
    assert fallen.dropped == (True, True)
    assert fallen.turn_rate == (0.0, 0.0)
    # From 1 m to 0.45 m it takes √(2 · 0.55 / 9.81) s; the block's origin starts some centimetres higher.
    assert fallen.seconds[0] == pytest.approx(0.34, abs=0.05)


def test_rotation_counts_while_something_touches() -> None:
    goals = tasks.make("in_palm_rotate", num_envs=2, threads=1).goals
    turn = about(torch.tensor([[-1.0, 0.0, 0.0]]).expand(2, 3), torch.tensor([0.05, 0.05]))
    goals.update(multiply(turn, goals.previous.clone()), torch.tensor([True, False]))
    assert goals.turned_held.tolist() == pytest.approx([0.05, 0.0], abs=1e-5)


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
    with pytest.raises(UsageError, match=r"received 0 and \(0, 1, 2\)"):
        evaluate(env, agent("zero", env), episodes=0)
    with pytest.raises(UsageError, match="did you mean 'zero'"):
        agent("zeros", env)
    with pytest.raises(UsageError, match="did you mean 'returns'"):
        _made(1, 2).mean("return")


def test_episodes_that_would_count_twice_are_refused() -> None:
    with pytest.raises(UsageError, match="seed 4 stands there twice"):
        evaluate(_env(), agent("zero", _env()), episodes=3, seed=(4, 0, 4))


def test_objects_that_no_environment_holds_are_named(caplog) -> None:
    evaluate(_env(), agent("zero", _env()), episodes=3, seed=0)
    assert "3 environments hold 3 of the 17 objects of the task" in caplog.text
    caplog.clear()
    env = tasks.make(replace(tasks.load("in_palm_rotate"), episode=0.1), num_envs=17, threads=1)
    found = evaluate(env, agent("zero", env), episodes=3, seed=0)
    assert len(found.objects) == 17
    assert "objects of the task" not in caplog.text
