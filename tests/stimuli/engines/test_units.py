"""The units of the engines are consistent: laws of mechanics hold in them without factors."""

import pytest

from brainbench.stimuli.engines.units import MICRO, MILLI


def test_force_is_mass_times_acceleration():
    mass, acceleration = 3e-7, 12.0
    in_milligrams, in_mm_per_ms2 = mass * MICRO, acceleration * MILLI / MILLI**2
    assert in_milligrams * in_mm_per_ms2 == pytest.approx(mass * acceleration * MILLI)


def test_torque_is_force_times_lever():
    force, lever = 2e-3, 0.04
    assert (force * MILLI) * (lever * MILLI) == pytest.approx(force * lever * MICRO)
