"""The native environment, on C MuJoCo; what MuJoCo Warp does differently is in test_engines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.devices import mujoco_module, warp
from brainbench.core.errors import UsageError
from brainbench.core.rotations import to_matrices
from robotics_bridge import tasks
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.envs import Env
from robotics_bridge.hands.observations import OBSERVATIONS, observation_type, observe, sensors_for
from robotics_bridge.tasks.goals import SteppingRotation
from robotics_bridge.tasks.task import ActuatorRandomisation, ObjectRandomisation


def _make(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def _actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def _calm(**changes: Any) -> Any:
    """The rotation task without anything random but where the object lies."""
    still = {"actuators": None, "push": None, "object_changes": ObjectRandomisation()}
    return replace(tasks.load("in_palm_rotate", "published"), **(still | changes))


def test_groups_have_the_sizes_of_table_4_7() -> None:
    env = _make(3)
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


def test_without_touch_no_tactile_sensor_is_built() -> None:
    env = _make(1)
    assert env.touch is None
    assert "tactile" not in env.observations


def test_targets_at_rated_speed_are_those_that_deployment_sends() -> None:
    env = _make(2, task=_calm(rated_speed=True))
    moved, limits = env.state.moved, SafetyLimits.of_hand(env.hand, env.state.model.moved)
    target = env.state.actuators.target
    for action in _actions(env, 6):
        before, wanted = target[:, moved].clone().numpy(), env.action_map.targets(action.numpy())
        env.step(action)
        assert np.abs(wanted - before).max() > 0.025 * limits.speed.max()
        np.testing.assert_allclose(target[:, moved], limits.limit(wanted, before, env.step_dt), atol=1e-6)


def test_the_same_seed_gives_the_same_episode_and_another_seed_another() -> None:
    def run(seed: int) -> torch.Tensor:
        env = _make(2, seed=seed)
        return torch.stack([env.step(a)[0]["priv_obj_state"].clone() for a in _actions(env, 5)])

    first = run(1)
    assert torch.equal(first, run(1))
    assert not torch.equal(first, run(2))


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


def test_an_environment_does_not_notice_how_many_others_there_are_in_its_physics() -> None:
    env = _make(3, _calm(placement=replace(tasks.load("in_palm_rotate").placement, x=(0, 0), y=(0, 0), yaw=(0, 0))))
    alone = _make(1, env.task)
    action = _actions(alone, 1)[0]
    for _ in range(10):
        env.step(action.expand(3, -1))
        alone.step(action)
    # Environment 0 holds the same block in both.
    assert torch.equal(env.simulation.qpos[0], alone.simulation.qpos[0])


def test_torque_noise_of_one_seed_is_not_that_of_the_next_a_step_later() -> None:
    streams = {}
    for seed in (0, 1, 2):
        actuators = (env := _make(1, seed=seed)).state.actuators
        for name in ("stiffness", "damping", "kick"):
            actuators.values[name].zero_()
        torques = []
        for _ in range(6):
            actuators.launch(0)
            torques.append(env.simulation.ctrl.flatten().tolist())
        streams[seed] = torques
    for one, other in ((0, 1), (1, 2), (0, 2)):
        assert not any(torque in streams[other] for torque in streams[one])


def test_an_environment_that_diverges_is_reset_and_counted_and_the_others_are_unharmed() -> None:
    one, two = _make(3, seed=5), _make(3, seed=5)
    for env in (one, two):
        for a in _actions(env, 3):
            env.step(a)
    two.simulation.engine.data[1].qpos[:] = np.nan
    action = _actions(one, 1, seed=9)[0]
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


def test_a_mask_resets_only_its_environments() -> None:
    env = _make(3)
    for a in _actions(env, 4):
        env.step(a)
    before, steps = env.simulation.qpos.clone(), env.episode_length_buf.clone()
    env.reset(torch.tensor([False, True, False]))
    assert torch.equal(env.simulation.qpos[[0, 2]], before[[0, 2]])
    assert not torch.equal(env.simulation.qpos[1], before[1])
    assert env.episode_length_buf.tolist() == [steps[0], 0, steps[2]]


def test_episodes_end_when_their_time_is_up_and_say_so() -> None:
    env = _make(2, _calm(episode=0.1))
    flags = [env.step(torch.zeros(2, 5)) for _ in range(4)]
    assert [bool(step[3].all()) for step in flags] == [False, False, False, True]
    assert not any(bool(step[2].any()) for step in flags)
    assert env.episode_length_buf.tolist() == [0, 0]
    assert env.statistics()["length"] == 4.0


def test_the_goal_narrows_when_enough_episodes_succeed_and_only_while_a_teacher_learns() -> None:
    goal = SteppingRotation(start_threshold=0.4, narrowing=0.5, mastered=0.4)
    goals = _make(4, _calm(goal=goal)).goals
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
    assert not _make(4, _calm(goal=SteppingRotation())).goals.curriculum()


def test_drives_reach_their_targets_and_held_joints_stay() -> None:
    env = _make(1, _calm())
    action = torch.full((1, 5), 0.5)
    for _ in range(60):
        env.step(action)
    reached = env.simulation.qpos[0, env.state.actuators.qpos_columns].numpy()
    wanted = env.action_map.targets(action[0].numpy())
    moved = [env.joint_names.index(name) for name in env.action_names]
    # Fingers press on the object and carry their own weight.
    np.testing.assert_allclose(reached[moved], wanted, atol=0.05)
    held = [index for index in range(12) if index not in moved]
    np.testing.assert_allclose(reached[held], 0.0, atol=0.02)
    assert set(env.frozen) == {env.joint_names[index] for index in held}


def test_actions_map_to_targets_within_the_joints_limits() -> None:
    env = _make(1, config="published")
    low, high = env.action_map.low, env.action_map.high
    targets = env.action_map.targets(np.array([1.0, 1.0, 1.0, 1.0, 1.0]))
    np.testing.assert_allclose(targets, np.clip(0.5 * (high - low), low, high))
    assert (env.action_map.targets(np.full(5, -9.0)) == low).all()


def test_an_action_beyond_the_limit_counts_as_the_limit_and_moves_the_same_joints() -> None:
    far, near = _make(2, _calm(action_limit=100.0)), _make(2, _calm(action_limit=100.0))
    free = _make(2, _calm())
    for env, size in ((far, 1e9), (near, 100.0), (free, 1e9)):
        env.reset()
        env.step(torch.full((2, env.num_actions), -size))
    assert far.observations["proprio"][:, -5:].unique().tolist() == [-100.0]
    assert free.observations["proprio"][:, -5:].unique().tolist() == [-1e9]
    assert torch.equal(far.simulation.qpos, near.simulation.qpos)
    assert torch.equal(far.simulation.qpos, free.simulation.qpos)
    with pytest.raises(UsageError, match=r"action_limit .* received 0"):
        _calm(action_limit=0.0)


def test_changed_masses_are_what_mujoco_derives_itself() -> None:
    mujoco = mujoco_module()
    env = _make(3, _calm(object_changes=ObjectRandomisation(friction=(0.5, 1.5), mass_offset=(0.0, 0.1))))
    for number in range(3):
        model = env.simulation.engine.models[number]
        derived = {name: getattr(model, name).copy() for name in ("body_subtreemass", "body_invweight0", "dof_M0")}
        body = model.body("object").id
        assert model.body_mass[body] == pytest.approx(float(env.state.episode.mass[number]), rel=1e-6)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name, value in derived.items():
            place = slice(model.body_dofadr[body], None) if name == "dof_M0" else body
            np.testing.assert_allclose(value[place], getattr(model, name)[place], rtol=2e-5)
        friction = model.geom_friction[model.geom("object_0").id, 0]
        assert friction == pytest.approx(float(env.state.episode.friction[number]), rel=1e-6)


def test_heavy_and_light_objects_fall_alike() -> None:
    aside = replace(tasks.load("in_palm_rotate").placement, height=1.0, x=(0.5, 0.5), y=(0.5, 0.5))
    env = _make(4, _calm(placement=aside, object_changes=ObjectRandomisation(mass_offset=(0.0, 0.1))))
    start = env.object_pose[:, 0, 2].clone()
    for _ in range(8):
        env.step(torch.zeros(4, env.num_actions))
    # Implicit steps of 5 ms: g t (t + dt) / 2.
    np.testing.assert_allclose(start - env.object_pose[:, 0, 2], 9.81 * 0.2 * 0.205 / 2, rtol=1e-3)


def test_objects_of_different_kinds_share_one_batch() -> None:
    env = _make(17)
    names = [env.model.shapes[number].name for number in env.simulation.shape_of]
    assert sum(name.startswith("cylinder") for name in names) == 2
    assert env.observations["aux_obj_size"].tolist() == [pytest.approx(shape.extent) for shape in env.model.shapes]


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_every_observation_type_feels_the_objects_of_a_task(kind: str) -> None:
    # Blocks and cylinders share one batch: each has the other's solid as a grain.
    env = _make(2, observe=kind, placement="tips", resolution="low")
    observations = env.step(torch.zeros(2, env.num_actions))[0]
    assert ("tactile" in observations) == (observation_type(kind).sensor is not None)
    assert all(value.isfinite().all() for value in observations.values())


@pytest.mark.parametrize("kind", ["force_torque", "agg_bool", "agg_force"])
def test_touch_is_what_the_sensors_of_the_hand_read(kind: str) -> None:
    from robotics_bridge.sensors import SensorSuite

    # Springs remember what they held, which sensors that come later cannot know.
    knobs: dict = {"total": "engine"} if kind == "force_torque" else {}
    env = _make(2, observe=kind, placement="hand", resolution="low", knobs=knobs)
    assert env.touch is not None
    taxels = env.hand.layout("low", "hand")
    suite = SensorSuite(env.simulation.engine.scene, sensors_for(kind, taxels, track=("object",), **knobs), num_envs=2)
    suite.reset()
    env.reset()
    for a in _actions(env, 8):
        env.step(a)
    suite.update(env.simulation.state, 0.005)
    # The last physics step of the control step is the state that is still there, but for the refreshed poses.
    env.simulation.engine.forward()
    suite.update(env.simulation.state, 0.005)
    env.touch.update(env.simulation.state, 0.005, 4)  # type: ignore[union-attr]
    expected = observe(kind, {name: suite.read(name) for name in taxels}, taxels)
    assert torch.allclose(env.observations["tactile"][:, -1].flatten(1), expected, atol=1e-6)
    assert env.observations["tactile"].shape[1:] == (
        5,
        expected.shape[1] // observation_type(kind).channels,
        observation_type(kind).channels,
    )


def test_touch_is_felt_when_the_object_lies_on_the_palm() -> None:
    env = _make(2, _calm(), observe="force_torque", placement="palm", resolution="med")
    assert env.observations["tactile"].abs().sum() == 0
    for _ in range(20):
        env.step(torch.zeros(2, 5))
    reading = env.observations["tactile"]
    assert (reading[..., 0].sum(dim=(1, 2)).abs() > 0).all()
    before = reading[1].clone()
    env.reset(torch.tensor([True, False]))
    assert env.observations["tactile"][0].abs().sum() == 0
    assert torch.equal(env.observations["tactile"][1], before)


def test_poses_of_links_and_objects_are_quaternions_with_the_scalar_first() -> None:
    env = _make(2, observe="bool", placement="fingers", resolution="low", link_pose=True)
    for a in _actions(env, 3):
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


def test_a_saved_state_goes_on_exactly() -> None:
    one = _make(3, seed=2)
    for a in _actions(one, 6):
        one.step(a)
    state = {name: value.clone() for name, value in one.state_dict().items()}
    two = _make(3, seed=7)
    two.load_state_dict(state)
    for a in _actions(one, 6, seed=4):
        first, second = one.step(a), two.step(a)
        assert torch.equal(first[1], second[1])
        for name, value in first[0].items():
            assert torch.equal(value, second[0][name]), name


def test_ten_times_the_published_randomisation_is_survived() -> None:
    task = tasks.load("in_palm_rotate")
    wide = ActuatorRandomisation(
        stiffness=(0.5, 1.5), damping=(0.5, 1.5), strength=(0.5, 1.5), position_bias=(-0.1, 0.1), deadband=(0.0, 0.05),
        backlash=(0.0, 0.1), kick_ratio=(0.0, 2.0), torque_noise=1.0,
    )  # fmt: skip
    task = replace(
        task, actuators=wide,
        object_changes=ObjectRandomisation(friction=(0.05, 5.5), mass_offset=(0.0, 1.0), size=(0.4, 2.5)),
    )  # fmt: skip
    env = _make(24, task)
    assert len(env.model.shapes) == 8 * 17
    for a in _actions(env, 25):
        observations, reward, *_ = env.step(3 * a)
        assert reward.isfinite().all()
        assert all(value.isfinite().all() for value in observations.values())


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


def test_device_memory_is_shared_with_warp() -> None:
    env = _make(2)
    assert warp().from_torch(env.state.actuators.target).ptr == env.state.actuators.target.data_ptr()
