"""Every newton of the engine is felt by the taxels of its link, or counted as missing."""

import logging

import numpy as np
import pytest
from scipy.optimize import nnls

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.envs.kernels.actuation import add_contact_forces
from robotics_bridge.hands.observations import observe
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import (
    ContactAudio,
    ContactProbe,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.sensors import Modes
from robotics_bridge.sensors.temperature.grid import ThermalBody
from tests.factories.touch_scenes import PAD as PAD_OF_HAND
from tests.factories.touch_scenes import pad_scene, poses_at, require_processor, state_of, suite_of

mujoco = pytest.importorskip("mujoco")
wp = warp()
PAD = '<body name="pad"><geom type="box" size=".05 .05 .01"/></body>'
GRID = Probes.grid(16, 16, size=(0.1, 0.1), center=(0, 0, 0.01), radius=0.004)


def _engine(bodies: str, more: str = "", pad: str = PAD, steps: int = 500, dt: float = 0.002) -> MujocoEngine:
    # The inertia of a card or a wire is too small for steps of an engine.
    options = f'<compiler boundinertia="2e-6"/><option timestep="{dt}"/>'
    xml = f"<mujoco>{options}<worldbody>{pad}{bodies}</worldbody>{more}</mujoco>"
    engine = MujocoEngine(mujoco.MjModel.from_xml_string(xml), 1, contacts=200)
    engine.step(steps)
    return engine


def _free(name: str, place: str, geom: str) -> str:
    return f'<body name="{name}" pos="{place}"><freejoint/><geom {geom}/></body>'


def _on(engine: MujocoEngine, link: str = "pad") -> np.ndarray:
    """Return force and moment [6] about the world's origin that MuJoCo's own function gives on a link."""
    return np.sum(_each_on(engine, link), axis=0)


def _each_on(engine: MujocoEngine, link: str) -> list[np.ndarray]:
    model, data, six = engine.model, engine.data[0], np.zeros(6)
    wrenches = [np.zeros(6)]
    for index, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, index, six)
        force, couple = six.reshape(2, 3) @ contact.frame.reshape(3, 3)
        for geom, sign in zip(contact.geom, (-1, 1), strict=True):
            if geom >= 0 and model.body(model.geom_bodyid[geom]).name == link:
                wrenches.append(sign * np.concatenate([force, np.cross(contact.pos, force) + couple]))
    return wrenches


def _read(engine: MujocoEngine, probes: Probes = GRID, link: str = "pad", **settings: object) -> tuple:
    suite = SensorSuite(engine.scene, {"t": KinematicTaxel(link=link, probes=probes, **settings)}, num_envs=1)
    suite.update(engine.state, 0.002)
    return suite.read("t")[0].reshape(-1, 6).sum(0).numpy(), suite


def _missing(suite: SensorSuite, link: str = "pad") -> float:
    return float(suite.missing[0, suite.scene.link_index(link)])


ALL = {
    "ball": 'type="sphere" size=".008" mass=".2"', "box": 'type="box" size=".01 .012 .008" mass=".5"',
    "sheet": 'type="box" size=".015 .012 .0002" mass=".004"', "wire": 'type="capsule" size=".0004 .015" mass=".003"',
    "can": 'type="cylinder" size=".009 .01" mass=".3"', "lens": 'type="ellipsoid" size=".012 .012 .0012" mass=".02"',
    "wedge": 'type="mesh" mesh="wedge" mass=".1"',
}  # fmt: skip
WEDGE = '<asset><mesh name="wedge" vertex="-.01 -.01 0 .01 -.01 0 -.01 .01 0 .01 .01 0 0 0 .015"/></asset>'


@pytest.mark.parametrize("seed", range(8))
def test_taxels_add_up_to_force_and_moment_of_a_random_pile(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = ""
    for height, (name, geom) in enumerate(sorted(ALL.items(), key=lambda _: rng.random())):
        x, y = rng.uniform(-0.025, 0.025, 2)
        bodies += _free(name, f"{x} {y} {0.03 + 0.02 * height}", geom)
    engine = _engine(bodies, WEDGE, steps=1500, dt=5e-4)
    for _ in range(3):
        engine.step(150)
        expected, (total, suite) = _on(engine), _read(engine)
        load = np.linalg.norm(expected[:3])
        assert load > 0.5
        np.testing.assert_allclose(total[:3], expected[:3], atol=0.005 * load)
        # Where taxels carry several faces, the lever of the load is right within half their pitch.
        np.testing.assert_allclose(total[3:], expected[3:], atol=3.3e-3 * load)
        assert _missing(suite) < 0.01 * load


PADS = {
    "fixed": PAD, "tilted": PAD.replace('name="pad"', 'name="pad" euler="8 5 0"'),
    "mesh": '<body name="pad"><geom type="mesh" mesh="slab"/></body>',
    "spring": PAD.replace("<geom", '<joint type="slide" axis="0 0 1" stiffness="3000" damping="20"/><geom mass=".5"'),
}  # fmt: skip
CORNERS = " ".join(f"{x} {y} {z}" for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.01, 0.01))
SLAB = WEDGE.replace("</asset>", f'<mesh name="slab" vertex="{CORNERS}"/></asset>')


