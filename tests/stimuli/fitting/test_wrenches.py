"""Wrenches are read from tables, HDF5 files, time series and stimulus sets; without time stamps they are refused."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.fitting import new_wrenches, read_wrenches

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
