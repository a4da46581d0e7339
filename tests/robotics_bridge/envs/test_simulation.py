"""Options, seeds, actions and states that do not fit are refused; one seed gives one course of events."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from brainbench.core.devices import mujoco_module, warp
from brainbench.core.errors import UsageError
from robotics_bridge import tasks
from robotics_bridge.envs import Env, EnvOptions
from robotics_bridge.hands import load
from robotics_bridge.hands.observations import OBSERVATIONS, observation_type, observe, sensors_for
from robotics_bridge.hands.tree import cast_grid
from robotics_bridge.tasks.settings import CONTACTS
from robotics_bridge.tasks.task import ActuatorRandomisation, ObjectRandomisation
from tests.factories.task_worlds import calm_task, make_env, random_actions


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


def test_an_environment_does_not_notice_how_many_others_there_are_in_its_physics() -> None:
    env = make_env(
        3, calm_task(placement=replace(tasks.load("in_palm_rotate").placement, x=(0, 0), y=(0, 0), yaw=(0, 0)))
    )
    alone = make_env(1, env.task)
    action = random_actions(alone, 1)[0]
    for _ in range(10):
        env.step(action.expand(3, -1))
        alone.step(action)
    # Environment 0 holds the same block in both.
    assert torch.equal(env.simulation.qpos[0], alone.simulation.qpos[0])


def test_torque_noise_of_one_seed_is_not_that_of_the_next_a_step_later() -> None:
    streams = {}
    for seed in (0, 1, 2):
        actuators = (env := make_env(1, seed=seed)).state.actuators
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
    env = make_env(1, calm_task())
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
    env = make_env(3, calm_task(object_changes=ObjectRandomisation(friction=(0.5, 1.5), mass_offset=(0.0, 0.1))))
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
    env = make_env(4, calm_task(placement=aside, object_changes=ObjectRandomisation(mass_offset=(0.0, 0.1))))
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
    env = make_env(24, task)
    assert len(env.model.shapes) == 8 * 17
    for a in random_actions(env, 25):
        observations, reward, *_ = env.step(3 * a)
        assert reward.isfinite().all()
        assert all(value.isfinite().all() for value in observations.values())


def test_device_memory_is_shared_with_warp() -> None:
    env = make_env(2)
    assert warp().from_torch(env.state.actuators.target).ptr == env.state.actuators.target.data_ptr()


def _course(env, seed: int) -> list[torch.Tensor]:
    env.seed(seed)
    observations = env.reset()
    actions = torch.Generator().manual_seed(0)
    seen = [value.clone() for value in observations.values()]
    for _ in range(4):
        step = env.step(0.5 * torch.randn(2, env.num_actions, generator=actions))
        seen += [*(value.clone() for value in step[0].values()), step[1].clone()]
    return seen


def test_one_seed_gives_one_course_with_noisy_touch_too() -> None:
    options = {"num_envs": 2, "observe": "depth", "noisy": True, "resolution": "low", "threads": 1}
    env, other = (tasks.make("in_palm_rotate", seed=seed, **options) for seed in (0, 9))
    first = _course(env, 5)
    for again in (_course(env, 5), _course(other, 5)):
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, _course(env, 6), strict=True))
    # A kept state brings the seed of its noise along.
    action, kept = torch.zeros(2, env.num_actions), env.state_dict()
    fresh = tasks.make("in_palm_rotate", seed=3, **options)
    fresh.load_state_dict(kept)
    for one in (env, fresh):
        one.reset()
    assert torch.equal(env.step(action)[0]["tactile"], fresh.step(action)[0]["tactile"])


def test_readings_have_the_shape_of_their_type() -> None:
    layout = load("xhand1").layout("low", "tips")
    for name, wrong in (("force", ()), ("bool", (6,)), ("depth", (2,)), ("force", (3,))):
        readings = {link: torch.zeros(2, len(probes), *wrong) for link, probes in layout.items()}
        with pytest.raises(UsageError, match="shape"):
            observe(name, readings, layout)
    swapped = {link: torch.zeros(2, 6, len(probes)) for link, probes in layout.items()}
    with pytest.raises(UsageError, match="shape"):
        observe("force", swapped, layout)
    with pytest.raises(UsageError, match="at least one link"):
        observe("force", {}, {})
    assert observe("depth", {link: torch.zeros(0, len(p)) for link, p in layout.items()}, layout).shape[0] == 0


def test_settings_of_sensors_are_known_and_layouts_hold_probes() -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match="did you mean 'stiffness'"):
        sensors_for("force", hand.layout("low", "tips"), stifness=3)
    for layout in ({}, {hand.palm: np.zeros((1, 3))}):
        with pytest.raises(UsageError, match="layout"):
            hand.with_probes(layout)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("facing", (0, 0, 0)),
        ("facing", (np.nan, 0, 1)),
        ("extent", -1.0),
        ("extent", np.nan),
        ("rows", 0),
        ("rows", 1.5),
    ],
)  # fmt: skip
def test_grids_are_cast_by_numbers(name, value) -> None:
    hand = load("xhand1")
    with pytest.raises(UsageError, match=name):
        cast_grid(hand.model, hand.palm, **{"rows": 2, "columns": 2, "facing": (1, 0, 0), "radius": 0.004, name: value})


def test_without_touch_no_tactile_sensor_is_built() -> None:
    env = make_env(1)
    assert env.touch is None
    assert "tactile" not in env.observations


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_every_observation_type_feels_the_objects_of_a_task(kind: str) -> None:
    # Blocks and cylinders share one batch: each has the other's solid as a grain.
    env = make_env(2, observe=kind, placement="tips", resolution="low")
    observations = env.step(torch.zeros(2, env.num_actions))[0]
    assert ("tactile" in observations) == (observation_type(kind).sensor is not None)
    assert all(value.isfinite().all() for value in observations.values())


@pytest.mark.parametrize("kind", ["force_torque", "agg_bool", "agg_force"])
def test_touch_is_what_the_sensors_of_the_hand_read(kind: str) -> None:
    from robotics_bridge.sensors import SensorSuite

    # Springs remember what they held, which sensors that come later cannot know.
    knobs: dict = {"total": "engine"} if kind == "force_torque" else {}
    env = make_env(2, observe=kind, placement="hand", resolution="low", knobs=knobs)
    assert env.touch is not None
    taxels = env.hand.layout("low", "hand")
    suite = SensorSuite(env.simulation.engine.scene, sensors_for(kind, taxels, track=("object",), **knobs), num_envs=2)
    suite.reset()
    env.reset()
    for a in random_actions(env, 8):
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
    env = make_env(2, calm_task(), observe="force_torque", placement="palm", resolution="med")
    assert env.observations["tactile"].abs().sum() == 0
    for _ in range(20):
        env.step(torch.zeros(2, 5))
    reading = env.observations["tactile"]
    assert (reading[..., 0].sum(dim=(1, 2)).abs() > 0).all()
    before = reading[1].clone()
    env.reset(torch.tensor([True, False]))
    assert env.observations["tactile"][0].abs().sum() == 0
    assert torch.equal(env.observations["tactile"][1], before)