@pytest.mark.parametrize("pad", PADS)
@pytest.mark.parametrize("seed", range(100, 103))
def test_what_falls_on_a_patch_smaller_than_its_pad_is_felt_or_flagged(pad: str, seed: int) -> None:
    """Objects turned at random, on any pad and any patch: never a silent loss of more than a hundredth, no taxel that
    is pulled, and no lever that is off by more than the moment that is missing."""
    rng = np.random.default_rng(seed)
    bodies, felt = "", 0
    friction = np.random.default_rng([seed, 1]).uniform(0.2, 1.5)
    for height, (name, geom) in enumerate(sorted(ALL.items(), key=lambda _: rng.random())):
        x, y, *turn = [*rng.uniform(-0.02, 0.02, 2), *rng.uniform(-180, 180, 3)]
        place = f'{x} {y} {0.04 + 0.035 * height}" euler="{turn[0]} {turn[1]} {turn[2]}'
        bodies += _free(name, place, f'{geom} friction="{friction} .005 .0001" condim="{rng.choice([1, 3, 4, 6])}"')
    engine = _engine(bodies, SLAB, PADS[pad], steps=400, dt=5e-4)
    columns, rows, size = *rng.integers(4, 20, 2), rng.uniform(0.03, 0.1)
    radius = rng.uniform(0.6, 1.5) * size / max(columns, rows)
    patch = Probes.grid(int(columns), int(rows), size=(size, size), center=(0, 0, 0.01), radius=radius)
    for _ in range(8):
        engine.step(100)
        expected, (total, suite) = _on(engine), _read(engine, patch)
        body = engine.data[0].body("pad")
        turn, load = body.xmat.reshape(3, 3), np.linalg.norm(expected[:3])
        if not suite.unfelt.any():
            felt += load > 0.1
            np.testing.assert_allclose(turn @ total[:3], expected[:3], atol=0.01 * load + 1e-4)
            # Friction on the side of a pad lifts it.
            lift = sum(max(turn[:, 2] @ wrench[:3], 0.0) for wrench in _each_on(engine, "pad"))
            assert suite.read("t")[..., 2].clamp_min(0).sum() <= lift + 1e-4 * load
            moment = turn @ total[3:] + np.cross(body.xpos, expected[:3])
            off = np.linalg.norm(moment - expected[3:])
            assert off <= suite.missing_moment.max() + 0.08 * _missing(suite) + 1e-4 * load
    assert felt > 0


def test_a_face_larger_than_the_patch_is_felt_by_the_taxels_under_it() -> None:
    """The engine reports its corners, 20 mm from the nearest taxel; the load lies 4 mm off the middle."""
    engine = _engine(
        '<body name="plate" pos="0 0 .0155"><freejoint/><geom type="box" size=".03 .03 .005" mass=".2"/>'
        '<geom type="box" pos=".004 0 .015" size=".005 .005 .01" mass="5"/></body>'
    )
    small = Probes.grid(6, 6, size=(0.015, 0.015), center=(0, 0, 0.01), radius=0.002)
    total, suite = _read(engine, small)
    expected = _on(engine)
    np.testing.assert_allclose(total[:3], expected[:3], atol=1e-3 * 51)
    assert abs(expected[4]) > 0.1
    np.testing.assert_allclose(total[3:], expected[3:], atol=1e-3 * 51 * 0.01)
    assert suite.read("t")[..., 2].max() <= 1e-6  # rounding of 51 N
    assert _missing(suite) == 0


def test_two_taxels_take_the_whole_of_a_load_whose_moment_they_cannot_bear(caplog: pytest.LogCaptureFixture) -> None:
    """A ball beside their row: the sum is right, and the moment that is missing is flagged with its reason once the
    ball lies off by more than their sensing radius of 6 mm."""
    for place, flagged in ((0.004, False), (0.0095, False), (0.0105, True)):
        engine = _engine(_free("ball", f"{place} 0 .0205", 'type="sphere" size=".01" mass=".1"'), steps=41)
        pair = Probes.grid(2, 1, size=(0.02, 0.01), center=(0.004, 0, 0.01), radius=0.006)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            total, suite = _read(engine, pair)
            suite.update(engine.state)
        np.testing.assert_allclose(total[:3], _on(engine)[:3], rtol=1e-4, atol=1e-5)
        assert abs(total[2]) > 0.5
        assert _missing(suite) == 0
        lever = float(suite.missing_moment.max()) / abs(total[2])
        assert lever == pytest.approx(place - 0.004, abs=1e-5)
        assert suite.unbalanced.tolist() == [flagged]
        messages = [record.getMessage() for record in caplog.records]
        assert ["on link 'pad' are shown by no taxel" in message for message in messages] == [True] * flagged


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_a_load_beside_the_taxels_lies_at_the_nearest_place_that_they_can_show(rows: int) -> None:
    """Pushes have their centre within the outline of the taxels: what a load beside it lacks is its way there alone."""
    half = 0.002 * np.array([4, rows - 1])  # m, along and across
    probes = Probes.grid(rows, 5, size=(2 * half[1], 2 * half[0]), center=(0, 0, 0.01), radius=0.004)
    rng = np.random.default_rng(rows)
    loads = np.concatenate([rng.uniform(-1, 1, (40, 2)) * (half + 0.0025), half * [[0.5, 1], [0.9, 1]]])
    envs, up, scene = len(loads), [0, 0, 1.0], pad_scene(Geometry(name="a", link="object", kind="box", size=(0.2,) * 3))
    state = state_of(scene, poses_at(3, {1: (0, 0, -0.005), 2: (0, 0, 0.204)}, envs), touch=False)
    points = np.c_[loads, np.full(envs, 0.005)]
    state.set_contacts(range(envs), [[0, 1]] * envs, distance=[-1e-3] * envs, position=points, normal=[up] * envs,
                       force=[1.0] * envs)  # fmt: skip
    suite = suite_of({"t": KinematicTaxel(link="hand", probes=probes, total="engine")}, envs, scene)
    suite.update(state)
    pushes = -suite.read("t")[..., 2].reshape(envs, -1).numpy()
    center = pushes @ probes.position[:, :2] / pushes.sum(axis=1, keepdims=True)
    nearest = np.clip(loads, -half, half)
    np.testing.assert_allclose(pushes.sum(axis=1), 1, atol=1e-4)
    np.testing.assert_allclose(center, nearest, atol=5e-5)
    lacks = np.linalg.norm(loads - nearest, axis=1)
    np.testing.assert_allclose(suite.missing_moment[:, 1], lacks, atol=5e-5)


