"""Kinematic taxels with the engine's total: every contact force arrives, where it acts and nowhere else."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robotics_bridge.physics import Geometry, HandState, MujocoEngine, MujocoWarpEngine, TouchScene
from robotics_bridge.sensors import KinematicTaxel, Noise, Probes, SensorSuite
from tests.factories.touch_scenes import pad_scene, poses_at, rotation_of

Convention = Literal["physical", "thesis"]
TOP = Probes.grid(14, 14, size=(0.036, 0.036), center=(0, 0, 0.005), radius=0.001)
BOTTOM = Probes(TOP.position * np.array([1, 1, -1]), -np.asarray(TOP.normal), TOP.radius)


def _read(scene: TouchScene, state: HandState, **options: Any) -> tuple[np.ndarray, SensorSuite]:
    suite = SensorSuite(scene, {"t": KinematicTaxel(**{"link": "hand", "total": "engine", **options})}, num_envs=1)
    suite.update(state)
    return suite.read("t").flatten(0, -2).numpy().astype(float), suite


def _both_faces() -> Probes:
    return Probes(*(np.concatenate(pair) for pair in zip(
        *((p.position, p.normal, p.radius) for p in (_flat(TOP), _flat(BOTTOM))), strict=True)))  # fmt: skip


def _flat(probes: Probes) -> Probes:
    return Probes(probes.position.reshape(-1, 3), np.reshape(probes.normal, (-1, 3)), np.reshape(probes.radius, -1))


def _balls(count: int, rng: np.random.Generator) -> tuple[TouchScene, HandState, np.ndarray, np.ndarray]:
    """Balls that press a pad from both sides, with forces of any direction within the cone; the hand lies anyhow."""
    radii = rng.uniform(0.004, 0.012, count)
    scene = pad_scene(
        *(Geometry(name=f"ball{n}", link=f"ball{n}", kind="sphere", size=(r,)) for n, r in enumerate(radii))
    )
    side, overlap = rng.choice([-1.0, 1.0], count), rng.uniform(2e-4, 1e-3, count)
    at = np.c_[rng.uniform(-0.015, 0.015, (count, 2)), side * (0.005 + radii - overlap)]
    turn, origin = Rotation.random(rng=rng), rng.uniform(-0.1, 0.1, 3)
    poses = poses_at(2 + count, {})
    poses[0, 1] = [*origin, *np.roll(turn.as_quat(), 1)]
    poses[0, 2:, :3] = turn.apply(at) + origin
    normal = turn.apply(np.c_[np.zeros((count, 2)), side])
    load = rng.uniform(0.1, 10, count)
    slip = turn.apply(np.c_[rng.uniform(-0.5, 0.5, (count, 2)) * load[:, None], np.zeros(count)])
    # Contacts name the pad first or second, as an engine may.
    flipped = rng.random(count) < 0.5
    sign = np.where(flipped, -1.0, 1.0)[:, None]
    state = HandState.empty(1, 2 + count, count)
    state.set_pose(poses)
    state.set_contacts(
        np.zeros(count),
        [(n + 1, 0) if back else (0, n + 1) for n, back in enumerate(flipped)],
        distance=-overlap,
        position=turn.apply(np.c_[at[:, :2], side * (0.005 - overlap / 2)]) + origin,
        normal=sign * normal,
        force=load,
        friction=sign * slip,
    )
    return scene, state, turn.inv().apply(-load[:, None] * normal), turn.inv().apply(-slip)


@pytest.mark.parametrize("convention", ["physical", "thesis"])
@pytest.mark.parametrize("seed", range(8))
def test_taxels_add_up_to_the_contact_forces_of_random_scenes(seed: int, convention: Convention) -> None:
    rng = np.random.default_rng(seed)
    scene, state, push, slip = _balls(int(rng.integers(1, 7)), rng)
    read, suite = _read(scene, state, probes=_both_faces(), convention=convention)
    expected = (push + (1 if convention == "physical" else -1) * slip).sum(0)
    scale = np.linalg.norm(push, axis=1).sum()
    np.testing.assert_allclose(read[:, :3].sum(0), expected, atol=1e-4 * scale)
    assert not suite.unfelt.any()


def test_a_pinched_link_reads_the_force_on_each_side() -> None:
    """10 N from above and from below: their vector sum is zero, the readings are not."""
    scene = pad_scene(*(Geometry(name=n, link=n, kind="sphere", size=(0.01,)) for n in ("above", "below")))
    state = HandState.empty(1, 4, 2)
    state.set_pose(poses_at(4, {2: (0, 0, 0.0145), 3: (0, 0, -0.0145)}))
    state.set_contacts(
        [0, 0], [(0, 1), (0, 2)], distance=[-5e-4] * 2, position=[(0, 0, 0.00475), (0, 0, -0.00475)],
        normal=[(0, 0, 1), (0, 0, -1)], force=[10, 10],
    )  # fmt: skip
    read, _ = _read(scene, state, probes=_both_faces())
    half = len(read) // 2
    assert read[:half, 2].sum() == pytest.approx(-10, rel=1e-5)
    assert read[half:, 2].sum() == pytest.approx(10, rel=1e-5)


def test_one_body_that_pinches_from_both_sides_is_told_apart() -> None:
    """The jaws of one link, with contacts that lie nearer to the other side's taxels than their own do."""
    jaws = [
        Geometry(name=n, link="clamp", kind="box", size=(0.02, 0.02, 0.002), position=(0, 0, z))
        for n, z in (("up", 0.0065), ("down", -0.0065))
    ]
    scene = pad_scene(*jaws)
    state = HandState.empty(1, 3, 2)
    state.set_pose(poses_at(3, {}))
    state.set_contacts(
        [0, 0], [(0, 1), (0, 2)], distance=[-5e-4] * 2, position=[(0.01, 0, 0.005), (-0.01, 0, -0.005)],
        normal=[(0, 0, 1), (0, 0, -1)], force=[3, 7],
    )  # fmt: skip
    read, _ = _read(scene, state, probes=_both_faces())
    half = len(read) // 2
    assert read[:half, 2].sum() == pytest.approx(-3, rel=1e-5)
    assert read[half:, 2].sum() == pytest.approx(7, rel=1e-5)


