"""The temperature grid against closed forms: eigenmodes, lumped cooling, contact of half-spaces, conservation."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import erf

from brainbench.core.errors import UsageError
from robotics_bridge.physics.engines import MujocoEngine
from robotics_bridge.physics.scene import Geometry, TouchScene
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import MATERIALS, ThermalBody, ThermalMaterial, material
from robotics_bridge.sensors.temperature.runtime import link_temperature
from tests.factories.touch_scenes import PLAIN, make_grid, touch_face

LIMITS = {"contact_conductance", "warm_range", "cold_range"}
"""Numbers of a grid of which infinity means none."""
NUMBERS = LIMITS | {
    "base_temperature", "ambient_temperature", "convection", "source", "contact_radius", "depth_weight", "tau",
}  # fmt: skip


def _field(suite: SensorSuite, values: np.ndarray) -> None:
    runtime = suite.runtimes[0]
    runtime.heat.temperature.assign(np.broadcast_to(values.ravel(), runtime.heat.temperature.shape).astype(np.float64))


@pytest.mark.parametrize("mode", [1, 2, 3])
@pytest.mark.parametrize("dt", [1e-3, 0.1])
def test_an_eigenmode_of_a_slab_decays_as_the_heat_equation_says(mode, dt):
    cells, length = 48, 0.06
    suite, state = make_grid(cells=(1, 1, cells), base_temperature=20.0)
    suite.update(state, dt)
    z = (np.arange(cells) + 0.5) / cells
    shape = np.cos(mode * math.pi * z)
    _field(suite, 20 + 5 * shape)
    steps = round(4.0 / dt) if dt == 0.1 else 500
    for _ in range(steps):
        suite.update(state, dt)
    rate = PLAIN.diffusivity * (mode * math.pi / length) ** 2
    expected = 20 + 5 * shape * math.exp(-rate * steps * dt)
    assert suite.read_ground_truth("grid")[0, 0, 0].numpy() == pytest.approx(expected, abs=5e-3 * mode**2)


def test_many_tiny_steps_add_up_to_what_long_ones_do():
    read = {}
    for dt, steps in ((1e-5, 2000), (1e-2, 2)):
        suite, state = make_grid(cells=(1, 1, 2), source=2e4, base_temperature=30.0)
        for _ in range(steps):
            suite.update(state, dt)
        read[dt] = float(suite.read_ground_truth("grid").double().mean()) - 30
    assert read[1e-5] == pytest.approx(2e4 * 0.02 / 1e6, rel=0.01)
    assert read[1e-5] == pytest.approx(read[1e-2], rel=0.01)


@pytest.mark.parametrize("dt", [1e-5, 1e-3, 1e-1])
def test_an_insulated_grid_keeps_its_heat_and_a_level_one_its_temperature(dt):
    suite, state = make_grid(cells=(3, 4, 5), base_temperature=31.0)
    for _ in range(20):
        suite.update(state, dt)
    assert np.all(suite.read_ground_truth("grid").numpy() == 31.0)
    start = np.random.default_rng(0).uniform(10, 50, (3, 4, 5))
    _field(suite, start)
    for _ in range(200):
        suite.update(state, dt)
    end = suite.read_ground_truth("grid")[0].double().numpy()
    assert end.mean() == pytest.approx(start.mean(), abs=2e-4)
    assert start.min() - 1e-4 <= end.min()
    assert end.max() <= start.max() + 1e-4


@pytest.mark.parametrize("dt", [1e-4, 1e-2, 0.1])
def test_a_lump_cools_by_newtons_law_at_any_step(dt):
    suite, state = make_grid(cells=(1, 1, 1), convection=200.0, ambient_temperature=20.0, base_temperature=60.0)
    steps = max(1, min(round(20 / dt), 300))
    for _ in range(steps):
        suite.update(state, dt)
    volume, area = 8 * 0.01 * 0.02 * 0.03, 8 * (0.01 * 0.02 + 0.02 * 0.03 + 0.03 * 0.01)
    rate = 200 * area / (PLAIN.density * PLAIN.specific_heat * volume)
    expected = 20 + 40 * math.exp(-rate * steps * dt)
    assert float(suite.read_ground_truth("grid")) == pytest.approx(expected, abs=2e-3)


def test_radiation_follows_stefan_and_boltzmann():
    suite, state = make_grid(cells=(1, 1, 1), radiates=True, ambient_temperature=20.0, base_temperature=300.0)
    dt, steps = 0.1, 600
    for _ in range(steps):
        suite.update(state, dt)
    volume, area = 8 * 0.01 * 0.02 * 0.03, 8 * (0.01 * 0.02 + 0.02 * 0.03 + 0.03 * 0.01)
    c = 0.8 * 5.670374419e-8 * area / (PLAIN.density * PLAIN.specific_heat * volume)
    exact = solve_ivp(lambda t, y: -c * (y**4 - 293.15**4), (0, dt * steps), [573.15], rtol=1e-10, atol=1e-8)
    assert float(suite.read_ground_truth("grid")) == pytest.approx(exact.y[0, -1] - 273.15, abs=0.02)


def test_a_source_warms_by_its_power_and_nothing_else():
    source = np.zeros((2, 2, 2))
    source[1, 0, 1] = 5e5
    suite, state = make_grid(cells=(2, 2, 2), source=source)
    for _ in range(100):
        suite.update(state, 0.01)
    gain = suite.read_ground_truth("grid").double().mean() - 22
    assert gain == pytest.approx(5e5 / 8 * 1.0 / (PLAIN.density * PLAIN.specific_heat), rel=1e-3)


@pytest.mark.parametrize("dt", [2e-3, 2e-2, 0.1])
@pytest.mark.parametrize("name", ["glass", "wood", "steel"])
def test_touching_a_half_space_gives_the_temperatures_of_two_half_spaces(name, dt):
    """Carslaw & Jaeger: the interface is at (e₁T₁ + e₂T₂) / (e₁ + e₂), the grid follows the error function."""
    # A face of 2 m so that heat flows straight through; 24 mm deep.
    suite, state = make_grid(
        half=(1.0, 1.0, 0.012), contacts=4, cells=(1, 1, 240), base_temperature=33.0,
        bodies={"object": ThermalBody(name, 13.0)},
    )  # fmt: skip
    touch_face(state, 1.0, height=0.012)
    steps = round(2 / dt)
    for _ in range(steps):
        suite.update(state, dt)
    e1, e2 = PLAIN.effusivity, material(name).effusivity
    interface = (e1 * 33 + e2 * 13) / (e1 + e2)
    depth = (np.arange(240)[::-1] + 0.5) * 1e-4
    expected = interface + (33 - interface) * erf(depth / (2 * math.sqrt(PLAIN.diffusivity * dt * steps)))
    read = suite.read_ground_truth("grid")[0, 0, 0].numpy()
    assert read == pytest.approx(expected, abs=0.005 * 20)
    assert read[-1] == pytest.approx(interface, abs=0.02 * 20)


@pytest.mark.parametrize("own", ["silicone", "skin", "glass"])
@pytest.mark.parametrize("other", ["aluminium", "steel", "wood"])
def test_short_touches_take_up_the_heat_of_two_half_spaces(own, other):
    """Carslaw & Jaeger: Q = 2 ΔT A e₁e₂/(e₁ + e₂) √(t/π), on default cells."""
    half, found = (0.2, 0.2, 0.01), []
    e1, e2 = material(own).effusivity, material(other).effusivity
    for dt in (0.002, 0.01):
        suite, state = make_grid(
            half=half, contacts=4, material=own, base_temperature=33.0, bodies={"object": ThermalBody(other, 13.0)}
        )
        touch_face(state, 0.2, height=0.01)
        capacity = material(own).density * material(own).specific_heat * 8 * math.prod(half) / 8
        for step in range(1, round((1 if dt == 0.002 else 5) / dt) + 1):
            suite.update(state, dt)
            if round(step * dt, 6) in (0.01, 0.1, 1.0, 5.0):
                heat = capacity * float((33 - suite.runtimes[0].heat.temperature.numpy()).sum())
                found.append(heat / (40 * 0.16 * e1 * e2 / (e1 + e2) * math.sqrt(step * dt / math.pi)))
    assert len(found) == 7
    np.testing.assert_allclose(found, 1, atol=0.01)


def test_a_patch_warms_every_cell_that_it_covers_and_no_other():
    pad = {"cells": (6, 6, 1), "half": (0.03, 0.03, 0.005), "bodies": {"object": ThermalBody("steel", 60.0)}}
    suite, state = make_grid(contacts=4, **pad)
    touch_face(state, 0.02, height=0.005)
    suite.update(state, 1e-3)
    warmed = suite.read_ground_truth("grid")[0, :, :, 0].numpy() - 22
    inner = warmed[1:5, 1:5]
    assert inner.min() == pytest.approx(inner.max(), rel=0.2)
    assert inner.min() > 100 * max(warmed[0].max(), warmed[:, -1].max())
    # A single point is a disc: as large as several cells, it reaches all of them.
    suite, state = make_grid(contacts=1, contact_radius=1.0, **pad)
    state.set_contacts([0], [[0, 1]], distance=[-2e-4], position=[[0, 0, 0.005]], normal=[[0, 0, 1.0]])
    suite.update(state, 1e-3)
    warmed = suite.read_ground_truth("grid")[0, :, :, 0].numpy() - 22
    assert (warmed[1:5, 1:5] > 0).all()


def test_metal_feels_colder_than_wood_at_the_same_temperature():
    felt = {}
    for name in ("aluminium", "glass", "wood"):
        suite, state = make_grid(
            contacts=1,
            half=(0.006, 0.006, 0.003),
            cells=(5, 5, 5),
            base_temperature=33.0,
            material="skin",
            bodies={"object": ThermalBody(name, 22.0)},
        )
        state.set_contacts(
            [0], [[0, 1]], distance=[-1e-3], position=[[0.0, 0.0, 0.003]], normal=[[0.0, 0.0, 1.0]]
        )  # fmt: skip
        for _ in range(100):
            suite.update(state, 0.02)
        felt[name] = float(suite.read("grid")[0, 2, 2, 4])
    assert felt["aluminium"] < felt["glass"] < felt["wood"] < 33
    assert 33 - felt["aluminium"] > 1.5 * (33 - felt["wood"])


def test_the_published_conduction_is_available_with_its_length_and_area():
    suite, state = make_grid(
        contacts=4,
        cells=(1, 1, 1),
        conduction="thesis",
        base_temperature=20.0,
        bodies={"object": ThermalBody("steel", 50.0)},
    )
    touch_face(state, 0.008)
    for _ in range(1000):
        suite.update(state, 1e-3)
    k = 2 * PLAIN.conductivity * 15 / (PLAIN.conductivity + 15)
    volume, area = 8 * 0.01 * 0.02 * 0.03, 0.016**2
    flux = k * 30 / (volume / area)
    expected = flux * area / volume / (PLAIN.density * PLAIN.specific_heat)
    assert float(suite.read_ground_truth("grid")) - 20 == pytest.approx(expected, rel=2e-2)


def test_a_contact_has_the_area_of_a_cut_ball_and_none_without_depth_or_conductance_gives_heat():
    def gain(depth: float, conductance: float = 1.0) -> float:
        suite, state = make_grid(
            contacts=1, cells=(1, 1, 1), base_temperature=0.0, contact_conductance=conductance, contact_radius=0.004,
            bodies={"object": ThermalBody("copper", 100.0)}, material=ThermalMaterial(400, 1000, 100, 0),
        )  # fmt: skip
        state.set_contacts([0], [[1, 0]], distance=[-depth], position=[[0.0, 0, 0.03]], normal=[[0.0, 0, -1]])
        suite.update(state, 1.0)
        return float(suite.read_ground_truth("grid"))

    assert gain(0.0) == gain(1e-3, 0.0) == 0
    # A poor interface is all the resistance: heat is proportional to the area.
    assert gain(1e-3) / gain(5e-4) == pytest.approx((2 * 4 * 1 - 1) / (2 * 4 * 0.5 - 0.25), rel=1e-2)
    capacity = 1000 * 100 * 8 * 0.01 * 0.02 * 0.03
    area = math.pi * (2 * 0.004 * 1e-3 - 1e-6)
    assert gain(1e-3) == pytest.approx(100 * area / capacity, rel=1e-2)


@pytest.mark.parametrize("dt", [1e-5, 1e-3, 0.1])
def test_no_step_is_too_long_even_for_a_thin_hot_copper_pad(dt):
    suite, state = make_grid(
        half=(0.01, 0.01, 1e-4), contacts=4, cells=(4, 4, 2), material="copper", convection=500.0, radiates=True,
        bodies={"object": ThermalBody("copper", 400.0)}, ambient_temperature=-20.0,
    )  # fmt: skip
    touch_face(state, 0.01, depth=1e-3, height=1e-4)
    for _ in range(100):
        suite.update(state, dt)
        field = suite.read_ground_truth("grid")
        assert -20 <= float(field.min()) <= float(field.max()) <= 400


def test_the_element_lags_exactly_and_reads_less_upward_than_downward():
    for step in (0.01, 1.0):
        suite, state = make_grid(cells=(1, 1, 1), tau=0.4, base_temperature=20.0)
        suite.update(state, step)
        _field(suite, np.array([30.0]))
        for count in range(1, 4):
            suite.update(state, step)
            assert float(suite.read("grid")) == pytest.approx(30 - 10 * math.exp(-count * step / 0.4), abs=1e-4)
        assert float(suite.read_ground_truth("grid")) == pytest.approx(30, abs=1e-4)
    # A source warms evenly at 3 K/s; the element follows by τ, whatever the step.
    for step in (1e-3, 0.1, 0.6):
        suite, state = make_grid(cells=(1, 1, 1), tau=0.4, base_temperature=22.0, source=3e6)
        for _ in range(round(1.2 / step)):
            suite.update(state, step)
        assert float(suite.read("grid")) == pytest.approx(22 + 3 * (1.2 - 0.4 * (1 - math.exp(-3))), abs=1e-3)
    suite, state = make_grid(cells=(1, 1, 2), warm_range=5.0, cold_range=15.0, base_temperature=30.0)
    suite.update(state, 1e-3)
    _field(suite, np.array([80.0, -40.0]))
    suite.update(state, 1e-5)
    assert suite.read("grid").ravel().tolist() == pytest.approx([35.0, 15.0])


def test_a_hot_ball_resting_on_a_plate_warms_the_cells_below_it():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body name="plate"><geom name="plate" type="box" size="0.05 0.05 0.005"/></body>
      <body name="ball" pos="0.03 0.03 0.0449"><freejoint/><geom name="ball" size="0.04" mass="0.5"/></body>
    </worldbody></mujoco>""")
    engine = MujocoEngine(model, 2, threads=1)
    grid = TemperatureGrid(
        link="plate", cells=(5, 5, 1), material="aluminium", bodies={"ball": ThermalBody("steel", 45.0)}
    )
    suite = SensorSuite(engine.scene, {"grid": grid}, num_envs=2)
    for _ in range(100):
        engine.step()
        suite.update(engine.state, engine.timestep)
    read = suite.read_ground_truth("grid")[0, :, :, 0]
    assert np.unravel_index(int(read.argmax()), (5, 5)) == (4, 4)
    assert float(read.max()) > 22.001
    assert np.array_equal(read, suite.read_ground_truth("grid")[1, :, :, 0])


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"cells": (2, 0, 1)}, r"cells .*received 0"),
        ({"low": (0, 0, 0)}, "both corners"),
        ({"low": (0, 0, 0), "high": (1, 0, 1)}, r"received \(0, 0, 0\), \(1, 0, 1\)"),
        ({"material": "alumium"}, "did you mean 'aluminium'"),
        ({"source": np.zeros((1, 2))}, r"source .*received \(1, 2\)"),
        ({"tau": -1.0}, r"tau .*at least 0; received -1\.0"),
        *(({name: math.nan}, rf"{name} .*received nan") for name in sorted(NUMBERS)),
        *(({name: math.inf}, rf"{name} .*received inf") for name in sorted(NUMBERS - LIMITS)),
        *(({name: -300.0}, rf"{name} .*received -300") for name in sorted(NUMBERS - {"source"})),
        *(({name: True}, rf"{name} .*received True") for name in sorted(NUMBERS)),
        ({"cells": (2, math.nan, 1)}, r"cells .*received nan"),
        ({"source": np.array([[[1.0, math.nan]] * 2] * 2)}, r"source .*received nan"),
        ({"low": (-math.inf, 0, 0), "high": (1, 1, 1)}, "low .*received -inf"),
        ({"low": (0, 0), "high": (1, 1)}, r"low holds 3 numbers; received \(0, 0\)"),
        ({"low": (0, 0, 0), "high": (1, 1, True)}, "high .*received True"),
        ({"low": (0, 0, 0), "high": ("1", 1, 1)}, "high .*received '1'"),
        ({"low": (0, 0, 0), "high": (1, 0, 1)}, r"corners .*received \(0, 0, 0\)"),
        ({"cells": 8}, "cells holds 3 numbers; received 8"),
        ({"conduction": "real"}, "Unknown conduction"),
        ({"bodies": {"object": ThermalBody("woood")}}, "did you mean 'wood'"),
        ({"noise": Noise(gain=(0.5, 2.0))}, "TemperatureGrid has no noise knob 'gain'"),
    ],
)
def test_wrong_settings_are_explained(knobs, message):
    with pytest.raises(UsageError, match=message):
        TemperatureGrid(link="pad", **knobs)


