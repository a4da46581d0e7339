"""ElastomerTaxel: displacement of markers on a soft pad, by dilation and by anchored shear (thesis 4.17–4.21)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from brainbench.core.errors import UsageError, check_name
from brainbench.core.reading.ranges import check_fields
from robotics_bridge.sensors.noise.model import TAXEL_KNOBS
from robotics_bridge.sensors.sensor import QuerySensor

if TYPE_CHECKING:
    from robotics_bridge.physics.scene import TouchScene


@dataclass(frozen=True, kw_only=True)
class Layer:
    """Terms of a real gel pad that the published equations lack; derived in docs/elastomers.md."""

    poisson: float = 0.45
    """Poisson ratio ν: how compressible the gel is (0 to 0.5). It shapes the shear field."""
    softening: float = 1e-3
    """Radius over which a surface point spreads its traction (m)."""
    thickness: float = 0.0
    """Thickness of a layer bonded to a rigid base (m); 0 means a half-space."""
    recoil: float = 0.0
    """κ: how much of the push past its middle turns round, by 1 − κ λ_d r². The net push is 1 − 2κ of the published
    one: at ½ the gel takes all that is displaced up, above it is drawn in, as under any load on a compressible body."""
    expansion: float | tuple[float, float] = 0.0
    """Lateral strain of the pad per metre of its mean indentation (1/m), or along and across: what the gel cannot
    compress, it widens."""
    frame: tuple[float, float] | None = None
    """Half widths (m), along and across, of the clamped frame where the widening vanishes; None means free edges."""

    def __post_init__(self) -> None:
        check_fields(self, "poisson", least=0, most=0.5)
        check_fields(self, "softening", above=0)
        check_fields(self, "thickness", least=0)
        check_fields(self, "recoil", least=0, most=2)
        check_fields(self, "expansion", items=2 if isinstance(self.expansion, tuple) else 0)
        check_fields(self, "frame", items=2, above=0)


@dataclass(frozen=True, kw_only=True)
class ElastomerTaxel(QuerySensor):
    """Marker displacement [N, 3] in the link frame (m).

    The pad is the surface of the link's own geometries (or the plane of the probes, if the link has none). What
    indents it pushes markers apart (4.19); points that slide along it drag them (4.20). Defaults are the published
    parameters; ``layer`` replaces the Gaussian shear kernel by that of an elastic layer.
    """

    dilate_scale: float = 100.0
    """s_d, 1/m."""
    dilate_spread: float = 8000.0
    """λ_d, 1/m²."""
    shear_scale: float = 100.0
    """s_s, 1/m (the published configuration file has 200)."""
    shear_spread: float = 2000.0
    """λ_s, 1/m²."""
    exponent: float = 1.2
    """α of the bulge along the normal."""
    points: int = 1000
    """Surface points of what is tracked that are followed for shear; 0 leaves shear out."""
    enter: float = 1e-5
    """Depth (m) at which a point anchors."""
    leave: float = 1e-4
    """Height (m) above the pad at which it lets go."""
    layer: Layer | None = None
    dilation: Literal["auto", "separable", "fft", "direct"] = "auto"
    """Way to sum sources. Planar grids: ``separable`` passes (``auto``), or ``fft``. Curved ones: ``direct``."""

    channels: ClassVar[int] = 3
    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("query", "way", "points", "followed")
    runtime: ClassVar[str] = "robotics_bridge.sensors.elastomer.runtime:ElastomerRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        ways = ("auto", "separable", "fft", "direct")
        check_name("way to sum dilation", self.dilation, ways)
        if self.dilation in ("separable", "fft") and not self.planar:
            raise UsageError(
                f"dilation={self.dilation!r} needs a regular planar grid (Probes.grid); these probes are "
                "placed freely. Use 'auto' or 'direct'."
            )
        if self.dilation == "separable" and self.layer and self.layer.recoil:
            raise UsageError("A layer with recoil has no separable dilation; use dilation='auto', 'fft' or 'direct'.")
        check_fields(self, "points", least=0, whole=True)
        check_fields(self, "dilate_scale", "dilate_spread", "shear_scale", "shear_spread", "enter", "leave", least=0)
        check_fields(self, "exponent", above=0)

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

    def own(self, scene: TouchScene) -> tuple[int, ...]:
        """Return the geometries of its own link that can be indented."""
        return tuple(g for g in scene.geometries_of(self.link) if scene.geometries[g].kind != "other")

    def queries(self, scene: TouchScene) -> frozenset[tuple[str, int]]:
        """Return the queries of what it tracks, and of its own link where points are followed."""
        return super().queries(scene) | {(self.query, geometry) for geometry in self.own(scene) if self.points}
