"""Materials that heat passes through, and bodies that are touched. Temperatures in °C."""

from __future__ import annotations

import math
from typing import Annotated

from brainbench.core.errors import check_name
from brainbench.core.limits import Limit, Positive, Share, limited

ABSOLUTE_ZERO = -273.15  # [°C]


@limited
class ThermalMaterial:
    """Conduction, storage and radiation of heat in a body."""

    conductivity: Positive
    """k [W/(m·K)]."""
    density: Positive
    """ρ [kg/m³]."""
    specific_heat: Positive
    """c_p [J/(kg·K)]."""
    emissivity: Share = 0.9

    @property
    def diffusivity(self) -> float:
        """α = k / (ρ c_p) [m²/s]."""
        return self.conductivity / (self.density * self.specific_heat)

    @property
    def effusivity(self) -> float:
        """√(k ρ c_p) [W·s^½/(m²·K)], which sets the temperature at a contact."""
        return math.sqrt(self.conductivity * self.density * self.specific_heat)


MATERIALS: dict[str, ThermalMaterial] = {
    "aluminium": ThermalMaterial(237.0, 2700.0, 900.0, 0.1),
    "steel": ThermalMaterial(15.0, 7900.0, 480.0, 0.5),
    "copper": ThermalMaterial(401.0, 8960.0, 385.0, 0.1),
    "glass": ThermalMaterial(1.0, 2500.0, 840.0, 0.92),
    "wood": ThermalMaterial(0.16, 700.0, 1700.0, 0.9),
    "rubber": ThermalMaterial(0.16, 1100.0, 1900.0, 0.85),
    "silicone": ThermalMaterial(0.25, 1100.0, 1300.0, 0.9),
    "plastic": ThermalMaterial(0.2, 1050.0, 1300.0, 0.9),
    "skin": ThermalMaterial(0.37, 1109.0, 3391.0, 0.98),
    "water": ThermalMaterial(0.6, 998.0, 4182.0, 0.96),
}
"""Handbook values at room temperature (Incropera & DeWitt; skin: IT'IS tissue data base)."""


def material(name: str | ThermalMaterial) -> ThermalMaterial:
    """Return a material by name of :data:`MATERIALS`; a material passes through."""
    if isinstance(name, ThermalMaterial):
        return name
    check_name("thermal material", name, MATERIALS)
    return MATERIALS[name]


@limited
class ThermalBody:
    """Material and temperature of a link that may be touched."""

    material: str | ThermalMaterial = "plastic"
    temperature: Annotated[float, Limit(least=ABSOLUTE_ZERO)] = 22.0
    """At the start [°C]; later through :func:`robotics_bridge.sensors.temperature.runtime.link_temperature`."""
