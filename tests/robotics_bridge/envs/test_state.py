"""The native environment, on C MuJoCo; what MuJoCo Warp does differently is in physics/test_gpu."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.rotations import to_matrices
from robotics_bridge import tasks
from robotics_bridge.sensors import Noise
from robotics_bridge.tasks.goals import SteppingRotation
from tests.factories.task_worlds import calm_task, make_env, random_actions


def test_the_goal_narrows_when_enough_episodes_succeed_and_only_while_a_teacher_learns() -> None:
    goal = SteppingRotation(start_threshold=0.4, narrowing=0.5, mastered=0.4)
    goals = make_env(4, calm_task(goal=goal)).goals
    assert float(goals.threshold) == pytest.approx(0.1)
    goals.start_curriculum()
    assert float(goals.threshold) == pytest.approx(0.4)
    some, all_of_them = torch.tensor([True, True, False, False]), torch.ones(4, dtype=torch.bool)
    goals.count.copy_(torch.tensor([1.0, 0.0, 2.0, 0.0]))
    goals.count_episodes(some)
    assert float(goals.threshold) == pytest.approx(0.4)
    goals.count_episodes(~some)
    assert float(goals.threshold) == pytest.approx(0.2)
    goals.count.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]))
    goals.count_episodes(all_of_them)
    assert float(goals.threshold) == pytest.approx(0.2)
    goals.count.fill_(1.0)
    for _ in range(3):
        goals.count_episodes(all_of_them)
    assert float(goals.threshold) == pytest.approx(0.1)
    assert not make_env(4, calm_task(goal=SteppingRotation())).goals.curriculum()


def test_poses_of_links_and_objects_are_quaternions_with_the_scalar_first() -> None:
    env = make_env(2, observe="bool", placement="fingers", resolution="low", link_pose=True)
    for a in random_actions(env, 3):
        env.step(a)
    assert env.touch is not None
    pose = env.observations["link_pose"].numpy()
    for number, data in enumerate(env.simulation.engine.data):
        palm = data.body(env.hand.palm)
        axes = palm.xmat.reshape(3, 3).T
        for row, name in zip(pose[number], env.touch.links, strict=True):
            body = data.body(name)
            np.testing.assert_allclose(row[:3], axes @ (body.xpos - palm.xpos), atol=1e-5, err_msg=name)
            turn = axes @ body.xmat.reshape(3, 3)
            np.testing.assert_allclose(to_matrices(row[3:]), turn, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(env.object_pose[number, 0, 3:], data.body("object").xquat, atol=1e-5)


_LATE = {"noise": Noise(read_delay=0.021, jitter=0.01, hysteresis=0.4, walk=1e-4)}


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("in_palm_rotate", {}),
        ("in_palm_rotate", {"observe": "force_torque", "resolution": "low"}),
        ("in_palm_rotate", {"observe": "elastomer", "resolution": "low"}),
        ("in_palm_rotate", {"observe": "depth", "resolution": "low", "knobs": _LATE}),
        ("hot_ball", {}),
    ],
    ids=["joints", "taxels-that-hold", "gel", "late-and-drifting", "heat"],
)
def test_a_saved_state_goes_on_exactly(task, options) -> None:
    one, two = (tasks.make(task, num_envs=3, seed=seed, threads=1, **options) for seed in (2, 7))
    for a in random_actions(one, 40):
        one.step(a)
    for a in random_actions(two, 9):
        two.step(a)
    two.load_state_dict(one.state_dict())
    for a in random_actions(one, 6, seed=4):
        first, second = one.step(a), two.step(a)
        assert torch.equal(first[1], second[1])
        for name, value in first[0].items():
            assert torch.equal(value, second[0][name]), name
