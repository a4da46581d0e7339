"""Tasks as data: registry, goals, objects, scenes, reset, thermometers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.core.rotations import about, angle_of, conjugate, multiply, rotate, six_numbers, twist_and_swing
from robotics_bridge import tasks
from robotics_bridge.tasks.goals import SteppingRotation, TimedRotation
from robotics_bridge.tasks.objects import (
    CUBES,
    cylinder,
)
from robotics_bridge.tasks.task import (
    Placement,
)


def test_stepping_goals_lie_one_step_further_about_the_axis() -> None:
    goal = SteppingRotation(axis=(0.0, 0.0, 1.0), step=0.5)
    start = about(torch.tensor([1.0, 0.0, 0.0]).expand(3, 3), torch.tensor([0.0, 0.3, -0.7]))
    first = goal.first(start, torch.zeros(3, 2))
    second = goal.following(start, first, torch.zeros(3, 2))
    for one, two, angle in ((start, first, 0.5), (start, second, 1.0)):
        turn = multiply(two, conjugate(one))
        assert torch.allclose(angle_of(turn), torch.full((3,), angle), atol=1e-6)
        assert torch.allclose(turn[:, 1:3], torch.zeros(3, 2), atol=1e-6)


def test_flat_goals_do_not_keep_the_yaw_of_the_start() -> None:
    """An object that begins with a yaw would have to stand tilted by it after a quarter turn about a level axis."""
    up = torch.tensor([0.0, 0.0, 1.0]).expand(3, 3)
    start = about(up, torch.tensor([-0.25, 0.0, 0.25]))
    nothing = torch.zeros(3, 2)

    def tilt(goal: SteppingRotation) -> torch.Tensor:
        """Return the angles between the plane and the side of the object that was level at the start."""
        return rotate(goal.first(start, nothing), torch.tensor([1.0, 0.0, 0.0]))[:, 2].asin().abs()

    published = tasks.load("in_palm_rotate", "published").goal
    torch.testing.assert_close(tilt(published), torch.tensor([0.25, 0.0, 0.25]), atol=1e-5, rtol=0)
    for config in ("default", "careful"):
        flat = tasks.load("in_palm_rotate", config).goal
        torch.testing.assert_close(tilt(flat), torch.zeros(3), atol=1e-5, rtol=0)
        turn = multiply(flat.first(start, nothing), conjugate(start))
        assert twist_and_swing(turn, torch.tensor([-1.0, 0.0, 0.0]))[0].tolist() == pytest.approx(
            [1.5708] * 3, abs=0.07
        )


def test_a_round_object_counts_as_it_looks_and_a_block_does_not() -> None:
    spun = about(torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3), torch.tensor([0.0, 1.1, -2.9]))
    for shape, round_, config in ((CUBES[0], False, "default"), (cylinder(0.02, 0.042), True, "default"),
                                  (cylinder(0.02, 0.042), False, "published")):  # fmt: skip
        env = tasks.make(replace(tasks.load("in_palm_rotate", config), objects=(shape,)), num_envs=3, threads=1)
        goals, held = env.goals, torch.ones(3, dtype=torch.bool)
        at_goal = multiply(goals.quat, spun)
        goals.update(at_goal, held)
        wanted = [0.0, 0.0, 0.0] if round_ else [0.0, 1.1, 2.9]
        assert goals.angle.tolist() == pytest.approx(wanted, abs=2e-3)
        assert goals.reached.tolist() == [True, round_, round_]
        # What a teacher sees of it does not tell how far a round object is turned about itself.
        seen = six_numbers(goals.looks(at_goal))
        assert bool((seen - seen[0]).abs().max() < 1e-4) is round_
        # A turn that shows is one also of a round object.
        tip = about(torch.tensor([[-1.0, 0.0, 0.0]]).expand(3, 3), torch.full((3,), 0.4))
        goals.update(multiply(tip, goals.quat), held)
        assert goals.angle.tolist() == pytest.approx([0.4] * 3, abs=1e-4)
        env.step(torch.zeros(3, env.num_actions))


def test_timed_goals_stay_within_their_tilt() -> None:
    goal = TimedRotation(tilt=(-0.4, 0.4))
    start = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(500, 4)
    angle = angle_of(goal.first(start, torch.rand(500, 2)))
    assert float(angle.max()) <= 0.4 * 2**0.5 + 1e-6
    assert float(angle.mean()) > 0.1


def _changed(**changes: Any) -> tasks.Task:
    return replace(tasks.load("in_palm_rotate"), **changes)


def test_axes_and_orientations_count_by_their_direction() -> None:
    assert Placement(quaternion=(2, 0, 0, 0)) == Placement()
    assert _changed(turn_axis=(0.0, 0.0, 2.0)).turn_axis == (0.0, 0.0, 1.0)
    start, draw = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 2)
    near, far = (SteppingRotation(axis=(0, 0, length), step=0.5).following(start, start, draw) for length in (1.0, 3.0))
    assert torch.equal(near, far)
    for make in (lambda axis: SteppingRotation(axis=axis), lambda axis: _changed(turn_axis=axis)):
        for axis in ((0, 0, 0), (0, np.nan, 1), (0.0, 1.0)):
            with pytest.raises(UsageError, match="axis"):
                make(axis)