def test_corners_may_be_arrays():
    assert TemperatureGrid(link="pad", low=np.zeros(3), high=np.ones(3)).low is not None  # type: ignore[arg-type]


def test_limits_of_a_grid_may_be_infinite():
    grid = TemperatureGrid(link="pad", **dict.fromkeys(LIMITS, math.inf), source=-1.0)
    assert all(getattr(grid, name) == math.inf for name in LIMITS)


def test_a_grid_needs_finite_geometry_or_corners():
    scene = TouchScene(("world",), (Geometry(name="floor", link="world", kind="plane"),))
    with pytest.raises(UsageError, match=r"'world' .*low, high"):
        SensorSuite(scene, {"grid": TemperatureGrid(link="world")}, num_envs=1)
    with pytest.raises(UsageError, match=r"conductivity .*received -1"):
        ThermalMaterial(-1, 1, 1)
    assert MATERIALS["steel"].effusivity == pytest.approx(math.sqrt(15 * 7900 * 480))
    suite, _state = make_grid()
    with pytest.raises(UsageError, match=r"'gird'; .* 'grid'"):
        link_temperature(suite, "gird")


def test_an_empty_scene_is_read_at_the_shortest_and_the_longest_step():
    scene = TouchScene(("world", "pad"))
    grid = TemperatureGrid(link="pad", low=(0, 0, 0), high=(0.01, 0.01, 0.01), base_temperature=30.0)
    suite, state = SensorSuite(scene, {"grid": grid}, num_envs=2), HandState.empty(2, 2)
    for dt in (1e-5, 0.1, 10.0):
        suite.update(state, dt)
        assert 22 < float(suite.read("grid").min()) <= float(suite.read("grid").max()) <= 30


@pytest.mark.slow
def test_a_hundred_thousand_cells_keep_their_heat():
    suite, state = make_grid(cells=(100, 100, 10), source=1e5)
    for _ in range(5):
        suite.update(state, 0.01)
    assert suite.read_ground_truth("grid").double().mean() - 22 == pytest.approx(1e5 * 0.05 / 1e6, rel=1e-3)
