"""Taxels that a ball presses: the law of the simulated ones, its derivatives, and logs that cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.sensors.calibration.calibrate import read_log
from robotics_bridge.sensors.calibration.presses import (
    SHARED,
    Presses,
    answer,
    crosstalk_of,
    forces,
    readings_of,
)
from robotics_bridge.sensors.probes.placement import Probes
from tests.factories.pressed_devices import Planted, plant, respond


@pytest.fixture(scope="module")
def planted() -> Planted:
    return plant(0, shape=(2, 2), touches=4)


def test_the_law_is_that_of_the_simulated_taxels(planted: Planted) -> None:
    simulated = respond(planted.presses, planted.device)
    (felt,) = forces(planted.presses, planted.device, slopes=False)
    assert np.abs(felt - simulated).max() < 1e-5 * np.abs(simulated).max()
    assert np.linalg.norm(simulated, axis=2).max() > 0


def test_readings_lack_nothing_but_noise(planted: Planted) -> None:
    mixing = crosstalk_of(planted.presses.probes)
    rest = planted.presses.readings - readings_of(planted.presses, planted.device, mixing)
    assert rest.std() == pytest.approx(planted.noise.white, rel=0.05)
    assert rest.mean() == pytest.approx(planted.noise.bias, rel=0.1)


@pytest.mark.parametrize("axes", [1, 3])
def test_derivatives_are_those_of_the_readings(axes: int) -> None:
    planted = plant(1, shape=(2, 2), touches=2, axes=axes)
    presses, mixing = planted.presses, crosstalk_of(planted.presses.probes)
    device = replace(planted.device, axes=presses.axes)
    reply = answer(presses, device, mixing)
    np.testing.assert_allclose(reply.readings, readings_of(presses, device, mixing), atol=1e-9)
    for index, name in enumerate(SHARED):
        moved = replace(device, shared=device.shared | {name: device.shared[name] + 1e-6})
        slope = (readings_of(presses, moved, mixing) - reply.readings) / 1e-6
        np.testing.assert_allclose(reply.shared[index], slope, atol=1e-3 * np.abs(slope).max() + 1e-9, err_msg=name)


def test_logs_of_other_devices_and_frames_are_refused(planted: Planted) -> None:
    log, probes = planted.presses.log, planted.presses.probes
    with pytest.raises(DataError, match=r"12 columns of readings and the device 9 taxels.*another device"):
        Presses(log, Probes.grid(3, 3, size=(8e-3, 8e-3)), 5e-3)
    with pytest.raises(DataError, match="No press touches a taxel"):
        Presses(replace(log, ball=planted.presses.ball + 0.1), probes, 5e-3)
    with pytest.raises(DataError, match="inside the ball"):
        Presses(log, probes, 2e-2)
    with pytest.raises(DataError, match="'x', 'y' and 'z'"):
        Presses(replace(log, ball=None), probes, 5e-3)
    with pytest.raises(UsageError, match="scale millimetres"):
        replace(log, ball=1e3 * planted.presses.ball)


def test_a_log_of_presses_has_the_centre_of_the_ball(tmp_path) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{0.01 * k:g},0,0,{0.02 - 1e-4 * k:g},{k}" for k in range(30)]
    path.write_text("\n".join(["time,x,y,z,0", *rows]))
    log = read_log(path)
    assert log.probes == ("0",)
    assert log.ball is not None
    assert log.ball[3] == pytest.approx([0, 0, 0.0197])
    path.write_text("\n".join(["time,x,y,z,0", *rows, rows[-1]]))
    with pytest.raises(DataError, match="Times of a log must rise in equal steps"):
        read_log(path)
    path.write_text("\n".join(["time,x,y,z,0", *rows, "0.3,nan,0,0,1"]))
    with pytest.raises((DataError, UsageError), match=r"nan|finite"):
        read_log(path)
