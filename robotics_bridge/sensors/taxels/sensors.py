"""Taxels of force and torque: from depth, normal and relative velocity (thesis 4.4–4.10), or from nearby points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from brainbench.core.errors import UsageError, check_name
from brainbench.core.reading.ranges import check_fields
from robotics_bridge.sensors.noise.model import GRID_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.sensor import Convention, ProbeSensor, QuerySensor

PUBLISHED_TWIST = 2.0
"""k_ω of the published parameters (N·m·s): that of a disc of 1.4 m, which drowns every other moment when an object
turns."""
CONVENTIONS = ("physical", "thesis")


@dataclass(frozen=True, kw_only=True)
class KinematicTaxel(QuerySensor):
    """Force (N) and torque (N·m) on the sensor [N, 6], in the link frame, torques about the link's origin.

    With depth d, outward normal m of what is touched and relative velocity v (split into normal and tangential)::

        f = k_n d^α m + c_n d^α v_n ± k_t v_t,    τ = x × f ± k_ω (ω·m) m

    ``physical`` takes plus signs (friction drags the sensor along) and never pulls; ``thesis`` takes the published
    minus signs. Defaults are the published parameters (4.10), but for k_ω in the physical convention.
    """

    stiffness: float = 500.0
    """k_n, N/m^α."""
    damping: float = 1.0
    """c_n, N·s/m^(1+α)."""
    exponent: float = 1.2
    """α."""
    shear: float = 2.0
    """k_t, N·s/m."""
    twist: float | None = None
    """k_ω, N·m·s. None is that of a disc of the largest sensing radius R that slips with k_t, k_t R²/2 (1.6e-5 at
    4 mm), and with ``thesis`` :data:`PUBLISHED_TWIST`."""
    friction: float | None = None
    """μ: with it friction holds at rest. Each taxel holds the point that it touched first by a spring, up to μ times
    its normal force, and lets it slide beyond (Coulomb); k_t and k_ω play no part. None: k_t v_t, nothing at rest."""
    grip: float = 2 / 3
    """ρ: tangential over normal stiffness of that spring; 2 (1 − ν) / (2 − ν) of a thick skin (Mindlin 1949), here with
    ν = ½."""
    convention: Convention = "physical"
    total: Literal["law", "engine"] = "law"
    """``law``: each taxel by itself, as published. ``engine``: the taxels of a sensor add up to the forces, friction at
    rest included, of the engine's contacts between its link and what it tracks. Each contact is spread over the taxels
    that feel that body from that side, by d^α and, with ``friction``, by their springs; stiffness, damping, shear and
    twist play no part. A taxel without such
    a contact reads 0; the force of a contact beside all taxels is missing (``SensorSuite.unfelt``)."""

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = GRID_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("query", "convention", "total", "sticky")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("force convention", self.convention, CONVENTIONS)
        check_name("total of a force field", self.total, ("law", "engine"))
        check_fields(self, "stiffness", "damping", "shear", "twist", "friction", least=0)
        check_fields(self, "exponent", "grip", above=0)
        if self.sticky and self.convention == "thesis":
            raise UsageError("The published law has no friction at rest; leave out friction or convention='thesis'.")

    @property
    def runtime(self) -> str:  # type: ignore[override]
        """``package.module:Class`` of the runtime that serves it."""
        own = "contact_load:ContactLoadRuntime" if self.total == "engine" else "runtime:KinematicRuntime"
        return f"robotics_bridge.sensors.taxels.{own}"

    @property
    def ignores_load(self) -> bool:
        """True if it reads a law of depths in newtons, published signs aside."""
        return self.total == "law" and self.convention == "physical"

    @property
    def torsion(self) -> float:
        """k_ω that acts (N·m·s): ``twist``, or what stands for None."""
        # No field: a copy by dataclasses.replace with another radius or shear would keep the old number.
        if self.twist is not None:
            return self.twist
        radius = float(self.probes.radius.max(initial=0.0))
        return PUBLISHED_TWIST if self.convention == "thesis" else self.shear * radius**2 / 2

    @property
    def sticky(self) -> bool:
        """True if its taxels hold what they touch."""
        return self.friction is not None


@dataclass(frozen=True, kw_only=True)
class ProximityTaxel(ProbeSensor):
    """Force (N) and torque (N·m) [N, 6] from surface points within the sensing radius, link frame (thesis 4.11–4.16).

    Every tracked point p within R of the taxel adds its overlap P = R − |p − q|, scaled by density / point count:
    a force k P along the normal a, and k_s P times the point's velocity across a.

    ``thesis`` pulls along +a and takes the torque about the taxel (published); ``physical`` pushes the sensor along
    −a and takes it about the link's origin, so that taxels add up to a wrench. Defaults: published parameters.
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
    shared: ClassVar[tuple[str, ...]] = ("convention", "points", "followed")
    runtime: ClassVar[str] = "robotics_bridge.sensors.taxels.runtime:ProximityRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("force convention", self.convention, CONVENTIONS)
        check_fields(self, "stiffness", "coupling", "density", least=0)
        check_fields(self, "points", least=1, whole=True)
