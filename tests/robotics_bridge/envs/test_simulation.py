"""Options, seeds, actions and states that do not fit are refused; one seed gives one course of events."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.devices import mujoco_module, warp
from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env, EnvOptions
from robotics_bridge.tasks.settings import CONTACTS
from robotics_bridge.tasks.task import ActuatorRandomisation, ObjectRandomisation


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", 1.5), ("seed", -1), ("seed", np.nan), ("seed", 2**70), ("threads", 0), ("threads", -1),
        ("placement", "tps"), ("resolution", "hi"), ("noisy", True), ("knobs", {"points": 5}),
        ("device", torch.device("cpu")),
    ],
)  # fmt: skip
def test_options_have_ranges_and_are_not_ignored(name, value) -> None:
    with pytest.raises(UsageError, match=name):
        EnvOptions(**{name: value})


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


def _make(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def _actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def _calm(**changes: Any) -> Any:
    """The rotation task without anything random but where the object lies."""
    still = {"actuators": None, "push": None, "object_changes": ObjectRandomisation()}
    return replace(tasks.load("in_palm_rotate", "published"), **(still | changes))


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


def test_device_memory_is_shared_with_warp() -> None:
    env = _make(2)
    assert warp().from_torch(env.state.actuators.target).ptr == env.state.actuators.target.data_ptr()
