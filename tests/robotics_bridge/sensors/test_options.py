"""Options of sensors: numbers that would silently switch a sensor off are refused."""

from __future__ import annotations

import math

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.sensors import (
    AfferentFilter,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Probes,
    ProximityTaxel,
    SurfaceDistanceProbe,
)
from robotics_bridge.sensors.taxels.sensors import Layer

PROBE = Probes([[0, 0, 0]], [[0, 0, 1.0]], 0.002)
POSITIVE = {
    KinematicTaxel: ("stiffness", "damping", "exponent", "shear", "twist", "friction", "grip"),
    ProximityTaxel: ("stiffness", "coupling", "density"),
    ElastomerTaxel: (
        "dilate_scale", "dilate_spread", "shear_scale", "shear_spread", "exponent", "enter", "leave", "points",
    ),
    ContactProbe: ("threshold", "release"),
}  # fmt: skip
WRONG = (math.nan, math.inf, -1.0, True)


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in POSITIVE.items() for name in names])
def test_numbers_of_sensors_have_ranges(kind, name, value) -> None:
    with pytest.raises(UsageError, match=rf"{name} must be .*received {value}"):
        kind(link="hand", probes=PROBE, **{name: value})


@pytest.mark.parametrize("value", [math.nan, math.inf, True])
@pytest.mark.parametrize("name", ["expansion", "frame"])
def test_both_numbers_of_a_layer_are_looked_at(name, value) -> None:
    for pair in ((1.0, value), (value, 1.0)):
        with pytest.raises(UsageError, match=rf"{name} .*received {value}"):
            Layer(**{name: pair})
    with pytest.raises(UsageError, match=f"{name} holds 2 numbers"):
        Layer(**{name: (1.0,)})


@pytest.mark.parametrize("value", [math.nan, math.inf, True])
def test_a_layer_widens_by_a_number(value) -> None:
    with pytest.raises(UsageError, match=rf"expansion .*received {value}"):
        Layer(expansion=value)


@pytest.mark.parametrize("value", [math.nan, -1.0, 0.0, True])
def test_a_range_of_distances_is_positive_or_endless(value) -> None:
    assert SurfaceDistanceProbe(link="hand", probes=PROBE, max_range=math.inf).max_range == math.inf
    with pytest.raises(UsageError, match=rf"max_range .*received {value}"):
        SurfaceDistanceProbe(link="hand", probes=PROBE, max_range=value)


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
