"""Observation types of table 4.3 with equations 4.29–4.31."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.hands.observations import OBSERVATIONS, observe, sensors_for
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import MujocoEngine
from robotics_bridge.sensors import Noise, SensorSuite
from robotics_bridge.sensors.probes.placement import Probes


def _layout() -> dict[str, Probes]:
    normal = np.array([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1]], float)
    return {
        "a": Probes(np.zeros((6, 3)), normal, np.array([1, 1, 1, 1, 1, 0.0]), (2, 3)),
        "b": Probes(np.zeros((3, 3)), normal[:3], np.ones(3)),
    }


def test_patch_force_sums_depths_along_normals_in_the_order_z_y_x():
    depth = {"a": torch.tensor([[1e-4, 2e-4, 3e-4, 0, 0, 9.0]]).reshape(1, 2, 3), "b": torch.zeros(1, 3)}
    assert observe("agg_force", depth, _layout()) == pytest.approx(torch.tensor([[1.0, 2.0, 3.0, 0, 0, 0]]))


def test_a_link_touches_when_more_than_two_taxels_do():
    for touching, expected in ((2, 0.0), (3, 1.0)):
        bits = torch.zeros(1, 6)
        bits[0, :touching] = 1
        assert observe("agg_bool", {"a": bits.reshape(1, 2, 3), "b": torch.ones(1, 3)}, _layout())[0, 0] == expected


@pytest.mark.parametrize(("name", "channels"), [("force", 3), ("force_torque", 6), ("proximity", 6), ("elastomer", 3)])
def test_taxel_types_flatten_active_taxels_in_order(name, channels):
    raw = 3 if name == "elastomer" else 6
    readings = {"a": torch.rand(4, 2, 3, raw), "b": torch.rand(4, 3, raw)}
    seen = observe(name, readings, _layout())
    assert seen.shape == (4, 8 * channels)
    assert seen[:, :channels] == pytest.approx(readings["a"][:, 0, 0, :channels])
    assert seen[:, -channels:] == pytest.approx(readings["b"][:, -1, :channels])


def test_sizes_of_a_hand_follow_from_counts_of_taxels_and_links():
    layout = hands.load("xhand1").layout("med", "tips")
    scalar = {link: torch.zeros(2, *probes.shape) for link, probes in layout.items()}
    assert observe("depth", scalar, layout).shape == (2, 100)
    assert observe("agg_force", scalar, layout).shape == (2, 15)
    assert observe("agg_bool", scalar, layout).shape == (2, 5)
    assert observe("none", scalar, layout).shape == (2, 0)
    assert len(OBSERVATIONS) == 10


def test_the_centre_of_pressure_is_where_a_force_acts_and_how_it_twists():
    """Forces of 1 and 3 N at 0 and 4 mm, and a torque of 2 mN·m about the normal, have one wrench in closed form."""
    layout = {"tip": Probes(np.array([[0, 0, 0], [4e-3, 0, 0]]), np.tile([0, 0, 1.0], (2, 1)), np.full(2, 1e-3))}
    reading = torch.zeros(2, 2, 6)
    for taxel, (x, force) in enumerate(((0.0, 1.0), (4e-3, 3.0))):
        reading[0, taxel, :3] = torch.tensor([0.0, 0.5, -force])
        reading[0, taxel, 3:] = torch.linalg.cross(torch.tensor([x, 0, 0]), reading[0, taxel, :3])
    reading[0, 0, 5] += 2e-3
    seen = observe("center_of_pressure", {"tip": reading}, layout)
    # About the point, the sideways forces of .5 N each twist by .5 · (-3 + 1) mm.
    np.testing.assert_allclose(seen[0], [0, 1, -4, 3e-3, 0, 0, 2e-3 - 1e-3], atol=1e-9)
    assert not seen[1].any()


def test_wrong_names_and_shapes_are_explained():
    with pytest.raises(UsageError, match=r"'forces'; .* 'force'"):
        observe("forces", {}, _layout())
    with pytest.raises(UsageError, match=r"'a'.*Allowed: 'b'"):
        observe("depth", {"b": torch.zeros(1, 3)}, _layout())
    with pytest.raises(UsageError, match=r"6 probes.*\(1, 5\)"):
        observe("depth", {"a": torch.zeros(1, 5), "b": torch.zeros(1, 3)}, _layout())


@pytest.fixture(scope="module")
def grip() -> MujocoEngine:
    """Two hands that hold a ball."""
    hand = hands.load("xhand1")
    engine = MujocoEngine(holding(hand, radius=0.028, reach=0.9), 2, threads=1)
    engine.set(ctrl=closing(hand, 0.72))
    engine.step(300)
    return engine


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("name", [name for name in OBSERVATIONS if name != "none"])
def test_a_hand_that_holds_a_ball_is_observed_in_every_way(grip, name, noisy):
    layout = hands.load("xhand1").layout("low")
    knobs = {"points": 200} if name in ("elastomer", "proximity") else {}
    sensors = sensors_for(name, layout, noisy=noisy, track=("object",), **knobs)
    assert all(sensor.noise.active == noisy for sensor in sensors.values())
    suite = SensorSuite(grip.scene, sensors, num_envs=2, seed=3)
    for _ in range(2):
        suite.update(grip.state, grip.timestep)
    seen = observe(name, {link: suite.read(link) for link in layout}, layout)
    kind = OBSERVATIONS[name]
    assert seen.shape == (2, kind.channels * (len(layout) if kind.per_link else 90))
    assert bool(seen.isfinite().all())
    # Markers move where the ball dips below the skin, which so coarse a layout may miss.
    assert float(seen.abs().max()) > 0 or name == "elastomer"
    truth = observe(name, {link: suite.read_ground_truth(link) for link in layout}, layout)
    assert np.array_equal(truth[0], truth[1])
    assert np.array_equal(seen, truth) == (not noisy) or (name in ("bool", "agg_bool") and np.array_equal(seen, truth))


def test_published_sensors_carry_the_published_parameters():
    layout = hands.load("sharpa").layout("low", "tips")
    noisy = sensors_for("bool", layout, noisy=True)["right_index_DP"]
    assert (noisy.threshold, noisy.release, noisy.noise) == (5e-4, 2e-4, Noise.preset("published-bool"))
    force = sensors_for("force", layout, convention="thesis")["right_thumb_DP"]
    assert (force.stiffness, force.damping, force.exponent, force.shear, force.torsion) == (500, 1, 1.2, 2, 2)
    assert force.convention == "thesis"
    holding, law = (sensors_for("force", layout, **knobs)["right_thumb_DP"] for knobs in ({}, {"twist": 2.0}))
    assert (holding.total, holding.friction, law.total, law.friction, law.twist) == ("engine", 1.0, "law", None, 2)
    assert sensors_for("bool", layout, twist=2.0).keys() == layout.keys()
    assert set(sensors_for("proximity", layout)["right_thumb_DP"].probes.radius) == {0.01}
    assert sensors_for("none", layout) == {}


TABLE_4_12 = {
    # white noise, random walk, quantum, radius noise, release threshold, dead taxels, gain, hysteresis and its time
    "bool": (0, 0, 0, 0, 2e-4, 0.05, (1, 1), 0, None),
    "agg_bool": (0, 0, 0, 0, 2e-4, 0.05, (1, 1), 0, None),
    "depth": (2e-4, 0, 1e-4, 3e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
    "agg_force": (2e-4, 0, 1e-4, 3e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
    "force": (5e-3, 1e-4, 1e-2, 3e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
    "force_torque": (5e-3, 1e-4, 1e-2, 3e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
    "proximity": (1e-2, 1e-3, 1e-2, 6e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
    "elastomer": (1e-4, 1e-5, 1e-4, 3e-4, None, 0.05, (0.85, 1.15), 0.5, 0.05),
}


@pytest.mark.parametrize("name", TABLE_4_12)
def test_the_noisy_condition_is_that_of_table_4_12(name):
    layout = hands.load("xhand1").layout("med", "tips")
    for sensor in sensors_for(name, layout, noisy=True).values():
        noise = sensor.noise
        found = (noise.white, noise.walk, noise.quantum, noise.radius, getattr(sensor, "release", None))
        found += (noise.dead_probability, tuple(noise.gain), noise.hysteresis)
        assert (*found, noise.hysteresis_tau if noise.hysteresis else None) == TABLE_4_12[name]
    assert not any(sensor.noise.active for sensor in sensors_for(name, layout).values())
