"""Options of sensors: numbers that would silently switch a sensor off are refused."""

from __future__ import annotations

import math

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.sensors import (
    AfferentFilter,
    ContactProbe,
    Probes,
)

PROBE = Probes([[0, 0, 0]], [[0, 0, 1.0]], 0.002)


def test_contact_ends_no_deeper_than_it_begins() -> None:
    with pytest.raises(UsageError, match=r"release .*at most 0\.001; received 0\.002"):
        ContactProbe(link="hand", probes=PROBE, threshold=1e-3, release=2e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.01])
def test_one_row_of_a_grid_has_a_finite_size_too(value) -> None:
    with pytest.raises(UsageError, match=rf"pitch .*{value}"):
        Probes.grid(1, 3, size=(value, 0.01))


@pytest.mark.parametrize("rate", [math.nan, math.inf, -1.0])
def test_bands_need_a_rate(rate) -> None:
    with pytest.raises(UsageError, match=rf"rate .*received {rate}"):
        AfferentFilter(rate)