def test_the_side_of_a_block_is_not_pushed_by_its_bottom() -> None:
    """A tilt of a ten thousandth changes no reading by more than a hundredth of the largest: taxels beside the block
    overlap its side, which faces by no more than the tilt."""
    beside = Probes.grid(16, 16, size=(0.048, 0.048), center=(0, 0, 0.01), radius=0.004)
    readings = []
    for degrees in (0.0, 0.0057, -0.0057):
        engine = _engine(
            _free("block", f'0 0 .0199" euler="0 {degrees} 0', 'type="box" size=".01 .01 .01" mass=".5"'), steps=1
        )
        readings.append(_read(engine, beside)[1].read("t")[0].reshape(-1, 6)[:, :3])
    for reading in readings[1:]:
        assert (reading - readings[0]).abs().max() < 0.01 * readings[0].abs().max()


@pytest.mark.parametrize("degrees", [9, 15, 27, 49, 49.5, 57, 66])
@pytest.mark.parametrize("turned", [0, 33])
def test_the_load_of_a_tilted_block_lies_where_its_edge_presses(degrees: float, turned: float) -> None:
    """Depths lie on one side of the edge that bears the load, so that weights lean far, without leaping over it."""
    tilt, half = np.radians(degrees), np.array([0.01, 0.012, 0.008])
    height = 0.01 + half[0] * np.sin(tilt) + half[2] * np.cos(tilt) - 0.002
    place = f'pos="0.0013 0.0007 {height}" quat="{np.cos(tilt / 2)} 0 {np.sin(tilt / 2)} 0"'
    block = f'<body name="b" mocap="true" {place}><geom type="box" size="{" ".join(map(str, half))}"/></body>'
    pad = f'<body name="pad" euler="0 0 {turned}"><joint type="slide" axis="0 0 1" stiffness="3000" damping="20"/>'
    engine = _engine(block, pad=f'{pad}<geom mass=".5" type="box" size=".05 .05 .01"/></body>')
    expected, here = _on(engine), engine.data[0].body("pad")
    readings, suite = _read(engine)
    turn = here.xmat.reshape(3, 3)
    load = np.linalg.norm(expected[:3])
    assert load > 0.5
    moment = turn.T @ (expected[3:] - np.cross(here.xpos, expected[:3]))
    # A twentieth of a millimetre; taxels lie 6.7 mm apart.
    np.testing.assert_allclose(readings[3:5], moment[:2], atol=5e-5 * load)
    assert not suite.unbalanced.any()


@pytest.mark.parametrize("geom", ["cylinder", "box"])
def test_taxels_beside_a_body_whose_side_is_a_right_angle_read_finite_numbers(geom: str) -> None:
    """Of the taxels of this patch some overlap the side of a body alone, whose normal rounding tips up or down."""
    rng = np.random.default_rng(0)
    size = {"cylinder": ".01 .01", "box": ".01 .01 .01"}[geom]
    for _ in range(20):
        x, y, turn = *rng.uniform(-0.002, 0.002, 2), rng.uniform(0, 360)
        block = f'{x} {y} .0199" euler="0 0 {turn}'
        engine = _engine(_free("b", block, f'type="{geom}" size="{size}" mass=".3"'), steps=20)
        around = Probes.grid(4, 1, size=(0.003, 0.001), center=(x + 0.0125, y, 0.01), radius=0.004)
        total, suite = _read(engine, around)
        load = np.linalg.norm(_on(engine)[:3])
        assert load > 1
        assert np.isfinite(total).all()
        assert np.linalg.norm(total[:3]) + _missing(suite) == pytest.approx(load, rel=0.02)


