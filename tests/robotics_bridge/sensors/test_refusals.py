"""What is no sensor, signal, place or log is refused by name, where plausible numbers came out of it before."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from robotics_bridge.sensors import (
    ActuationAudio,
    AfferentFilter,
    ContactAudio,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.runtime import joint_drive
from robotics_bridge.sensors.audio.sensors import Modes
from robotics_bridge.sensors.taxels.elastomer import contact_pressure
from robotics_bridge.sensors.temperature.materials import ThermalBody
from tests.factories.touch_scenes import ball_state, suite_of

PROBE = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.002)
GRID = {"rows": 2, "columns": 2, "size": (0.01, 0.01)}


@pytest.mark.parametrize("shape", [(3, 5), (3, 2), (6,), ()])
def test_positions_and_normals_are_vectors_and_never_rearranged(shape) -> None:
    vectors = np.ones((int(np.prod(shape)) // 3 or 1, 3))
    for position, normal in ((np.ones(shape), vectors), (vectors, np.ones(shape))):
        with pytest.raises(UsageError, match=r"\[N, 3\]"):
            Probes(position, normal, 0.002)
    assert len(Probes(np.ones((2, 4, 3)), np.ones((2, 4, 3)), 0.002, (2, 4))) == 8


def test_a_pitch_holds_for_regular_grids_alone() -> None:
    grid = Probes.grid(3, 4, size=(0.02, 0.03))
    moved = np.array(grid.position)
    moved[5, 0] += 1e-3
    for position, pitch in ((moved, grid.pitch), (grid.position, (0.02, 0.01)), (grid.position, (0.01, 10.0))):
        with pytest.raises(UsageError, match="pitch"):
            Probes(position, grid.normal, grid.radius, grid.shape, pitch)
    assert Probes(grid.position, grid.normal, grid.radius, grid.shape, grid.pitch).pitch == grid.pitch


@pytest.mark.parametrize(
    ("name", "value"), [("center", 0.01), ("center", (0.0, 0.0)), ("center", (0, 0, np.nan)), ("size", 0.01)]
)
def test_a_grid_has_a_middle_and_two_extents(name, value) -> None:
    with pytest.raises(UsageError, match=name):
        Probes.grid(**{**GRID, name: value})


@pytest.mark.parametrize(("name", "value"), [("within", 270.0), ("within", -30.0), ("within", np.nan), ("seed", -1)])
def test_patches_of_meshes_have_ranges(name, value) -> None:
    mesh = Mesh(np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]]), np.array([[0, 1, 2]]))
    with pytest.raises(UsageError, match=name):
        Probes.on_mesh(mesh, 3, **{"facing": (0, 0, 1), name: value})


def test_radii_go_with_their_probes() -> None:
    with pytest.raises(UsageError, match="4 probes"):
        Probes.grid(**GRID).with_radius([0.1, 0.2])


@pytest.mark.parametrize(
    ("name", "value"), [("link", None), ("noise", {}), ("probes", np.zeros((1, 3))), ("track", "ball")]
)
def test_parts_of_a_sensor_are_of_their_kind(name, value) -> None:
    with pytest.raises(UsageError, match=f"{name} .*(must be|holds values)"):
        ContactProbe(**{"link": "hand", "probes": PROBE, name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [("resolution", 0), ("resolution", -5), ("resolution", 1000), ("seed", 1.5), ("seed", None), ("env_offset", -3)],
)
def test_numbers_of_a_suite_have_ranges(name, value) -> None:
    with pytest.raises(UsageError, match=name):
        suite_of({"a": ContactProbe(link="hand", probes=PROBE)}, **{name: value})


@pytest.mark.parametrize("wrong", [[0.7], [float("nan")], [True], torch.ones(2, 2, dtype=torch.bool), [3], [-1]])
def test_environments_to_reset_are_numbers_or_a_whole_mask(wrong) -> None:
    suite, bands = suite_of({"a": ContactProbe(link="hand", probes=PROBE)}, 3), AfferentFilter(1000.0, "SA-I")
    bands.step(torch.ones(3, 1))
    for reset in (suite.reset, bands.reset):
        with pytest.raises(UsageError, match=r"0 to 2|mask"):
            reset(wrong)
    assert suite.context.episode.numpy().tolist() == [0, 0, 0]


def test_lengths_in_millimetres_are_told() -> None:
    wide = TemperatureGrid(link="hand", low=(-20, -20, -5), high=(20, 20, 5))
    for sensor in (ContactProbe(link="hand", probes=PROBE, threshold=0.5), wide):
        with pytest.warns(RuntimeWarning, match="metres"):
            suite_of({"a": sensor})


@pytest.mark.parametrize("signal", [torch.ones(1, 2, dtype=torch.int64), torch.ones(1, 2, dtype=torch.bool), [[1.0]]])
def test_afferents_take_numbers_with_a_fraction(signal) -> None:
    with pytest.raises(UsageError, match="floating-point"):
        AfferentFilter(1000.0).step(signal)


def test_the_signal_of_afferents_keeps_its_shape() -> None:
    bands = AfferentFilter(1000.0, ("SA-I",))
    bands.step(torch.ones(4, 2))
    for use in (bands.step, lambda x: bands.reset([0], x)):
        with pytest.raises(UsageError, match=r"\(4, 2\)"):
            use(torch.ones(1, 2))
    with pytest.raises(UsageError, match="needs a band"):
        AfferentFilter(1000.0, ())


def test_a_number_that_is_none_leaves_afferents_at_their_reset() -> None:
    bands = AfferentFilter(1000.0, ("SA-I",))
    for signal in (torch.ones(2, 1), torch.tensor([[float("nan")], [1.0]])):
        bands.step(signal)
    bands.reset([0])
    assert torch.isfinite(bands.step(torch.ones(2, 1))["SA-I"]).all()


def test_the_torsion_of_a_copied_taxel_is_that_of_its_own_radius_and_shear() -> None:
    taxel = KinematicTaxel(link="hand", probes=PROBE)
    wide = replace(taxel, probes=PROBE.with_radius(0.01))
    assert wide.torsion == KinematicTaxel(link="hand", probes=PROBE.with_radius(0.01)).torsion > taxel.torsion
    assert replace(taxel, shear=20.0).torsion == pytest.approx(10 * taxel.torsion)
    assert (replace(taxel, convention="thesis").torsion, replace(taxel, twist=0.5).torsion) == (2.0, 0.5)


def test_a_source_above_half_the_sample_rate_is_told_and_a_pulse_ends_in_its_block() -> None:
    def strike(**settings) -> None:
        suite_of({"a": ContactAudio(link="hand", **settings)}).update(ball_state(0.014))

    with pytest.warns(RuntimeWarning, match="'a'.*8000 Hz"):
        strike(modes=Modes((12_000.0,), (0.0,), (1.0,)))
    with pytest.raises(UsageError, match="contact_time"):
        strike(modes=Modes((500.0,), (0.0,), (1.0,)), contact_time=0.5)


def test_bodies_of_a_temperature_grid_are_links_of_the_scene() -> None:
    with pytest.raises(UsageError, match="did you mean 'object'"):
        suite_of({"a": TemperatureGrid(link="hand", bodies={"objct": ThermalBody("steel", 60.0)})})
    for settings in ({"bodies": {"object": "steel"}}, {"unlisted": None}):
        with pytest.raises(UsageError, match="ThermalBody"):
            TemperatureGrid(link="hand", **settings)
    with pytest.raises(UsageError, match="cells"):
        TemperatureGrid(link="hand", cells=(1000, 1000, 1000))


def test_the_pressure_of_an_environment_does_not_depend_on_its_neighbours_and_is_none_where_they_diverged() -> None:
    grid = Probes.grid(16, 16, size=(0.03, 0.03), center=(0, 0, 0.005), radius=0.004)
    sensor = ElastomerTaxel(link="hand", probes=grid, points=0)

    def pressure(*heights: float) -> torch.Tensor:
        suite = suite_of({"a": sensor}, len(heights))
        suite.update(ball_state(*heights))
        return contact_pressure(suite, "a", modulus=1e5)

    light = pressure(0.0148)[0]
    assert light.sum() > 0
    torch.testing.assert_close(pressure(0.0148, 0.006)[0], light, rtol=1e-3, atol=1e-3 * float(light.max()))
    beside = pressure(0.0148, float("nan"))
    torch.testing.assert_close(beside[0], light)
    assert beside[1].isnan().all()
    with pytest.raises(UsageError, match="Nothing was read"):
        contact_pressure(suite_of({"a": sensor}), "a", modulus=1e5)


def test_a_suite_that_is_seeded_anew_repeats_its_noise_whatever_came_before() -> None:
    drive = ActuationAudio(link="hand", joints=1, hum=1e-3)
    noisy = ContactProbe(link="hand", probes=Probes.grid(8, 8, size=(0.01, 0.01), center=(0, 0, 0.005), radius=0.002),
                         noise=Noise(white=1e-3, dead_probability=0.3, dead_range=(0, 1)))  # fmt: skip

    def read(suite: SensorSuite, seed: int, updates: int) -> list[torch.Tensor]:
        suite.seed(seed)
        suite.reset()
        torque, speed = joint_drive(suite, "drive")
        torque.fill_(1.0)
        speed.fill_(3.0)
        found = []
        for _ in range(updates):
            suite.update(ball_state(0.014))
            found += [suite.read(name).clone() for name in ("bit", "drive")]
        return found

    suite = suite_of({"bit": noisy, "drive": drive})
    first = read(suite, 7, 3)
    other = suite_of({"bit": noisy, "drive": drive}, seed=99)
    for again in (read(suite, 7, 3), read(other, 7, 3)):
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(first, read(suite, 8, 3), strict=True))


def test_a_sensible_suite_warns_of_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensors = {"a": ContactProbe(link="hand", probes=PROBE), "b": TemperatureGrid(link="hand")}
        suite_of(sensors).update(ball_state(0.014))
