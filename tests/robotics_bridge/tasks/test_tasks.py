"""Tasks as data: registry, goals, objects, scenes, reset, thermometers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.core.rotations import about, angle_of, conjugate, multiply, rotate, six_numbers, twist_and_swing
from robotics_bridge import hands, tasks
from robotics_bridge.envs import reset
from robotics_bridge.envs.step import step_context
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.goals import SteppingRotation, TimedRotation
from robotics_bridge.tasks.objects import CUBES, box, cylinder, screwdriver, slots, with_sizes
from robotics_bridge.tasks.registry import apply_overrides
from robotics_bridge.tasks.scenes import build, drives_of, palm_up
from robotics_bridge.tasks.task import ObjectRandomisation, Task

MY_TASK = """
from dataclasses import replace
from robotics_bridge import tasks
from robotics_bridge.tasks import terms

@tasks.register("keep_still")
def keep_still() -> tasks.Task:
    rotate = tasks.load("in_palm_rotate")
    rewards = {"stay": tasks.Reward(-10.0, terms.far_from, {"target": None, "margin": 0.0})}
    return replace(rotate, name="keep_still", text="hold a block still", rewards=rewards, goal=None, goal_terms=(),
                   endings={}, auxiliary=(), decoders=(),
                   groups={"actor": ("priv_proprio", "priv_obj_state"), "student": ("proprio",)})
