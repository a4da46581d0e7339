"""Materials of the temperature grid: what they may be, and how they are named."""

from __future__ import annotations

import math

import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.temperature.materials import MATERIALS, ThermalBody, ThermalMaterial, material


def test_a_material_goes_by_its_name_or_by_itself():
    assert material("steel") is material(MATERIALS["steel"]) is MATERIALS["steel"]
    with pytest.raises(UsageError, match="did you mean 'wood'"):
        material("woood")


def test_diffusivity_and_effusivity_give_back_conductivity():
    glass = MATERIALS["glass"]
    assert glass.effusivity * math.sqrt(glass.diffusivity) == pytest.approx(glass.conductivity)


@pytest.mark.parametrize("value", [math.nan, math.inf, -300.0, True])
def test_touched_bodies_and_materials_have_ranges(value):
    with pytest.raises(UsageError, match=rf"temperature .*received {value}"):
        ThermalBody(temperature=value)
    for name in ("conductivity", "density", "specific_heat"):
        with pytest.raises(UsageError, match=rf"{name} .*received {value}"):
            ThermalMaterial(**{"conductivity": 1.0, "density": 1.0, "specific_heat": 1.0, name: value})
