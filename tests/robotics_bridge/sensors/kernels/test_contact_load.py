"""Every newton of the engine is felt by the taxels of its link, or counted as missing."""

import logging

import numpy as np
import pytest

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.envs.kernels.actuation import add_contact_forces
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import MujocoEngine
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
from tests.factories.sensor_episode import require_processor

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
        force = contact.frame.reshape(3, 3).T @ six[:3]
        for geom, sign in zip(contact.geom, (-1, 1), strict=True):
            if geom >= 0 and model.body(model.geom_bodyid[geom]).name == link:
                wrenches.append(sign * np.concatenate([force, np.cross(contact.pos, force)]))
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


def test_two_taxels_take_the_whole_of_a_load_whose_moment_they_cannot_bear() -> None:
    """A ball beyond the end of their row: the sum is right, and nothing is missing."""
    engine = _engine(_free("ball", ".014 0 .0205", 'type="sphere" size=".01" mass=".1"'), steps=1)
    pair = Probes.grid(2, 1, size=(0.02, 0.01), center=(0.004, 0, 0.01), radius=0.004)
    engine.step(40)
    total, suite = _read(engine, pair)
    np.testing.assert_allclose(total[:3], _on(engine)[:3], rtol=1e-4, atol=1e-5)
    assert abs(total[2]) > 0.5
    assert _missing(suite) == 0


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
    sensors = {
        "fine": KinematicTaxel(link="pad", probes=GRID), "half": KinematicTaxel(link="pad", probes=half),
        "bit": ContactProbe(link="pad", probes=half), "law": KinematicTaxel(link="pad", probes=half, total="law"),
    }  # fmt: skip
    readings = []
    for names in (list(sensors), list(sensors)[::-1]):
        suite = SensorSuite(engine.scene, {name: sensors[name] for name in names}, num_envs=1)
        for _ in range(2):
            suite.update(engine.state, 0.002)
        readings.append({name: suite.read(name).numpy().copy() for name in sensors})
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
