"""Reward terms that pay for turning an object: going to and fro must not pay."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from robotics_bridge import tasks
from robotics_bridge.tasks import terms

DT = 0.025


def paid(task: Any, angles: np.ndarray) -> float:
    """Return what a task pays for an object that is turned about the commanded axis to these angles (rad)."""
    goal = 1.5
    total = 0.0
    for before, now in pairwise(angles):
        moment: Any = SimpleNamespace(
            dt=DT, off_axis=torch.zeros(1), allowed_off_axis=0.5, axis_rate=torch.tensor([(now - before) / DT]),
            goal_angle=torch.tensor([abs(goal - now)]), previous_goal_angle=torch.tensor([abs(goal - before)]),
        )  # fmt: skip
        for name in ("rotation_progress", "goal_approach"):
            if name in task.rewards:
                reward = task.rewards[name]
                total += DT * reward.weight * float(reward.term(moment, **reward.params))
    return total


@pytest.mark.parametrize("config", ["published", "default", "careful"])
@given(angles=st.lists(st.floats(-1.4, 1.4), min_size=2, max_size=12))
def test_turning_to_and_fro_never_pays(config: str, angles: list[float]) -> None:
    path = np.array([0.0, *angles, 0.0])
    assert paid(tasks.load("in_palm_rotate", config), path) <= 1e-4


@pytest.mark.parametrize("config", ["published", "default", "careful"])
def test_a_slow_turn_towards_the_goal_pays_in_full_and_a_quick_one_less(config: str) -> None:
    task = tasks.load("in_palm_rotate", config)
    weight = sum(task.rewards[name].weight for name in ("rotation_progress", "goal_approach") if name in task.rewards)
    slow, quick = np.linspace(0, 1, 101), np.array([0.0, 1.0])
    assert paid(task, slow) == pytest.approx(weight, rel=1e-4)
    assert paid(task, quick) < 0.2 * weight


@pytest.mark.parametrize(("config", "reaching_pays"), [("published", False), ("default", True)])
def test_an_orientation_is_worth_more_reached_than_nearly_reached(config: str, reaching_pays: bool) -> None:
    task = tasks.load("in_hand_repose", config)
    assert task.goal is not None
    moment: Any = SimpleNamespace(
        dt=DT, goal_angle=torch.tensor([1.05 * task.goal.threshold]), reached=torch.tensor([True]),
        missed=torch.tensor([True]),
    )  # fmt: skip

    def value(name: str) -> float:
        return float(task.rewards[name].weight * task.rewards[name].term(moment, **task.rewards[name].params))

    waiting = task.goal.deadline[1] * (value("track_orientation_gaussian") + value("track_orientation_inv_l2"))
    assert (DT * value("success_bonus") > waiting + DT * value("goal_timeout_penalty")) is reaching_pays


def test_a_term_of_rotation_counts_nothing_beyond_the_tilt_that_the_goal_allows() -> None:
    moment: Any = SimpleNamespace(off_axis=torch.tensor([0.7]), allowed_off_axis=0.5, axis_rate=torch.tensor([2.0]))
    assert float(terms.rotation_progress(moment, clip=6.0, penalty_scale=5.0)) == pytest.approx(-1.0)


@pytest.mark.parametrize("tips", [1, 2, 5])
def test_a_hand_of_few_fingers_is_paid_for_those_that_it_has(tips: int) -> None:
    distance = torch.linspace(0.01, 0.05, tips)[None]
    moment: Any = SimpleNamespace(surface_distance=distance)
    expected = np.exp(-distance[0, :2].numpy() / 0.05).mean()
    assert float(terms.near_surface(moment, nearest_k=2, sigma=0.05)) == pytest.approx(expected)