"""


def test_a_task_of_ones_own_is_one_file(tmp_path: Path) -> None:
    from brainbench.core.plugins import load_module

    file = tmp_path / "keep_still.py"
    file.write_text(MY_TASK)
    load_module(str(file))
    try:
        assert "keep_still" in tasks.list_tasks()
        env = tasks.make("keep_still", num_envs=2, threads=1)
        observations, reward, *_ = env.step(torch.zeros(2, env.num_actions))
        assert set(observations) == {"proprio", "priv_proprio", "priv_obj_state"}
        assert (reward <= 0).all()
        with pytest.raises(UsageError, match="already"):
            load_module(str(file))
    finally:
        tasks.forget("keep_still")
    assert "keep_still" not in tasks.list_tasks()


def test_unknown_names_are_met_with_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'screwdriver'"):
        tasks.load("screwdrivr")
    with pytest.raises(UsageError, match="did you mean 'published'"):
        tasks.load("screwdriver", "publish")
    with pytest.raises(UsageError, match="'priv_obj_stat'; did you mean"):
        replace(tasks.load("screwdriver"), groups={"actor": ("priv_obj_stat",)})
    with pytest.raises(UsageError, match=r"'screwdriver' .*received 0\.0"):
        replace(tasks.load("screwdriver"), episode=0.0)
    with pytest.raises(UsageError, match="range"):
        replace(tasks.load("screwdriver"), object_changes=ObjectRandomisation(friction=(2.0, 1.0)))


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


def test_shapes_share_their_slots_and_scale_in_all_lengths() -> None:
    shapes = (box(0.04, 0.05, 0.06), screwdriver(0.2, 0.1, 0.02, 0.004))
    assert slots(shapes) == ("box", "capsule", "cylinder")
    sizes = with_sizes(shapes, (0.5, 2.0))
    assert len(sizes) == 16
    assert sizes[0].extent == pytest.approx((0.02, 0.025, 0.03))
    assert max(shape.solids[0].position for shape in sizes) == pytest.approx((0.0, 0.3, 0.0))
    assert with_sizes(shapes, (1.0, 1.0)) == shapes
    with pytest.raises(UsageError, match=r"size .*received \(0\.0, 1\.0\)"):
        with_sizes(shapes, (0.0, 1.0))
    with pytest.raises(UsageError, match=r"received 0\.2 m of 0\.1 m"):
        screwdriver(0.1, 0.2, 0.02, 0.004)


@pytest.mark.parametrize("count", [1, 2, 3, 6, 8, 17])
def test_a_few_environments_have_objects_of_all_sizes(count: int) -> None:
    shapes = tuple(box(0.01 * (index + 1), 0.02, 0.02) for index in range(count))
    edges = np.array([shape.extent for shape in with_sizes(shapes, (0.5, 1.5))])
    np.testing.assert_allclose(np.sort(edges[:8, 1]), 0.02 * np.linspace(0.5, 1.5, 8))
    assert len(np.unique(edges.round(9), axis=0)) == 8 * count


def test_blocks_weigh_what_their_density_says() -> None:
    task = tasks.load("in_palm_rotate")
    model = build(task, hands.load("xhand1"))
    for each, shape in zip(model.models, model.shapes, strict=True):
        body = each.body("object").id
        volume = np.prod(shape.extent) * (np.pi / 4 if shape.name.startswith("cylinder") else 1)
        assert each.body_mass[body] == pytest.approx(task.density * volume, rel=1e-6)


@pytest.mark.parametrize(("hand", "published"), [("xhand1", (0.07, 0.0, 0.475)), ("sharpa", (0.07, -0.015, 0.48))])
def test_palms_of_other_hands_are_turned_up_where_the_published_ones_are(hand: str, published: Any) -> None:
    position, quaternion = palm_up(hands.load(hand))
    assert position == pytest.approx(published, abs=0.015)
    turn = multiply(torch.tensor([quaternion]), torch.tensor([[0.70710678, 0.0, 0.70710678, 0.0]]))
    assert float(angle_of(turn)) < 0.2


def test_only_links_that_can_meet_collide() -> None:
    model = build(tasks.load("in_hand_repose"), hands.load("xhand1")).models[0]
    left_out = {tuple(sorted((int(s) >> 16, int(s) & 0xFFFF))) for s in model.exclude_signature}
    thumb, index = (model.body(f"right_hand_{name}").id for name in ("thumb_rota_link2", "index_rota_link2"))
    assert tuple(sorted((thumb, index))) not in left_out
    palm, base = model.body("right_hand_link").id, model.body("right_hand_mid_link1").id
    assert tuple(sorted((palm, base))) in left_out


def test_a_finger_that_the_hand_lacks_is_named() -> None:
    task = replace(tasks.load("in_palm_rotate"), moves=("tentacle",))
    with pytest.raises(UsageError, match=r"tentacle; .*'xhand1' .*index"):
        build(task, hands.load("xhand1"))
    with pytest.raises(UsageError, match=r"'xhand1': 'elbow'.*thumb"):
        build(replace(tasks.load("in_palm_rotate"), joints={"xhand1": {"elbow": 1.0}}), hands.load("xhand1"))


def test_a_word_of_every_fingers_links_names_no_finger(tmp_path: Path) -> None:
    """Middle phalanges, as of the Shadow hand, are no middle fingers; a part that is missing is not passed over."""
    finger = (
        '<body name="{0}proximal" pos="0 {1} .05"><joint name="{0}1" axis="0 1 0" range="0 1.6"/><geom type="capsule" '
        'size=".01" fromto="0 0 0 0 0 .04"/><body name="{0}middle" pos="0 0 .05"><joint name="{0}2" axis="0 1 0" '
        'range="0 1.6"/><geom type="capsule" size=".01" fromto="0 0 0 0 0 .04"/><body name="{0}distal" pos="0 0 .05">'
        '<geom type="sphere" size=".01"/></body></body></body>'
    )
    fingers = "".join(finger.format(name, y) for name, y in (("th", -0.05), ("mf", 0.0), ("ff", 0.05)))
    text = f'<body name="palm"><geom type="box" size=".02 .06 .04"/>{fingers}</body>'
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{text}</worldbody></mujoco>'
    )
    hand, task = hands.load(tmp_path / "hand.xml"), tasks.load("in_palm_rotate")
    assert build(replace(task, moves=("th", "mf")), hand).moved == ("th1", "th2", "mf1", "mf2")
    for moves in (("thumb", "mid"), ("th", "mid")):
        with pytest.raises(UsageError, match=r"thdistal, mfdistal, ffdistal.*moves="):
            build(replace(task, moves=moves), hand)


def test_sampled_grasps_hold_without_any_action() -> None:
    task = replace(tasks.load("screwdriver"), push=None, object_changes=ObjectRandomisation())
    env = tasks.make(task, num_envs=8, threads=1)
    start = env.object_pose[:, 0, :3].clone()
    # In published terms: three finger tips nearer than 2 cm, and the tool does not move by a centimetre.
    assert ((env.state.contacts.surface_distance < 0.02).sum(dim=1) >= 3).all()
    for _ in range(20):
        env.step(torch.zeros(8, env.num_actions))
    moved = (env.object_pose[:, 0, :3] - start).norm(dim=1)
    assert float(moved.quantile(0.8)) < 0.01
    assert float(terms.alignment(step_context(env.state), (0.0, 1.0, 0.0)).median()) > 0.98


def test_grasps_of_another_friction_or_solver_are_sampled_anew(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    task, hand, sampled = tasks.load("screwdriver"), hands.load("xhand1"), []

    def sample(task: Task, *others: Any) -> dict[str, np.ndarray]:
        sampled.append((task.friction, task.solver.timestep))
        return {"joints": np.zeros((16, 12)), "target": np.zeros((16, 12)), "object": np.zeros((16, 7))}

    monkeypatch.setattr(reset, "sample", sample)
    for changes in ([], ["friction=0.8"], ["solver.timestep=0.004"], [], ["friction=0.8"]):
        changed = apply_overrides(task, changes)
        reset.grasps_for(changed, hand, build(changed, hand))
    assert sampled == [(1.0, 0.005)] * 4 + [(0.8, 0.005)] * 4 + [(1.0, 0.004)] * 4


def test_the_latch_needs_the_heat_of_the_hot_ball() -> None:
    from robotics_bridge.tasks.hot_ball import ThermalSettings, progress

    thermal = ThermalSettings()
    reading = torch.tensor([10.0, 22.0, 33.5, 42.3, 60.0])
    assert progress(reading, thermal).tolist() == pytest.approx([0.0, 0.0, 0.5, 0.8826, 1.0], abs=1e-4)
    env = tasks.make("hot_ball", num_envs=2, threads=1)
    thermometers: Any = env.state.task_state
    assert (thermometers.temperature() == 22.0).all()
    assert env.observations["thermal"].abs().max() < 1e-5
    env.step(torch.zeros(2, env.num_actions))
    assert not thermometers.latched.any()
    assert env.state.episode.metric.tolist() == [0.0, 0.0]
    with pytest.raises(UsageError, match=r"received 10\.0 and 22\.0"):
        ThermalSettings(hot=10.0)


@pytest.mark.slow
def test_a_hand_that_holds_the_hot_ball_succeeds_by_default_alone() -> None:
    from robotics_bridge.tasks.hot_ball import ThermalSettings, Thermometers

    env = tasks.make("hot_ball", num_envs=2, seed=0, threads=1)
    thermometers: Any = env.state.task_state
    published = Thermometers(env.state, ThermalSettings(), chooses=False)
    slides = [env.action_names.index(f"carriage_{axis}") for axis in "xyz"]
    scale = torch.as_tensor(env.action_map.scale[slides], dtype=torch.float32)
    middle = env.state.contacts.tip_links[list(env.model.tips).index("right_hand_mid_link2")]
    at, pressed, held = torch.zeros(2, 3), torch.zeros(2), torch.zeros(2)
    for step in range(250):
        # The middle finger follows the ball from above, and is pressed down once it is there.
        way = env.state.target_pose[:, :3] - env.state.simulation.pose[:, middle, :3]
        over = way[:, :2].norm(dim=1) < 0.02
        pressed = torch.where(over, pressed + 0.0015 * ~thermometers.touching, torch.zeros(2)) if step > 60 else pressed
        way[:, 2] += torch.where(over, 0.075 - pressed.clamp(max=0.05), torch.tensor(0.12))
        at = at + 0.2 * way.clamp(-0.05, 0.05) * (step > 60)
        action = torch.zeros(2, env.num_actions)
        action[:, slides] = at / scale
        _, _, _, _, info = env.step(action)
        published.after_physics_step(env.step_dt)
        published.update_latch(env.step_dt)
        held += env.step_dt * thermometers.touching
    assert (held > 3).all()
    assert (info["metric"] > 0).float().mean() >= 0.75
    assert not published.latched.any()


def test_the_carriage_moves_no_faster_than_an_arm() -> None:
    task = tasks.load("hot_ball")
    env = tasks.make(task, num_envs=2, threads=1)
    slides = [env.action_names.index(f"carriage_{axis}") for axis in "xyz"]
    targets = env.state.actuators.target
    before = targets[:, slides].clone()
    env.step(torch.full((2, env.num_actions), 2.0))
    most = task.carriage_speed * env.step_dt
    assert (targets[:, slides] - before).flatten().tolist() == pytest.approx([most] * 6)
    # As high as published, counted from a lower start.
    published = tasks.load("hot_ball", "published")
    reach = [t.hand_poses["xhand1"][0][2] + np.array(t.carriage["z"][0]) for t in (task, published)]
    assert reach[0] == pytest.approx(reach[1])


@pytest.mark.parametrize(("joint", "servo", "effort"), [
    ("", "", 1.57), ("", 'forcerange="-.7 .7"', 0.7), ('actuatorfrcrange="-.5 .5"', "", 0.5),
    ('actuatorfrcrange="-.5 .5"', 'forcerange="-.7 .7"', 0.5),
])  # fmt: skip
def test_drives_are_no_stronger_than_a_file_says_and_noise_is_in_units_of_that(tmp_path, joint, servo, effort) -> None:
    jaws = "".join(
        f'<body pos="0 {y} .05"><joint name="{name}" axis="1 0 0" range="0 1.57" {joint}/>'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>'
        for name, y in (("a", 0.2), ("b", -0.2))
    )
    servos = "".join(f'<position joint="{name}" kp="1" kv=".1" {servo}/>' for name in "ab")
    (tmp_path / "hand.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="palm">'
        f'<geom type="box" size=".05 .05 .01"/>{jaws}</body></worldbody><actuator>{servos}</actuator></mujoco>'
    )
    found = drives_of(hands.load(str(tmp_path / "hand.xml")))
    assert found == {name: pytest.approx((1.0, 0.1, effort)) for name in "ab"}
