"""Probes: distance to surfaces before contact, depth in contact, and contact as a bit (thesis 4.2–4.3); runtimes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from brainbench.core.devices import warp
from brainbench.core.errors import check_number
from brainbench.core.limits import Limit, NotNegative, limited
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.kernels.probe import probe_kernel
from robotics_bridge.sensors.noise.model import PROBE_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext
from robotics_bridge.sensors.sensor import QuerySensor


@limited(kw_only=True)
class SurfaceDistanceProbe(QuerySensor):
    """Shortest signed distance [N] from each probe to the surfaces it tracks (m), negative inside.

    Needs no contact. Its noise knob ``radius`` is an error of the distance.
    """

    max_range: Annotated[float, Limit(above=0, infinite=True)] = math.inf
    """Distance (m) that is read where nothing is nearer."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:SurfaceRuntime"


@dataclass(frozen=True, kw_only=True)
class ContactDepthProbe(QuerySensor):
    """Depth [N] to which each probe's sensing sphere overlaps what touches the link (m; thesis 4.2)."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:SurfaceRuntime"


@limited(kw_only=True)
class ContactProbe(QuerySensor):
    """Contact [N] as 0 or 1, from the depth by a Schmitt trigger (thesis 4.3); noise acts on the depth."""

    threshold: NotNegative = 5e-4
    """Depth η_on (m) beyond which contact begins."""
    release: NotNegative | None = None
    """Depth η_off (m) down to which it lasts; by default the threshold (published with noise: 2e-4)."""

    units: ClassVar[str] = "1"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:SurfaceRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.release is not None:
            check_number("release", self.release, least=0, most=self.threshold)


def _readout(sensor: QuerySensor) -> tuple[str, tuple[float, float]]:
    """Return what a sensor reads, and the limits of :func:`probe_kernel`."""
    if isinstance(sensor, SurfaceDistanceProbe):
        return "distance", (sensor.max_range, 0.0)
    if isinstance(sensor, ContactProbe):
        return "contact", (sensor.threshold, sensor.threshold if sensor.release is None else sensor.release)
    return "depth", (0.0, 0.0)


class SurfaceRuntime(ProbeRuntime):
    """Serves distance, depth or contact probes of one group."""

    def __init__(self, sensors: Mapping[str, QuerySensor], context: SuiteContext) -> None:
        (reads, *_), limits = zip(*map(_readout, sensors.values()), strict=True)
        super().__init__(sensors, 1, context, reach=None if reads == "distance" else 0.0)
        raycast = next(iter(sensors.values())).query == "raycast"
        self._kernel = probe_kernel(self.kinds, raycast, reads, self.mode, *self.stores)
        self._limits = context.array(limits, warp().vec2f)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        self.launch(self._kernel, self.probes, c.solids.struct, c.pairs.struct, self.io, self._limits)
