"""Trials: what was measured, with a pluck or a scene, and what cannot be."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial, fit, new_shapes, new_wrenches, read_wrenches
from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.parameters import Condition
from brainbench.stimuli.fitting.trials import Pluck, to_frame
from tests.factories.whisker_measurements import (
    KNOWN,
    blank_wrenches,
    measure_wrenches,
    ringdown_wrenches,
    simulate_trial,
)


def test_the_direction_of_a_pluck_has_no_length():
    whisker = WhiskerArray.mouse()["C2"].whisker
    condition = Condition(whisker, {"deflection": 1e-3})
    unit, long = (
        Pluck(1e-3, 0.01, direction).loads(condition, -0.1) for direction in ((0.0, 0.6, 0.8), (0.0, 3.0, 4.0))
    )
    assert [load.force for load in long] == [pytest.approx(load.force) for load in unit]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"arc": 0.0}, "arc length"),
        ({"arc": 30.0}, "arc length"),
        ({"deflection": 0.0}, "deflection"),
        ({"deflection": np.nan}, "deflection"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction"),
    ],
)
def test_a_pluck_that_holds_nothing_is_refused(changes, said):
    given = {"deflection": 1e-3, **changes}
    with pytest.raises(UsageError, match=said):
        Trial.ringdown(KNOWN, blank_wrenches(np.arange(1, 50) * 2e-4), **given)


def test_columns_of_wrenches_come_in_any_order():
    axes, values = euler_matrix((0.3, -0.2, 0.5)), np.arange(18.0).reshape(3, 6)
    levels, order = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), [0, 3, 1, 4, 2, 5]
    whole = new_wrenches(np.arange(3.0), values, noise=levels)
    mixed = new_wrenches(np.arange(3.0), values[:, order], [CHANNELS[i] for i in order], noise=levels[order])
    expected, found = (to_frame(one, axes, np.zeros(3)) for one in (whole, mixed))
    np.testing.assert_allclose(expected["wrench"].values, (values.reshape(3, 2, 3) @ axes).reshape(3, 6))
    # Turned noise of variances that differ: those of the turned components.
    np.testing.assert_allclose(expected["noise"].values[:3], np.sqrt(np.diag(axes.T @ np.diag([1, 4, 9]) @ axes)))
    xr.testing.assert_allclose(found, expected)
    with pytest.raises(UsageError, match="My is missing"):
        to_frame(new_wrenches(np.arange(3.0), values[:, :4], CHANNELS[:4]), axes, np.zeros(3))


def test_trials_agree_on_the_noise_of_a_channel(rung):
    trial = Trial.ringdown(KNOWN, ringdown_wrenches(rung).assign(noise=("channel", [1e-6, 1e-6, 1e-8])), 1e-3)
    other = replace(trial, measured=trial.measured.assign(noise=("channel", [2e-6, 1e-6, 1e-8])))
    Readings.of([trial, trial])
    with pytest.raises(DataError, match="different noise"):
        Readings.of([trial, other])


def test_too_few_frames_readings_and_long_shapes_are_refused():
    with pytest.raises(DataError, match="at least 3"):
        Trial.ringdown(KNOWN, new_wrenches([1e-3, 2e-3], np.ones((2, 1)), ["Mz"]), 1e-3)
    trial = Trial.ringdown(KNOWN, new_wrenches(np.arange(1, 4) * 1e-3, np.ones((3, 1)), ["Mz"]), 1e-3)
    with pytest.raises(DataError, match="cannot tell"):
        fit(trial, ["young_modulus", "density", "damping_ratio", "deflection"])
    shapes = np.tile(np.linspace(0, 0.02, 5)[None, :, None] * [1, 0], (4, 1, 1))
    with pytest.raises(DataError, match="20 mm long"):
        Trial.ringdown(KNOWN, new_shapes(np.arange(1, 5) * 1e-3, shapes), 1e-3)


WHISKER = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(WHISKER, 1)[0])
QUICK = FitOptions(links=6, steps_per_period=60.0)


@pytest.fixture(scope="module")
def measured():
    trial = Trial.ringdown(WHISKER, blank_wrenches(np.arange(1, 41) * PERIOD / 12), 1e-3)
    return measure_wrenches(trial, simulate_trial(trial, options=QUICK), 0.01, np.random.default_rng(0)).measured


@pytest.mark.parametrize(
    ("times", "told"),
    [(lambda t: 1e3 * t, "time_ms"), (lambda t: 1e-3 * t, "swings with"), (lambda t: t + 3.0, "nothing is left")],
    ids=["milliseconds", "kiloseconds", "another origin"],
)
def test_a_wrong_clock_is_refused(measured, times, told: str):
    changed = new_wrenches(times(measured["time"].values), measured["wrench"].values, measured["channel"].values)
    with pytest.raises(DataError, match=told):
        Trial.ringdown(WHISKER, changed, 1e-3)


def test_a_whisker_in_millimetres_is_refused(measured):
    with pytest.raises(DataError, match="SI units"):
        Trial.ringdown(replace(WHISKER, arc_length=1e3 * WHISKER.arc_length), measured, 1e-3)


TIMES = np.arange(5) * 1e-3
VALUES = np.arange(30.0).reshape(5, 6) * 1e-6


def test_a_table_with_units_is_read_in_si(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_ms,Fy_mN,Mz_uNm\n0,1,2\n1,,4\n2,5,6\n")
    found = read_wrenches(path)
    np.testing.assert_allclose(found["time"].values, [0, 1e-3, 2e-3])
    np.testing.assert_allclose(found["wrench"].values, [[1e-3, 2e-6], [np.nan, 4e-6], [5e-3, 6e-6]])
    assert list(found["channel"].values) == ["Fy", "Mz"]


@pytest.mark.parametrize("head", ["Fx,Fy", "frame,Fy"])
def test_wrenches_without_time_stamps_are_refused(tmp_path, head):
    (tmp_path / "a.csv").write_text(f"{head}\n1,2\n3,4\n")
    with pytest.raises(DataError, match="no time stamps"):
        read_wrenches(tmp_path / "a.csv")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["wrench"] = VALUES
    with pytest.raises(DataError, match="no time stamps"):
        read_wrenches(tmp_path / "a.h5")


def test_a_unit_of_the_other_kind_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("time,Mz_mN\n0,1\n1,2\n")
    with pytest.raises(DataError, match="unit of the other kind"):
        read_wrenches(tmp_path / "a.csv")


@pytest.mark.parametrize("head", ["Mz_µNm", "Mz_μNm", "Mz (µN·m)", "Mz [uN m]", "Mz_uN.m", "Mz_mN*mm"])
def test_units_are_read_however_they_are_written(tmp_path, head):
    (tmp_path / "a.csv").write_text(f"time,Fy_mN,{head}\n0,1,2\n1,2,3\n", encoding="utf-8")
    np.testing.assert_allclose(read_wrenches(tmp_path / "a.csv")["wrench"].values[0], [1e-3, 2e-6])


@pytest.mark.parametrize("arm", ["m", "mm"])
@pytest.mark.parametrize(("prefix", "size"), [("", 1.0), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9)])
def test_every_unit_that_can_be_written_has_a_scale(tmp_path, prefix, size, arm):
    (tmp_path / "a.csv").write_text(f"time,Fy_{prefix}N,Mz_{prefix}N{arm}\n0,1,2\n1,2,3\n")
    expected = [size, 2 * size * (1e-3 if arm == "mm" else 1.0)]
    np.testing.assert_allclose(read_wrenches(tmp_path / "a.csv")["wrench"].values[0], expected)


@pytest.mark.parametrize("head", ["Mz_gmm", "mz", "Mz_raw"])
def test_a_component_with_an_unknown_unit_is_not_left_out(tmp_path, head):
    (tmp_path / "a.csv").write_text(f"time,Fy_mN,Fy_raw,{head}\n0,1,1,2\n1,2,1,3\n")
    with pytest.raises(DataError, match=head):
        read_wrenches(tmp_path / "a.csv")


def test_hdf5_and_time_series_are_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["wrench"], file["time"] = VALUES, TIMES
    np.testing.assert_allclose(read_wrenches(tmp_path / "a.h5")["wrench"].values, VALUES)
    with h5py.File(tmp_path / "a.nwb", "w") as file:
        series = file.create_group("acquisition/base")
        series["data"] = VALUES[:, :2] * 1e6
        series["data"].attrs["channels"], series["data"].attrs["conversion"] = ["Fx", "Mz"], 1e-6
        series["starting_time"] = 0.5
        series["starting_time"].attrs["rate"] = 1000.0
    found = read_wrenches(tmp_path / "a.nwb")
    np.testing.assert_allclose(found["wrench"].values, VALUES[:, :2])
    np.testing.assert_allclose(found["time"].values, 0.5 + TIMES)


def _write_series(path, *, unit=None, names=("base",), **attributes):
    with h5py.File(path, "w") as file:
        for name in names:
            series = file.create_group(f"acquisition/{name}")
            series["data"], series["timestamps"] = VALUES, TIMES
            series["data"].attrs.update(attributes | ({} if unit is None else {"unit": unit}))
    return path


def test_the_offset_of_a_time_series_is_added(tmp_path):
    path = _write_series(tmp_path / "a.nwb", conversion=2.0, offset=1e-6)
    np.testing.assert_allclose(read_wrenches(path)["wrench"].values, 2 * VALUES + 1e-6)


@pytest.mark.parametrize(
    ("unit", "force", "moment"),
    [
        ("newtons", 1, 1),
        ("N (F), N m (M)", 1, 1),
        ("mN, µN·m", 1e-3, 1e-6),
        ("millinewtons, millinewton millimeters", 1e-3, 1e-6),
    ],
)
def test_the_unit_of_a_time_series_counts(tmp_path, unit, force, moment):
    found = read_wrenches(_write_series(tmp_path / "a.nwb", unit=unit))["wrench"].values
    np.testing.assert_allclose(found, VALUES * np.repeat([force, moment], 3))


@pytest.mark.parametrize("unit", ["volts", "mN", "n/a", "N/m"])
def test_a_unit_that_does_not_tell_forces_and_moments_is_refused(tmp_path, unit):
    with pytest.raises(DataError, match=unit):
        read_wrenches(_write_series(tmp_path / "a.nwb", unit=unit))


def test_several_time_series_are_not_chosen_by_the_alphabet(tmp_path):
    with pytest.raises(DataError, match=r"/acquisition/base.*/acquisition/lfp"):
        read_wrenches(_write_series(tmp_path / "a.nwb", names=("lfp", "base")))


def test_one_whisker_of_a_stimulus_set_is_read(tmp_path):
    from brainbench.stimuli import Frames, Scene, WhiskerArray, simulate, write_stimulus_set

    scene = Scene("air", WhiskerArray.of("mouse", whiskers="C1,C2"), frames=Frames(count=4))
    dataset = simulate(scene, cache=False, fidelity="fast")
    path = write_stimulus_set(dataset, tmp_path / "a.h5")
    found = read_wrenches(path, whisker="C2")
    np.testing.assert_array_equal(found["wrench"].values, dataset["wrench"].values[0, :, 1].astype(float))
    with pytest.raises(UsageError, match="Name one whisker"):
        read_wrenches(path)


def test_a_stimulus_set_is_read_in_world_axes_and_as_readings_alone(tmp_path):
    from brainbench.stimuli import Frames, Scene, WhiskerArray, simulate, write_stimulus_set

    array, found = WhiskerArray.of("mouse", whiskers="C1"), {}
    for axes in ("world", "follicle"):
        dataset = simulate(Scene("air", array, frames=Frames(0.04, 0.004, 4, axes=axes)), cache=False, fidelity="fast")
        found[axes] = read_wrenches(write_stimulus_set(dataset, tmp_path / f"{axes}.h5"))["wrench"].values
    assert np.abs(found["world"]).max() > 0
    np.testing.assert_allclose(found["follicle"], found["world"], atol=1e-6 * np.abs(found["world"]).max())
    means = simulate(Scene("air", array, frames=Frames(count=2, average=3)), cache=False, fidelity="fast")
    with pytest.raises(DataError, match="mean of 3 readings"):
        read_wrenches(write_stimulus_set(means, tmp_path / "means.h5"))


def test_unknown_channels_and_noise_are_refused():
    with pytest.raises(UsageError, match="Fx"):
        new_wrenches(TIMES, VALUES[:, :1], ["Fq"])
    with pytest.raises(UsageError, match=r"noise .*above 0; received 0\.0"):
        new_wrenches(TIMES, VALUES, noise=0.0)