def test_taxels_that_graze_beside_a_contact_do_not_receive_it() -> None:
    """Four taxels at one end of a lying bar, whose load rests on the other end; the suite says what is missing."""
    grid = Probes.grid(2, 2, size=(0.004, 0.004), center=(0.015, 0, 0.005), radius=0.001)
    scene = pad_scene(Geometry(name="bar", link="bar", kind="box", size=(0.019, 0.002, 0.002)))
    state = HandState.empty(1, 3, 2)
    state.set_pose(poses_at(3, {2: (0, 0, 0.007)}))
    contact = {"distance": [0.0], "normal": [(0, 0, 1)], "force": [10.0]}
    state.set_contacts([0], [(0, 1)], position=[(-0.015, 0, 0.005)], **contact)
    read, suite = _read(scene, state, probes=grid)
    assert not read.any()
    assert suite.unfelt.all()
    state.set_contacts([0], [(0, 1)], position=[(0.015, 0, 0.005)], **contact)
    read, suite = _read(scene, state, probes=grid)
    assert read[:, 2].sum() == pytest.approx(-10, rel=1e-5)
    assert not suite.unfelt.any()


def test_each_contact_presses_where_it_acts() -> None:
    """Two balls, 1 N and 9 N, on two halves of a pad: each half reads its own."""
    scene = pad_scene(*(Geometry(name=n, link=n, kind="sphere", size=(0.006,)) for n in ("a", "b")))
    state = HandState.empty(1, 4, 2)
    state.set_pose(poses_at(4, {2: (-0.01, 0, 0.0105), 3: (0.01, 0, 0.0105)}))
    state.set_contacts(
        [0, 0], [(0, 1), (0, 2)], distance=[-5e-4] * 2, position=[(-0.01, 0, 0.00475), (0.01, 0, 0.00475)],
        normal=[(0, 0, 1)] * 2, force=[1, 9],
    )  # fmt: skip
    read, _ = _read(scene, state, probes=TOP)
    left = np.reshape(TOP.position, (-1, 3))[:, 0] < 0
    assert read[left, 2].sum() == pytest.approx(-1, rel=1e-5)
    assert read[~left, 2].sum() == pytest.approx(-9, rel=1e-5)
    # Torque about the link's origin: r × f of the two loads, to within the pitch.
    assert read[:, 4].sum() == pytest.approx(0.01 * 9 - 0.01 * 1, rel=0.02)


def test_a_force_that_the_engine_does_not_tell_reads_nan_where_it_acts() -> None:
    scene = pad_scene(Geometry(name="a", link="a", kind="sphere", size=(0.006,)))
    state = HandState.empty(1, 3, 1)
    state.set_pose(poses_at(3, {2: (0, 0, 0.0105)}))
    state.set_contacts([0], [(0, 1)], position=[(0, 0, 0.005)], normal=[(0, 0, 1)])
    read, _ = _read(scene, state, probes=TOP)
    assert np.isnan(read).any()
    assert (read[0] == 0).all()