def _press(geom: str, place: np.ndarray, way: np.ndarray, force: float, pad: str, drag: float = 0.0) -> MujocoEngine:
    """Return an engine in which a body slides along ``way`` onto a pad that stands still, and is dragged across."""
    across = np.cross(way, [1.0, 0.0, 0.0])
    joints = "".join(f'<joint type="slide" axis="{v[0]} {v[1]} {v[2]}"/>' for v in (way, across))
    body = f'<body name="b" pos="{place[0]} {place[1]} {place[2]}">{joints}<geom {geom} mass=".1" friction="1"/></body>'
    option = '<option timestep=".0005" gravity="0 0 0"/>'
    xml = f'<mujoco>{option}<worldbody><body name="pad">{pad}</body>{body}</worldbody></mujoco>'
    engine = MujocoEngine(mujoco.MjModel.from_xml_string(xml), 1, contacts=20)
    engine.data[0].qfrc_applied[:] = force, drag
    engine.step(300)
    return engine


FLAT = '<geom type="box" size=".2 .2 .01" pos="0 0 -.01"/>'


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_readings_are_the_pressure_of_hertz_summed_over_the_cells_of_taxels(kind: str) -> None:
    """An elastic half-space under a sphere or a cylinder, p = √(1 − ρ²/a²), is the exponent ½: of its load at most an
    eighth lies on another taxel, half of the time at most a sixteenth, from three taxels across the contact on."""
    moved = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        size, radius, turn = rng.uniform(0.005, 0.02), rng.uniform(0.002, 0.005), rng.uniform(0, 180)
        edge = np.sqrt((size + radius) ** 2 - size**2)
        pitch, half = edge / rng.uniform(1.2, 5), 2 * edge * (kind == "cylinder")
        count = int(2 * (edge + half) / pitch) + 4
        geom = f'type="capsule" size="{size} {half}" euler="90 {turn} 0"' if half else f'type="sphere" size="{size}"'
        x, y = rng.uniform(-0.5, 0.5, 2) * pitch
        engine = _press(geom, np.array([x, y, size - 1e-6]), np.array([0.0, 0.0, -1.0]), 2.0, FLAT)
        probes = Probes.grid(count, count, size=((count - 1) * pitch,) * 2, radius=radius)
        load = -_read(engine, probes, exponent=0.5)[1].read("t")[0].reshape(-1, 6)[:, 2].numpy()
        # 32 × 32 points of each cell.
        part = ((np.arange(32) + 0.5) / 32 - 0.5) * pitch
        cell = np.stack([v.ravel() for v in np.meshgrid(part, part)], axis=1)
        away = np.asarray(probes.position).reshape(-1, 1, 3)[..., :2] + cell - [x, y]
        axis = engine.data[0].geom_xmat[1].reshape(3, 3)[:2, 2]
        away = away - np.clip(away @ axis, -half, half)[..., None] * axis
        pressure = np.sqrt(np.maximum(1 - (away**2).sum(axis=2) / edge**2, 0)).mean(axis=1)
        moved.append(0.5 * np.abs(load - load.sum() * pressure / pressure.sum()).sum() / load.sum())
    assert max(moved) < 0.125
    assert np.median(moved) < 0.0625


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "finger"])
def test_no_loads_that_push_come_nearer_to_force_and_moment_and_to_the_law(kind: str) -> None:
    """Beside loads by non-negative least squares over the taxels that overlap, from the engine's force and its point:
    the force exact, its moment as near as pushing allows, then as near to the shares of the law as these allow."""
    gaps, differences, levers = [], [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        size, pitch, count = rng.uniform(0.006, 0.02), rng.uniform(0.003, 0.007), int(rng.integers(4, 9))
        radius, half = rng.uniform(0.8, 1.3) * pitch, 0.5 * count * pitch
        x, y = rng.uniform(-1, 1, 2) * half
        up, pad = np.array([0.0, 0.0, 1.0]), FLAT
        probes = Probes.grid(count, count, size=(2 * half, 2 * half), radius=radius)
        place = np.array([x, y, size - 1e-5])
        if kind == "finger":
            bend, lean = rng.uniform(0.006, 0.012), rng.uniform(-0.9, 0.9)
            angles, along = np.meshgrid(np.arange(-1.2, 1.3, pitch / bend), np.linspace(-half, half, count))
            normal = np.stack([0 * angles, np.sin(angles), np.cos(angles)], axis=-1).reshape(-1, 3)
            position = bend * normal + along.reshape(-1, 1) * [1, 0, 0]
            probes = Probes(position=position, normal=normal, radius=np.full(len(normal), radius))
            up = np.array([0, np.sin(lean), np.cos(lean)])
            pad = f'<geom type="capsule" size="{bend} .2" euler="0 90 0"/>'
            place = np.array([x, 0, 0]) + (bend + size - 1e-5) * up
        length = 0.5 * half * (kind == "cylinder")
        turn = rng.uniform(0, 180)
        geom = (
            f'type="capsule" size="{size} {length}" euler="90 {turn} 0"' if length else f'type="sphere" size="{size}"'
        )
        engine = _press(geom, place, -up, rng.uniform(0.5, 5), pad, rng.uniform(-0.3, 0.3))
        wrench, (_, suite) = _on(engine), _read(engine, probes)
        force, moment, positions = wrench[:3], wrench[3:], np.asarray(probes.position).reshape(-1, 3)
        reading = suite.read("t")[0].reshape(-1, 6)[:, :3].numpy().astype(float)
        axis = engine.data[0].geom_xmat[1].reshape(3, 3)[:, 2]
        away = positions - engine.data[0].geom_xpos[1]
        away -= np.clip(away @ axis, -length, length)[:, None] * axis
        far = np.linalg.norm(away, axis=1)
        outward, depth = away / far[:, None], np.maximum(radius + size - far, 0)
        share = depth**1.2 * np.clip(-2 * outward @ up, 0, 1)
        touched = share > 0
        if not touched.any() or suite.unfelt.any():
            continue
        positions, reading, share, outward = (v[touched] for v in (positions, reading, share, outward))
        lever = positions - positions.mean(axis=0)
        moment = moment - np.cross(positions.mean(axis=0), force)
        law = share[:, None] * outward / (share @ outward @ -up) * (force @ -up)
        law += (force - law.sum(axis=0)) * (share / share.sum())[:, None]
        # A load along the normal, which is not negative, and two tangential ones, each a difference.
        ways = np.stack([-up, *(sign * v for v in np.linalg.svd(up[None])[2][1:] for sign in (1, -1))])
        basis = np.kron(np.eye(len(share)), ways.T)
        turning = np.concatenate([np.cross(r, np.eye(3)).T for r in lever], axis=1) / np.abs(lever).max()
        weight = 0.01 * np.repeat((share / share.sum()) ** -0.5, 3)
        rows = [1e4 * np.tile(np.eye(3), len(share)) @ basis, 100 * turning @ basis, weight[:, None] * basis]
        right = [1e4 * force, 100 * moment / np.abs(lever).max(), weight * law.ravel()]
        best = (basis @ nnls(np.concatenate(rows), np.concatenate(right), maxiter=10_000)[0]).reshape(-1, 3)
        whole = np.linalg.norm(force)
        gap, least = (np.linalg.norm(np.cross(lever, f).sum(axis=0) - moment) / whole for f in (reading, best))
        np.testing.assert_allclose(reading.sum(axis=0), force, atol=2e-4 * whole)
        gaps.append(gap - least)
        levers.append(float(suite.missing_moment.max()) / whole - gap)
        differences.append(np.abs((reading - best) @ up).max() / (best @ -up).max())
    assert len(gaps) >= 8
    assert max(gaps) < 1e-5
    # What the suite says is missing is the gap.
    assert np.abs(levers).max() < 1e-5
    assert np.median(differences) < 0.1
    assert max(differences) < 0.25


def test_a_hand_that_closes_around_a_ball_misses_nothing_at_any_step() -> None:
    """Fingers meet the ball with few taxels at their rims, which cannot bear the moment of what pushes them."""
    hand = hands.load("xhand1")
    engine, closed = MujocoEngine(holding(hand, radius=0.028, reach=0.9), 1), closing(hand, 0.72)
    taxels = {link: KinematicTaxel(link=link, probes=probes) for link, probes in hand.layout("med", "hand").items()}
    suite = SensorSuite(engine.scene, taxels, num_envs=1)
    lost = []
    for step in range(260):
        engine.set(ctrl=closed * min(step / 200, 1.0))
        engine.step()
        suite.update(engine.state, engine.timestep)
        lost.append(float(suite.missing.max()))
    assert max(lost) == 0
    assert sum(float(suite.read(link)[0].reshape(-1, 6)[:, :3].norm(dim=1).sum()) for link in taxels) > 10


def test_a_block_on_a_card_and_two_balls_in_one_place_are_felt() -> None:
    card = _free("card", "0 0 .01048", 'type="box" size=".03 .03 .00038" mass=".005"')
    engine = _engine(card + _free("block", "0 0 .0311", 'type="box" size=".02 .02 .02" mass="2"'))
    total, suite = _read(engine)
    assert total[2] == pytest.approx(_on(engine)[2], rel=1e-3) == pytest.approx(-9.81 * 2.005, rel=0.01)
    assert not suite.unfelt.any()
    balls = _free("small", "0 0 .016", 'type="sphere" size=".006" mass=".1"')
    balls += _free("large", ".002 0 .025", 'type="sphere" size=".015" mass="1"')
    engine = _engine(balls, '<contact><exclude body1="small" body2="large"/></contact>')
    total, suite = _read(engine)
    assert total[2] == pytest.approx(-9.81 * 1.1, rel=0.01)
    assert _missing(suite) == 0


CLOTH = (
    '<body name="holder" pos="0 0 .016"><flexcomp name="cloth" type="grid" count="5 5 1" spacing=".012 .012 .012" '
    'radius=".001" mass=".1" dim="2"><contact selfcollide="none"/><edge equality="true"/></flexcomp></body>'
)


def test_noisy_readings_of_two_balls_on_one_pad_stay_the_same_at_every_update() -> None:
    ball = 'type="sphere" size=".01" mass='
    engine = _engine(_free("left", "-.02 0 .0205", f'{ball}".1"') + _free("right", ".02 0 .0205", f'{ball}".2"'))
    taxels = KinematicTaxel(link="pad", probes=GRID, total="engine", noise=Noise(white=1e-9))
    suite = SensorSuite(engine.scene, {"t": taxels}, num_envs=1)
    for _ in range(4):
        suite.update(engine.state, 0.002)
        np.testing.assert_allclose(suite.read("t"), suite.read_ground_truth("t"), atol=1e-6)
    np.testing.assert_allclose(suite.read("t")[0].reshape(-1, 6).sum(0)[:3], _on(engine)[:3], atol=1e-3)


def test_radius_noise_of_taxels_that_hardly_touch_shows_at_most_twice_the_load() -> None:
    engine = _engine(_free("ball", "0 0 .0205", 'type="sphere" size=".01" mass=".1"'))
    centre = engine.data[0].body("ball").xpos
    points = np.array([[x, y, 0.01] for x in (-0.002, 0.002) for y in (-0.002, 0.002)])
    gap = float(np.linalg.norm(points - centre, axis=1).min()) - 0.01
    probes = Probes(points, np.tile([0.0, 0.0, 1.0], (4, 1)), radius=gap * (1 + 1e-5))
    taxels = KinematicTaxel(link="pad", probes=probes, total="engine", noise=Noise(radius=3e-4))
    suite, load, shown = SensorSuite(engine.scene, {"t": taxels}, num_envs=1), _on(engine)[2], []
    for _ in range(20):
        suite.update(engine.state, 0.002)
        shown.append(float(suite.read("t")[0].reshape(-1, 6)[:, :3].norm(dim=1).max()))
    assert abs(load) < max(shown) <= 2.001 * abs(load)


def test_states_with_room_for_more_and_for_fewer_contacts_are_read_in_turn() -> None:
    few = _engine(_free("ball", "0 0 .0205", 'type="sphere" size=".01" mass=".1"'))
    suite = SensorSuite(few.scene, {"t": KinematicTaxel(link="pad", probes=GRID, total="engine")}, num_envs=1)
    many = MujocoEngine(few.model, 1, contacts=4000)
    many.step(500)
    for engine in (few, many, few, many):
        suite.update(engine.state, 0.002)
        np.testing.assert_allclose(suite.read("t")[0].reshape(-1, 6).sum(0)[2], _on(engine)[2], rtol=1e-4)


def test_a_flex_is_felt_by_the_contacts_of_the_engine_and_refused_by_name_elsewhere() -> None:
    engine = _engine(CLOTH, steps=600)
    expected, (total, suite) = _on(engine), _read(engine)
    assert expected[2] == pytest.approx(-0.981, rel=0.02)
    np.testing.assert_allclose(total, expected, atol=1e-3)
    assert (suite.read("t")[..., 2] < -1e-3).sum() > 20
    assert _missing(suite) == 0
    for sensor in (ContactProbe(link="pad", probes=GRID), KinematicTaxel(link="pad", probes=GRID, total="law")):
        with pytest.raises(Exception, match="flex 'cloth' .*track="):
            SensorSuite(engine.scene, {"s": sensor}, num_envs=1)


def test_a_height_field_is_felt_by_a_link_that_rests_on_it() -> None:
    hills = '<asset><hfield name="hills" nrow="4" ncol="4" size=".1 .1 .01 .01" elevation="0 1 0 1 1 0 1 0 0 1 0 1 1 0 1 0"/></asset>'  # noqa: E501
    pad = '<geom type="hfield" hfield="hills"/>' + _free("pad", "0 0 .03", 'type="box" size=".05 .05 .01" mass=".5"')
    engine = _engine("", hills, pad)
    below = Probes.grid(16, 16, size=(0.1, 0.1), center=(0, 0, -0.01), normal=(0, 0, -1), radius=0.004)
    total, suite = _read(engine, below)
    turn = engine.data[0].body("pad").xmat.reshape(3, 3)
    np.testing.assert_allclose(turn @ total[:3], _on(engine)[:3], atol=0.01 * 4.9)
    assert _missing(suite) < 0.05


def test_what_no_taxel_feels_is_missing_with_its_newtons_and_its_reason(caplog: pytest.LogCaptureFixture) -> None:
    engine = _engine(_free("ball", "0 0 .0205", 'type="sphere" size=".01" mass=".1"'))
    corner = Probes.grid(4, 4, size=(0.01, 0.01), center=(0.03, 0.03, 0.01), radius=0.002)
    with caplog.at_level(logging.WARNING):
        total, suite = _read(engine, corner)
        suite.update(engine.state)
    assert not total.any()
    assert _missing(suite) == pytest.approx(0.981, rel=0.01)
    assert suite.unfelt.tolist() == [True]
    assert [record.getMessage().split(" are felt")[0] for record in caplog.records] == [
        "0.981 N of 0.981 N on link 'pad'"
    ]
    # Another suite of the same engine neither sees nor changes it.
    other = SensorSuite(engine.scene, {"t": KinematicTaxel(link="pad", probes=GRID)}, num_envs=1)
    other.update(engine.state)
    assert (_missing(suite), _missing(other)) == (pytest.approx(0.981, rel=0.01), 0.0)


@pytest.mark.parametrize(("load", "lost"), [(0.5, 1.58), (3e38, np.nan)])
def test_missing_is_what_the_sum_of_the_taxels_lacks_of_opposed_drags(load: float, lost: float) -> None:
    """Two points of a flex drag against one another, of which taxels are near one; loads beyond all numbers are NaN."""
    scene = TouchScene(("world", "hand"), (PAD_OF_HAND,), flexes=("cloth",), reports_forces=True)
    corner = Probes.grid(3, 3, size=(0.004, 0.004), center=(0.01, 0, 0.005), radius=0.003)
    suite = SensorSuite(scene, {"t": KinematicTaxel(link="hand", probes=corner)}, num_envs=1)
    state = HandState.empty(1, 2, 2)
    points, drags = [[0.01, 0, 0.005], [-0.01, 0, 0.005]], [[1.5, 0, 0], [-1.5, 0, 0]]
    pushes = {"force": [load, load], "normal": [[0, 0, 1.0]] * 2, "position": points, "friction": drags}
    state.set_contacts([0, 0], [(0, -1)] * 2, **pushes)
    suite.update(state)
    assert _missing(suite, "hand") == pytest.approx(lost, rel=0.01, nan_ok=True)
    assert suite.unfelt.tolist() == [True]
    if load == 0.5:
        total = suite.read("t")[0].reshape(-1, 6).sum(0).numpy()
        assert np.linalg.norm([0, 0, -1.0] - total[:3]) == pytest.approx(lost, rel=0.01)


def test_two_patches_of_a_link_share_what_pushes_it_by_sides() -> None:
    """A ball on each side: each patch feels its own, and nothing is missing of the link."""
    pad = '<body name="pad" pos="0 0 .05"><freejoint/><geom type="box" size=".03 .03 .005" mass=".01"/></body>'
    bodies = '<geom name="floor" type="sphere" pos="0 0 .03" size=".015"/>' + _free(
        "top", "0 0 .0655", 'type="sphere" size=".01" mass=".2"'
    )
    engine = _engine(bodies, "", pad, steps=3)
    sensors = {
        name: KinematicTaxel(
            link="pad", probes=Probes.grid(8, 8, size=(0.03, 0.03), center=(0, 0, z), normal=(0, 0, z), radius=0.004)
        )
        for name, z in (("above", 0.005), ("below", -0.005))
    }
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    for _ in range(40):
        engine.step()
        suite.update(engine.state)
    above, below = (suite.read(name)[..., 2].sum().item() for name in sensors)
    assert above <= 0 <= below
    assert above + below == pytest.approx(_on(engine)[2], abs=0.01)
    assert _missing(suite) == 0


def test_sensors_added_in_any_order_give_the_same_bits() -> None:
    require_processor()
    bodies = _free("box", "0 0 .0205", 'type="box" size=".01 .012 .01" mass=".5"')
    engine = _engine(bodies)
    half = Probes.grid(8, 8, size=(0.05, 0.05), center=(0.01, 0, 0.01), radius=0.004)
    aside = Probes.grid(2, 2, size=(0.002, 0.002), center=(0.006, 0.006, 0.01), radius=0.004)
    sensors = {
        "fine": KinematicTaxel(link="pad", probes=GRID), "half": KinematicTaxel(link="pad", probes=half),
        "aside": KinematicTaxel(link="pad", probes=aside),
        "bit": ContactProbe(link="pad", probes=half), "law": KinematicTaxel(link="pad", probes=half, total="law"),
    }  # fmt: skip
    readings = []
    for names in (list(sensors), list(sensors)[::-1]):
        suite = SensorSuite(engine.scene, {name: sensors[name] for name in names}, num_envs=1)
        for _ in range(2):
            suite.update(engine.state, 0.002)
        readings.append({name: suite.read(name).numpy().copy() for name in sensors})
        # The best of the sensors counts: one bears the moment.
        assert suite.missing_moment.max() < 1e-6
    for name in sensors:
        np.testing.assert_array_equal(readings[0][name], readings[1][name], err_msg=name)


def test_the_law_stays_where_its_settings_are_stated() -> None:
    engine = _engine(_free("ball", "0 0 .0205", 'type="sphere" size=".01" mass=".1"'), steps=1)
    stated = {"plain": {}, "law": {"total": "law"}, "gain": {"stiffness": 1e3}, "thesis": {"convention": "thesis"}}
    sensors = {name: KinematicTaxel(link="pad", probes=GRID, **settings) for name, settings in stated.items()}
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    assert [suite.sensors[name].total for name in stated] == ["engine", "law", "law", "law"]


def test_a_flex_strikes_a_link_and_presses_a_finger_and_is_refused_where_it_has_no_answer() -> None:
    engine = _engine(CLOTH.replace("5 5 1", "3 3 1"), steps=1)
    scene, modes = engine.scene, Modes((500.0,), (40.0,), (1.0,))
    with pytest.raises(UsageError, match="speed of slip.*flex 'cloth'"):
        SensorSuite(scene, {"s": ContactAudio(link="pad", modes=modes)}, num_envs=1)
    sensors = {
        "s": ContactAudio(link="pad", modes=modes, scrape=0.0, threshold=0.0),
        "warmth": TemperatureGrid(link="pad", cells=(3, 3, 1), unlisted=ThermalBody("water", 40.0)),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    rows = wp.array(np.zeros(len(scene.geometries)), dtype=wp.int32)
    total, loudest = wp.zeros((1, 1), dtype=wp.vec3f), 0.0
    for _ in range(600):
        engine.step()
        suite.update(engine.state, 0.002)
        loudest = max(loudest, float(suite.read("s").abs().max()))
    assert loudest > 0
    # The cloth lies on the middle of the pad and warms it, as a body of no name would; the rim stays as it was.
    warmth = suite.read("warmth")[0, :, :, 0]
    assert 22.1 < warmth[1, 1] < 40
    assert warmth[0, 0] < 22.02
    s = engine.state
    inputs = [s.contact_count, s.contact_geom, s.contact_env, s.contact_normal, s.contact_force, rows, total]
    wp.launch(add_contact_forces, dim=s.contact_env.shape[0], inputs=inputs)
    assert total.numpy()[0, 0, 2] == pytest.approx(-0.981, rel=0.02)


def test_suites_at_several_rates_read_one_engine_as_each_would_alone() -> None:
    def course(strides: dict[str, int]) -> dict[str, list[np.ndarray]]:
        engine = _engine(_free("ball", "0 0 .022", 'type="sphere" size=".01" mass=".1"'), steps=1)
        sensor = KinematicTaxel(link="pad", probes=GRID, friction=0.5, noise=Noise(white=1e-3, walk=1e-3))
        suites = {name: SensorSuite(engine.scene, {"t": sensor}, num_envs=1) for name in strides}
        courses: dict[str, list[np.ndarray]] = {name: [] for name in strides}
        for step in range(12):
            engine.step()
            for name, stride in strides.items():
                if step % stride == 0:
                    suites[name].update(engine.state, 0.002 * stride)
                    courses[name] += [suites[name].read("t").numpy().copy(), suites[name].missing.numpy().copy()]
        return courses

    together = course({"fast": 1, "slow": 3})
    assert np.abs(together["slow"][-2]).max() > 1e-3
    for name, stride in (("fast", 1), ("slow", 3)):
        for left, right in zip(together[name], course({name: stride})[name], strict=True):
            np.testing.assert_array_equal(left, right)


def _twisted(torque: float, probes: Probes) -> tuple[SensorSuite, np.ndarray]:
    """Return a suite that felt a ball pressed on a turned pad by 2 N and twisted by a torque (N·m), and its reading."""
    joints = '<joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/>'
    ball = f'<body pos=".002 .001 .0099">{joints}<geom size=".01" mass=".05" condim="4" friction="1 .05 .0001"/></body>'
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep=".001" gravity="0 0 0" cone="elliptic" impratio="100"/><worldbody>'
        f'<body name="pad" euler="30 40 50"><geom type="box" size=".01 .01 .005" pos="0 0 -.005"/>{ball}</body>'
        "</worldbody></mujoco>"
    )
    engine = MujocoEngine(model, 1)
    engine.data[0].qfrc_applied[:] = -2.0, torque
    suite = SensorSuite(engine.scene, {"pad": KinematicTaxel(link="pad", probes=probes)}, num_envs=1)
    engine.step(500)
    suite.update(engine.state, engine.timestep)
    return suite, suite.read("pad")[0].reshape(-1, 6).double().numpy()


@pytest.mark.parametrize("torque", [0.0, 2e-3, -4e-3])
def test_the_torque_by_which_a_contact_resists_turning_is_felt(torque: float) -> None:
    probes = Probes.grid(9, 9, size=(0.016, 0.016), radius=0.002)
    suite, taxels = _twisted(torque, probes)
    felt = observe("center_of_pressure", {"pad": suite.read("pad")}, {"pad": probes})[0]
    np.testing.assert_allclose(felt[2], -2.0, rtol=0.01)
    np.testing.assert_allclose(felt[3:5], [0.002, 0.001], atol=1e-5)
    np.testing.assert_allclose(felt[6], torque, atol=2e-5)
    # About the origin of the link, nothing else turns it than the press beside its middle.
    np.testing.assert_allclose(taxels[:, 3:].sum(axis=0), [-2 * 0.001, 2 * 0.002, torque], atol=3e-5)
    assert not suite.unbalanced.any()


def test_a_torque_that_a_single_taxel_cannot_show_is_missing() -> None:
    suite, taxels = _twisted(3e-3, Probes([[0.002, 0.001, 0.0]], [[0, 0, 1.0]], [0.001]))
    np.testing.assert_allclose(taxels[:, 5].sum(), 0.0, atol=1e-6)
    np.testing.assert_allclose(suite.missing_moment[0, suite.scene.link_index("pad")], 3e-3, rtol=0.02)
    assert suite.unbalanced.all()
