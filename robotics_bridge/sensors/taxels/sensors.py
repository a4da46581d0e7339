"""Taxels: from depth, normal and velocity (thesis 4.4–4.10), from nearby points, and of elastomers (4.17–4.21)."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, cast

from brainbench.core.errors import UsageError, check_number
from brainbench.core.limits import Count, Limit, NotNegative, Positive, limited
from robotics_bridge.sensors.noise.model import GRID_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.sensor import Convention, ProbeSensor, QuerySensor, Sensor

if TYPE_CHECKING:
    from robotics_bridge.physics.scene import TouchScene

PUBLISHED_TWIST = 2.0
"""k_ω of the published parameters (N·m·s): that of a disc of 1.4 m, which drowns every other moment when an object
turns."""
_LAW = ("stiffness", "damping", "shear", "twist", "convention", "pairs")  # settings of the law alone


@limited(kw_only=True)
class KinematicTaxel(QuerySensor):
    """Force (N) and torque (N·m) on the sensor [N, 6], in the link frame, torques about the link's origin.

    With depth d, outward normal m of what is touched and relative velocity v (split into normal and tangential)::

        f = k_n d^α m + c_n d^α v_n ± k_t v_t,    τ = x × f ± k_ω (ω·m) m

    ``physical`` takes plus signs (friction drags the sensor along) and never pulls; ``thesis`` takes the published
    minus signs. Defaults are the published parameters (4.10), but for k_ω in the physical convention.
    """

    stiffness: NotNegative = 500.0
    """k_n, N/m^α."""
    damping: NotNegative = 1.0
    """c_n, N·s/m^(1+α)."""
    exponent: Positive = 1.2
    """α."""
    shear: NotNegative = 2.0
    """k_t, N·s/m."""
    twist: NotNegative | None = None
    """k_ω, N·m·s. None is that of a disc of the largest sensing radius R that slips with k_t, k_t R²/2 (1.6e-5 at
    4 mm), and with ``thesis`` :data:`PUBLISHED_TWIST`."""
    friction: NotNegative | None = None
    """μ: with it friction holds at rest. Each taxel holds the point that it touched first by a spring, up to μ times
    its normal force, and lets it slide beyond (Coulomb); k_t and k_ω play no part. None: k_t v_t, nothing at rest."""
    grip: Positive = 2 / 3
    """ρ: tangential over normal stiffness of that spring; 2 (1 − ν) / (2 − ν) of a thick skin (Mindlin 1949), here with
    ν = ½."""
    convention: Convention = "physical"
    total: Literal["auto", "engine", "law"] = "auto"
    """``engine``: the taxels of a sensor add up to the forces, friction at rest included, of the engine's contacts
    between its link and what it tracks, and to their moment as far as they push. Each contact is spread over the taxels
    that overlap that body from that side, by d^α and, with ``friction``, by their springs, wherever the engine puts its
    points; that of a flex or a height field over the taxels near it. Stiffness, damping, shear and twist play no part.
    A taxel without such a contact reads 0; the force that no taxel feels is ``SensorSuite.missing``.
    ``law``: each taxel by itself, by its depth, as published, which does not follow the load.
    ``auto``: ``engine`` in scenes of an engine, unless ``stiffness``, ``damping``, ``shear``, ``twist``, the published
    ``convention`` or ``pairs="all"`` is stated, which belong to the law."""

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = GRID_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("query", "convention", "total", "sticky")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sticky and self.convention == "thesis":
            raise UsageError("The published law has no friction at rest; leave out friction or convention='thesis'.")

    def for_scene(self, scene: TouchScene) -> Sensor:
        """Return the sensor with ``total`` settled; the law refuses flexes, which have no distance."""
        total = self.total
        if total == "auto":
            stated = any(getattr(self, name) != getattr(KinematicTaxel, name) for name in _LAW)
            total = "engine" if scene.reports_forces and not stated else "law"
        return replace(self if total == "engine" else cast(KinematicTaxel, super().for_scene(scene)), total=total)

    @property
    def runtime(self) -> str:  # type: ignore[override]
        """``package.module:Class`` of the runtime that serves it."""
        name = "ContactLoadRuntime" if self.total == "engine" else "KinematicRuntime"
        return f"robotics_bridge.sensors.taxels.runtime:{name}"

    @property
    def ignores_load(self) -> bool:
        """True if it reads a law of depths in newtons, published signs aside."""
        return self.total != "engine" and self.convention == "physical"

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


@limited(kw_only=True)
class ProximityTaxel(ProbeSensor):
    """Force (N) and torque (N·m) [N, 6] from surface points within the sensing radius, link frame (thesis 4.11–4.16).

    Every tracked point p within R of the taxel adds its overlap P = R − |p − q|, scaled by density / point count:
    a force k P along the normal a, and k_s P times the point's velocity across a.

    ``thesis`` pulls along +a and takes the torque about the taxel (published); ``physical`` pushes the sensor along
    −a and takes it about the link's origin, so that taxels add up to a wrench. Defaults: published parameters.
    """

    stiffness: NotNegative = 300.0
    """k, N/m."""
    coupling: NotNegative = 10.0
    """k_s, N·s/m²."""
    density: NotNegative = 100.0
    """Scale of the point density (4.14)."""
    points: Count = 5000
    """Surface points spread over all tracked geometries (the published configuration file has 1000)."""
    convention: Convention = "physical"

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("convention", "points", "followed")
    runtime: ClassVar[str] = "robotics_bridge.sensors.taxels.runtime:ProximityRuntime"


@limited(kw_only=True)
class Layer:
    """Terms of a real gel pad that the published equations lack; derived in docs/elastomers.md."""

    poisson: Annotated[float, Limit(least=0, most=0.5)] = 0.45
    """Poisson ratio ν: how compressible the gel is (0 to 0.5). It shapes the shear field."""
    softening: Positive = 1e-3
    """Radius over which a surface point spreads its traction (m)."""
    thickness: NotNegative = 0.0
    """Thickness of a layer bonded to a rigid base (m); 0 means a half-space."""
    recoil: Annotated[float, Limit(least=0, most=2)] = 0.0
    """κ: how much of the push past its middle turns round, by 1 − κ λ_d r². The net push is 1 − 2κ of the published
    one: at ½ the gel takes all that is displaced up, above it is drawn in, as under any load on a compressible body."""
    expansion: float | tuple[float, float] = 0.0
    """Lateral strain of the pad per metre of its mean indentation (1/m), or along and across: what the gel cannot
    compress, it widens."""
    frame: tuple[Positive, Positive] | None = None
    """Half widths (m), along and across, of the clamped frame where the widening vanishes; None means free edges."""


@limited(kw_only=True)
class ElastomerTaxel(QuerySensor):
    """Marker displacement [N, 3] in the link frame (m).

    The pad is the surface of the link's own geometries (or the plane of the probes, if the link has none). What
    indents it pushes markers apart (4.19); points that slide along it drag them (4.20). Defaults are the published
    parameters; ``layer`` replaces the Gaussian shear kernel by that of an elastic layer.
    """

    dilate_scale: NotNegative = 100.0
    """s_d, 1/m."""
    dilate_spread: NotNegative = 8000.0
    """λ_d, 1/m²."""
    shear_scale: NotNegative = 100.0
    """s_s, 1/m (the published configuration file has 200)."""
    shear_spread: NotNegative = 2000.0
    """λ_s, 1/m²."""
    exponent: Positive = 1.2
    """α of the bulge along the normal."""
    points: Annotated[int, Limit(least=0)] = 1000
    """Surface points of what is tracked that are followed for shear; 0 leaves shear out."""
    enter: NotNegative = 1e-5
    """Depth (m) at which a point anchors."""
    leave: NotNegative = 1e-4
    """Height (m) above the pad at which it lets go."""
    layer: Layer | None = None
    dilation: Literal["auto", "separable", "fft", "direct"] = "auto"
    """Way to sum sources. Planar grids: ``separable`` passes (``auto``), or ``fft``. Curved ones: ``direct``."""

    channels: ClassVar[int] = 3
    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("query", "way", "points", "followed")
    runtime: ClassVar[str] = "robotics_bridge.sensors.taxels.elastomer:ElastomerRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dilation in ("separable", "fft") and not self.planar:
            raise UsageError(
                f"dilation={self.dilation!r} needs a regular planar grid (Probes.grid); these probes are "
                "placed freely. Use 'auto' or 'direct'."
            )
        if self.dilation == "separable" and self.layer and self.layer.recoil:
            raise UsageError("A layer with recoil has no separable dilation; use dilation='auto', 'fft' or 'direct'.")

    @property
    def planar(self) -> bool:
        """True if its markers form a regular planar grid without fillers."""
        probes = self.probes
        return probes.pitch is not None and len(probes.shape) == 2 and bool(probes.active.all())

    @property
    def way(self) -> str:
        """Way in which its dilation is summed."""
        if self.dilation != "auto":
            return self.dilation
        if not self.planar:
            return "direct"
        # The factor 1 − κ λ_d r² is no product of two axes, so recoil needs the full convolution.
        return "fft" if self.layer and self.layer.recoil else "separable"

    def pad_geometries(self, scene: TouchScene) -> tuple[int, ...]:
        """Return the geometries of its own link that can be indented."""
        return tuple(g for g in scene.geometries_of(self.link) if scene.geometries[g].kind != "other")

    def queries(self, scene: TouchScene) -> frozenset[tuple[str, int]]:
        """Return the queries of what it tracks, and of its own link where points are followed."""
        return super().queries(scene) | {
            (self.query, geometry) for geometry in self.pad_geometries(scene) if self.points
        }


@limited(kw_only=True)
class Skin:
    """A thin elastic layer bonded to a rigid base, thin beside the contact (Johnson 1985, Contact Mechanics, 5.8).

    It cannot widen, so a pressure p presses it in by δ = p t / M with the constrained modulus
    M = E (1 − ν) / ((1 + ν) (1 − 2ν)), and shear gives way by G = E / (2 (1 + ν)). Taxels are placed on the base.
    """

    thickness: Positive
    """t (m)."""
    modulus: Positive
    """Young's modulus E (Pa)."""
    poisson: Annotated[float, Limit(least=0, most=0.49)] = 0.45
    """ν."""

    def law(self, area: float) -> dict[str, float]:
        """Return the settings of ``KinematicTaxel`` for taxels that take up an area (m²) each.

        Example::

            skin = Skin(thickness=2e-3, modulus=1e5)
            base = Probes.grid(8, 8, size=(0.014, 0.014), center=(0, 0, -skin.thickness), radius=skin.thickness)
            KinematicTaxel(link="tip", probes=base, **skin.law(0.002**2))
        """
        check_number("area (m²)", area, above=0)
        ratio = (1 - 2 * self.poisson) / (2 * (1 - self.poisson))
        constrained = self.modulus / (2 * (1 + self.poisson) * ratio)
        return {"stiffness": constrained * area / self.thickness, "exponent": 1.0, "damping": 0.0, "grip": ratio}
