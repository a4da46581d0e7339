"""Friction at rest: springs against closed forms, weights that are held, slip, and what must not drift."""

from __future__ import annotations

from typing import Any, Literal

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brainbench.core.errors import UsageError
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import KinematicTaxel, Noise, Probes, SensorSuite
from tests.factories.touch_scenes import move_all, pad_scene, poses_at, state_of

Total = Literal["law", "engine"]
GRID = Probes.grid(4, 5, size=(0.012, 0.016), center=(0, 0, 0.005), radius=0.002)
SLAB = Geometry(name="slab", link="slab", kind="box", size=(0.03, 0.03, 0.003))
DEPTH = 0.0022
"""Depth of every taxel below the slab (m): its radius and 0.2 mm."""
PUSH = 500 * DEPTH**1.2
"""Normal force on it (N)."""
MU, GRIP = 0.5, 2 / 3


class Slide:
    """A slab on a pad, moved by hand; readings [20, 6] after every move."""

    def __init__(self, envs: int = 1, scene: TouchScene | None = None, **options: Any) -> None:
        self.scene, self.envs = scene or pad_scene(SLAB), envs
        taxel = KinematicTaxel(**{"link": "hand", "probes": GRID, "friction": MU, **options})
        self.suite = SensorSuite(self.scene, {"t": taxel}, num_envs=envs)

    def to(self, x: float, *, turn: float = 0.0, lift: float = 0.0, motion: np.ndarray | None = None) -> np.ndarray:
        poses = poses_at(len(self.scene.links), {2: (x, 0, 0.005 + 0.003 - 0.0002 + lift)}, self.envs)
        poses[:, 2, 3:] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
        velocity = np.zeros((*poses.shape[:2], 6))
        if motion is not None:
            poses, velocity = move_all(poses, velocity, motion)
        self.suite.update(state_of(self.scene, poses, velocity, touch=lift < 0.002))
        return self.suite.read("t").flatten(1, 2).numpy().astype(float).copy()[0]


def test_a_spring_holds_up_to_the_limit_of_coulomb_and_slides_beyond() -> None:
    slide = Slide()
    stiffness = GRIP * PUSH / DEPTH
    assert np.abs(slide.to(0)[:, 0]).max() == 0
    for way in (2e-4, 8e-4, -3e-4):
        np.testing.assert_allclose(slide.to(way)[:, 0], stiffness * way, rtol=1e-4)
        np.testing.assert_allclose(slide.to(way)[:, 2], -PUSH, rtol=1e-4)
    # The spring breaks at μ d / ρ = 1.65 mm, in the step in which it is passed, and is dragged along.
    limit = MU * DEPTH / GRIP
    np.testing.assert_allclose(slide.to(0.004)[:, 0], MU * PUSH, rtol=1e-4)
    np.testing.assert_allclose(slide.to(0.004)[:, 0], MU * PUSH, rtol=1e-4)
    np.testing.assert_allclose(slide.to(0.004 - limit)[:, 0], 0, atol=1e-4 * PUSH)
    np.testing.assert_allclose(slide.to(-0.004)[:, 0], -MU * PUSH, rtol=1e-4)


@pytest.mark.slow
def test_nothing_drifts_in_two_thousand_steps_of_trembling() -> None:
    slide = Slide()
    slide.to(0)
    rng = np.random.default_rng(0)
    for _ in range(2000):
        slide.to(float(rng.uniform(-1e-3, 1e-3)))
    np.testing.assert_allclose(slide.to(5e-4)[:, 0], GRIP * PUSH / DEPTH * 5e-4, rtol=1e-3)


def test_motion_of_hand_and_object_together_changes_nothing() -> None:
    slide, rng = Slide(), np.random.default_rng(1)
    slide.to(0)
    still = slide.to(4e-4, turn=0.02)
    for _ in range(20):
        motion = np.concatenate([rng.uniform(-0.1, 0.1, 3), np.roll(Rotation.random(rng=rng).as_quat(), 1)])
        np.testing.assert_allclose(slide.to(4e-4, turn=0.02, motion=motion), still, atol=2e-3 * PUSH)


def test_an_object_that_turns_on_the_spot_is_held_by_a_moment() -> None:
    slide = Slide()
    slide.to(0)
    read = slide.to(0, turn=0.05)
    places = np.asarray(GRID.position)
    stiffness = GRIP * PUSH / DEPTH
    moment = stiffness * 0.05 * (places[:, :2] ** 2).sum()
    np.testing.assert_allclose(read[:, :2].sum(0), 0, atol=1e-3 * PUSH)
    assert read[:, 5].sum() == pytest.approx(moment, rel=2e-3)


def test_what_is_let_go_or_reset_or_changed_is_held_anew() -> None:
    slide = Slide(envs=2)
    slide.to(0)
    assert np.abs(slide.to(5e-4)[:, 0]).min() > 0.1 * PUSH
    slide.to(5e-4, lift=0.01)
    assert np.abs(slide.to(5e-4)[:, 0]).max() < 1e-6
    slide.to(8e-4)
    slide.suite.reset([0])
    slide.to(8e-4)
    first, second = slide.suite.read("t").flatten(1, 2).numpy()[..., 0]
    assert np.abs(first).max() < 1e-6
    assert np.abs(second).min() > 0.05 * PUSH


