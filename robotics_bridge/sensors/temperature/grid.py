"""TemperatureGrid: the temperature field of a link in cells, warmed and cooled by what it touches (thesis 4.35–4.40).

Every part of the heat balance is stepped exponentially or by secants, so that no time step is too long. Against
the published equations: the mean of an insulated grid is kept (4.35 drains it), surface losses act through the
exposed area and per cell volume (4.37), contact areas are areas, and the element's lag is exact (4.40).
Temperatures in °C. Letters: B environment, N cell.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_number
from brainbench.core.limits import Count, Limit, NotNegative, Positive, limited
from brainbench.core.rotations import to_matrices
from robotics_bridge.physics.scene import Geometry, TouchScene
from robotics_bridge.sensors.sensor import Sensor
from robotics_bridge.sensors.temperature.materials import ABSOLUTE_ZERO, ThermalBody, ThermalMaterial, material


@limited(kw_only=True)
class TemperatureGrid(Sensor):
    """Temperature [nx, ny, nz] of the cells of a link (°C)."""

    cells: tuple[Count, Count, Count] = (2, 2, 2)
    """Along the axes of the link; at most a million."""
    low: tuple[float, float, float] | None = None
    """Lower corner of the grid [m, link frame]; None takes the box around the link's geometries."""
    high: tuple[float, float, float] | None = None
    """Upper corner [m, link frame]."""
    material: str | ThermalMaterial = "silicone"
    """Material of the link."""
    base_temperature: Annotated[float, Limit(least=ABSOLUTE_ZERO)] = 22.0
    """Temperature of all cells at a reset [°C]."""
    ambient_temperature: Annotated[float, Limit(least=ABSOLUTE_ZERO)] = 22.0
    """Temperature of the surroundings [°C]."""
    convection: NotNegative = 10.0
    """Coefficient h [W/(m²·K)] over the outer faces; 0 for none. Radiation follows the material's emissivity."""
    radiates: bool = True
    """True if outer faces radiate."""
    source: Any = 0.0
    """Heat made inside [W/m³]: one number, or an array [nx, ny, nz]."""
    bodies: Mapping[str, ThermalBody] = field(default_factory=dict)
    """Link → what it is made of, for links that may touch this one; all others are ``unlisted``."""
    unlisted: ThermalBody = field(default_factory=ThermalBody)
    """Material and temperature of every other link, and of flexes."""
    conduction: Literal["physical", "thesis"] = "physical"
    """``physical``: the cell (half its depth, and the spreading of a small spot), the interface and the touched body
    (a half-space that gave heat through the spot since the contact began) in series. ``thesis``: 4.38 and 4.39,
    harmonic conductivity over the length V / A."""
    contact_conductance: Annotated[float, Limit(least=0, infinite=True)] = math.inf
    """Conductance of the bare interface [W/(m²·K)]; infinite is a perfect one."""
    contact_radius: Positive = 0.005
    """Radius R of the surfaces at a contact point [m]: the area of a contact of depth δ is π (2 R δ − δ²)."""
    depth_weight: NotNegative = 1.0
    """d_w of the published floor of the contact area, π d_w δ R with R supplied by ``contact_radius``."""
    tau: NotNegative = 0.0
    """Time constant of the sensing element [s]; 0 reads the cell itself."""
    warm_range: Annotated[float, Limit(least=0, infinite=True)] = math.inf
    """Range above the base temperature in which the element reads [K]."""
    cold_range: Annotated[float, Limit(least=0, infinite=True)] = math.inf
    """Range below it [K]; skin reads farther down than up."""

    units: ClassVar[str] = "degC"
    runtime: ClassVar[str] = "robotics_bridge.sensors.temperature.runtime:TemperatureRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("cells of the grid, all together,", math.prod(map(int, self.cells)), most=10**6)
        if (self.low is None) != (self.high is None):
            raise UsageError("Give both corners of the grid, low and high, or neither.")
        if self.low is not None and self.high is not None and not np.less(self.low, self.high).all():
            raise UsageError(f"The corners of the grid differ along every axis; received {self.low}, {self.high}.")
        if np.shape(self.source) not in ((), tuple(self.cells)):
            raise UsageError(f"source is a number or an array {tuple(self.cells)}; received {np.shape(self.source)}.")
        for value in np.ravel(self.source):
            check_number("source", value)
        for body in (*self.bodies.values(), self.unlisted):
            material(body.material)
        material(self.material)

    def layout(self) -> tuple[int, ...]:
        """Return the shape (nx, ny, nz) of the reading of one environment."""
        return tuple(int(n) for n in self.cells)

    def group(self) -> Hashable:
        """Return what is known of other links: grids for which it is the same share one runtime."""
        return (tuple(sorted(self.bodies.items(), key=lambda pair: pair[0])), self.unlisted)

    def corners(self, scene: TouchScene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lower and upper corner of the grid [3] (m, link frame)."""
        if self.low is not None and self.high is not None:
            return np.array(self.low, float), np.array(self.high, float)
        boxes = [_bounds(scene.geometries[index]) for index in scene.geometries_of(self.link)]
        boxes = [box for box in boxes if np.isfinite(box).all()]
        if not boxes:
            raise UsageError(f"Link {self.link!r} has no geometry of finite size; give the grid its corners low, high.")
        return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def _bounds(geometry: Geometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the box around a geometry in the link's frame (m)."""
    # Row i of the rotation is the link's axis i in the frame of the geometry.
    # The box along the link's axes from the support function of the solid, which is exact for turned ones too.
    axes, place = to_matrices(geometry.quaternion), np.array(geometry.position)
    return place - geometry.reach(-axes), place + geometry.reach(axes)
