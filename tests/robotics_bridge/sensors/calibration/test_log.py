"""Logs of devices: what they must hold, and the step of the converter."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.calibration.log import Log, find_quantum
from tests.factories.calibration_logs import READINGS, SIGNAL, TIME


@pytest.mark.parametrize(
    "parts",
    [
        {"readings": np.where(READINGS > 0.9, np.nan, READINGS)},
        {"reference": np.where(SIGNAL > 0.9, np.nan, SIGNAL)},
        {"reference": READINGS},
        {"time": -TIME},
        {"time": 0 * TIME},
        {"time": TIME * np.nan},
        {"readings": READINGS[:, :0]},
        {"probes": ("a",)},
        {"episode": np.zeros(3, int)},
    ],
)
def test_a_log_holds_finite_numbers_that_fit_each_other_at_rising_times(parts) -> None:
    with pytest.raises(UsageError, match=rf"{next(iter(parts))}|Times|names|Readings"):
        Log(**{"time": TIME, "readings": READINGS, "reference": SIGNAL, **parts})


@pytest.mark.parametrize("step", [0.0, 0.01, 0.25, 1.0])
def test_the_quantum_is_found_or_denied(step):
    values = np.random.default_rng(0).normal(size=3000)
    values = step * np.round(values / step) if step else values
    assert find_quantum(values) == pytest.approx(step, rel=1e-6)
