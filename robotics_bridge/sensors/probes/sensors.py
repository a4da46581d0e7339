"""Probes: distance to surfaces before contact, depth in contact, and contact as a bit (thesis 4.2–4.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brainbench.core.limits import Limit, NotNegative, limited
from brainbench.core.reading.ranges import check_fields
from robotics_bridge.sensors.noise.model import PROBE_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.sensor import QuerySensor


@dataclass(frozen=True, kw_only=True)
@limited
class SurfaceDistanceProbe(QuerySensor):
    """Shortest signed distance [N] from each probe to the surfaces it tracks (m), negative inside.

    Needs no contact. Its noise knob ``radius`` is an error of the distance.
    """

    nearest: bool = False
    """True if the nearest surface points are kept too (``SensorSuite.read_nearest``)."""
    max_range: Annotated[float, Limit(above=0, infinite=True)] = math.inf
    """Distance (m) that is read where nothing is nearer."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS
    shared: ClassVar[tuple[str, ...]] = ("query", "nearest")
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.runtime:DistanceRuntime"


@dataclass(frozen=True, kw_only=True)
class ContactDepthProbe(QuerySensor):
    """Depth [N] to which each probe's sensing sphere overlaps what touches the link (m; thesis 4.2)."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.runtime:DepthRuntime"


@dataclass(frozen=True, kw_only=True)
@limited
class ContactProbe(QuerySensor):
    """Contact [N] as 0 or 1, from the depth by a Schmitt trigger (thesis 4.3); noise acts on the depth."""

    threshold: NotNegative = 5e-4
    """Depth η_on (m) beyond which contact begins."""
    release: NotNegative | None = None
    """Depth η_off (m) down to which it lasts; by default the threshold (published with noise: 2e-4)."""

    units: ClassVar[str] = "1"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.runtime:DepthRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "release", least=0, most=self.threshold)
