"""ProximityTaxel: signal of the object surface near a taxel, before and in contact (thesis 4.11–4.16)."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import ClassVar

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.noise.model import TAXEL_KNOBS
from robotics_bridge.sensors.sensor import Convention, ProbeSensor
from robotics_bridge.sensors.taxels.kinematic import check_convention


@dataclass(frozen=True, kw_only=True)
class ProximityTaxel(ProbeSensor):
    """Force (N) and torque (N·m) [N, 6] from surface points within the sensing radius, in the link frame.

    Every tracked point p within R of the taxel adds its overlap P = R − |p − q|, scaled by density / point count:
    a force k P along the normal a, and k_s P times the point's velocity across a.

    ``thesis`` pulls along +a and takes the torque about the taxel (published); ``physical`` pushes the sensor along
    −a and takes it about the link's origin, so that taxels add up to a wrench. Defaults: published parameters.

    Raises:
        UsageError: the convention is unknown, or it follows no surface point.
    """

    stiffness: float = 300.0
    """k, N/m."""
    coupling: float = 10.0
    """k_s, N·s/m²."""
    density: float = 100.0
    """Scale of the point density (4.14)."""
    points: int = 5000
    """Surface points spread over all tracked geometries (the published configuration file has 1000)."""
    convention: Convention = "physical"

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.taxels.runtime:ProximityRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_convention(self.convention)
        if self.points < 1:
            raise UsageError(f"A proximity taxel needs at least one surface point; received {self.points}.")

    def group(self) -> Hashable:
        """Return the convention and the surface points that are shared."""
        return (self.convention, self.points, self.track, self.link if not self.track else "")