def test_another_body_is_held_anew_and_parts_of_one_body_are_one() -> None:
    halves = [
        Geometry(name=f"{link}{n}", link=link, kind="box", size=(0.03, 0.015, 0.003), position=(0, 0.015 * s, 0))
        for link in ("slab", "other") for n, s in enumerate((-1, 1))
    ]  # fmt: skip
    slide = Slide(scene=pad_scene(*halves))

    def read(x: float, below: int) -> np.ndarray:
        poses = poses_at(4, {below: (x, 0.004 * x / 1e-3, 0.0078), 5 - below: (0, 0, 1)})
        slide.suite.update(state_of(slide.scene, poses))
        return slide.suite.read("t").flatten(1, 2).numpy()[0, :, 0]

    read(0, 2)
    # The seam between the halves passes below taxels, which go on holding.
    np.testing.assert_allclose(read(3e-4, 2), GRIP * PUSH / DEPTH * 3e-4, rtol=0.7)
    assert (read(3e-4, 2) > 0).all()
    assert np.abs(read(3e-4, 3)).max() < 1e-6


def test_a_lost_environment_reads_nan_and_holds_nothing_after_its_reset() -> None:
    slide = Slide(envs=2)
    slide.to(0)
    poses = poses_at(3, {2: (5e-4, 0, 0.0078)}, 2)
    poses[1, 2, 0] = np.nan
    slide.suite.update(state_of(slide.scene, poses))
    assert slide.suite.read("t")[1].isnan().all()
    assert (slide.suite.read("t")[0, ..., 0] > 0).all()
    slide.suite.reset([1])
    slide.to(9e-4)
    assert slide.suite.read("t")[1, ..., 0].abs().max() < 1e-6


@pytest.mark.parametrize("total", ["law", "engine"])
@pytest.mark.parametrize("noise", [Noise(gain=(2.0, 2.0)), Noise(hysteresis=0.1, white=1e-4), Noise(crosstalk=0.3)])
def test_noise_leaves_the_truth_alone(total: Total, noise: Noise) -> None:
    clean, noisy = Slide(total=total), Slide(total=total, noise=noise)
    contact = {"position": [(0, 0, 0.005)], "normal": [(0, 0, 1)], "force": [3.0], "friction": [(-0.5, 0, 0)]}
    for x in (0, 3e-4, 6e-4, 3e-3):
        state = HandState.empty(1, 3, 1)
        state.set_pose(poses_at(3, {2: (x, 0, 0.0078)}))
        state.set_contacts([0], [(0, 1)], **contact)
        for slide in (clean, noisy):
            slide.suite.update(state)
        np.testing.assert_array_equal(noisy.suite.read_ground_truth("t"), clean.suite.read_ground_truth("t"))
        assert noisy.suite.read("t").isfinite().all()
    assert not np.allclose(noisy.suite.read("t"), clean.suite.read("t"), rtol=1e-6)
    if noise.gain == (2.0, 2.0) and total == "law":
        # Normal force and limit of friction grow alike.
        read, truth = (noisy.suite.read("t").numpy(), clean.suite.read("t").numpy())
        np.testing.assert_allclose(read[..., :3], truth[..., :3] * 2**1.2, rtol=1e-4)


GRIPPER = """<mujoco><option timestep="0.002" cone="elliptic" impratio="10"/><worldbody>
<body name="left"><geom name="l" type="box" size=".005 .02 .02" friction="1"/></body>
<body name="right" pos=".0302 0 0"><joint name="j" type="slide" axis="1 0 0" damping="5"/>
 <geom type="box" size=".005 .02 .02" friction="1" mass=".1"/></body>
<body name="block" pos=".0151 0 0"><freejoint/><geom type="box" size=".01 .012 .012" mass=".1" friction="1"/></body>
</worldbody><actuator><motor joint="j"/></actuator></mujoco>"""


@pytest.mark.slow
def test_a_block_held_against_gravity_reads_its_weight_for_ten_seconds_and_slip_in_one_step() -> None:
    engine = MujocoEngine(mujoco.MjModel.from_xml_string(GRIPPER), 1)
    sensors = {
        side: KinematicTaxel(
            link=side, track=("block",), total="engine", friction=1.0,
            probes=Probes.grid(6, 6, size=(0.03, 0.03), center=(0.005 * s, 0, 0), normal=(s, 0, 0), along=(0, 1, 0),
                               radius=0.002),
        ) for side, s in (("left", 1), ("right", -1))
    }  # fmt: skip
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    engine.set(ctrl=np.array([[-5.0]]))
    held = []

    def lifted() -> float:
        engine.step()
        suite.update(engine.state, engine.timestep)
        return -sum(float(suite.read(side)[..., 2].sum()) for side in sensors)

    for step in range(5500):
        weight = lifted()
        if step >= 500:
            held.append(weight)
    np.testing.assert_allclose(held, 0.1 * 9.81, rtol=0.03)
    # The grip is loosened below what the weight needs: the step in which the block begins to slide reads the friction
    # that is left, μ times the normal forces of that step.
    engine.set(ctrl=np.array([[-0.15]]))
    for _ in range(50):
        carried = lifted()
        pressed = sum(abs(float(suite.read(side)[..., 0].sum())) for side in sensors)
        if engine.state.velocity_torch[0, 3, 2] < -2e-3:
            break
    assert carried == pytest.approx(pressed, rel=0.03)
    assert carried < 0.97 * 0.1 * 9.81


def test_friction_that_the_law_cannot_have_is_refused() -> None:
    for wrong, word in (
        ({"friction": -1.0}, "friction .*at least 0"),
        ({"friction": 1.0, "grip": 0.0}, "grip"),
        ({"friction": 1.0, "convention": "thesis"}, "thesis"),
    ):
        with pytest.raises(UsageError, match=word):
            KinematicTaxel(link="hand", probes=GRID, **wrong)  # type: ignore[arg-type]