def test_gain_of_the_noise_scales_the_measured_branch_alone() -> None:
    rng = np.random.default_rng(3)
    scene, state, push, slip = _balls(2, rng)
    noise = Noise(gain=(2.0, 2.0))
    _, suite = _read(scene, state, probes=_both_faces(), noise=noise, exponent=1.0)
    truth, measured = (suite.read_ground_truth("t").numpy(), suite.read("t").numpy())
    np.testing.assert_allclose(truth[0, :, :3].sum(0), (push + slip).sum(0), atol=1e-3)
    np.testing.assert_allclose(measured, 2 * truth, atol=1e-5)


MODEL = """<mujoco><option timestep="0.002" cone="{cone}" gravity="0 0 -9.81" impratio="10"/><worldbody>
<body name="hand" euler="0 {tilt} 0"><geom name="pad" type="box" size=".02 .02 .005" condim="{condim}"/></body>
{objects}</worldbody></mujoco>"""
THINGS = ('type="box" size=".005 .006 .005"', 'type="cylinder" size=".005 .005"')


def _slope(seed: int) -> Any:
    """Two boxes and a cylinder at rest on a tilted pad, with one of the two friction cones."""
    import mujoco

    rng = np.random.default_rng(seed)
    tilt, cone, condim = rng.uniform(2, 15), ("pyramidal", "elliptic")[seed % 2], (3, 4, 6)[seed % 3]
    turn = Rotation.from_euler("y", tilt, degrees=True)
    places = [(-0.012, -0.012), (0.012, 0.0), (-0.012, 0.012)]
    quat = " ".join(map(str, np.roll(turn.as_quat(), 1)))
    objects = "".join(
        f'<body name="o{n}" pos="{" ".join(map(str, turn.apply((x, y, 0.0099))))}" quat="{quat}"><freejoint/>'
        f'<geom {THINGS[n % 2]} mass="{m}" condim="{condim}" friction="1 .01 .001"/></body>'
        for n, ((x, y), m) in enumerate(zip(places, rng.uniform(0.05, 0.5, 3), strict=True))
    )
    return mujoco.MjModel.from_xml_string(MODEL.format(cone=cone, condim=condim, tilt=tilt, objects=objects))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_engine_of_the_gpu_tells_the_same_friction(seed: int) -> None:
    pytest.importorskip("mujoco_warp")
    model, totals = _slope(seed), []
    for engine in (MujocoEngine(model, 1), MujocoWarpEngine(model, 1, device="cpu")):
        engine.step(400)
        suite = SensorSuite(engine.scene, {"t": KinematicTaxel(link="hand", probes=TOP, total="engine")}, num_envs=1)
        suite.update(engine.state)
        totals.append(suite.read("t").sum((0, 1, 2)).numpy()[:3])
    assert abs(totals[0][0]) > 0.1
    np.testing.assert_allclose(totals[1], totals[0], atol=0.02 * np.abs(totals[0]).max())


@pytest.mark.parametrize("seed", range(6))
def test_taxels_carry_weight_and_friction_of_what_rests_on_a_slope(seed: int) -> None:
    """MuJoCo's own sum of contact forces (mj_contactForce) and, at rest, m g: normal and along the slope."""
    import mujoco

    engine = MujocoEngine(_slope(seed), 1)
    engine.step(400)
    model, data = engine.model, engine.data[0]
    expected, force = np.zeros(3), np.zeros(6)
    for index in range(data.ncon):
        mujoco.mj_contactForce(model, data, index, force)
        # It acts on the second geometry; geometry 0 is the pad.
        sign = -1 if data.contact[index].geom1 == 0 else 1
        expected += sign * data.contact[index].frame.reshape(3, 3).T @ force[:3]
    hand = rotation_of(data.body("hand").xquat)
    suite = SensorSuite(engine.scene, {"t": KinematicTaxel(link="hand", probes=TOP, total="engine")}, num_envs=1)
    suite.update(engine.state)
    total = hand.apply(suite.read("t").sum((0, 1, 2)).numpy()[:3])
    weight = float(model.body_mass.sum()) - float(model.body("hand").mass[0])
    np.testing.assert_allclose(total, expected, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(total, [0, 0, -9.81 * weight], atol=0.02 * 9.81 * weight)
