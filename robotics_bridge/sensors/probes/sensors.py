"""Probes: distance to surfaces before contact, depth in contact, and contact as a bit (thesis 4.2–4.3); runtimes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import check_number
from brainbench.core.limits import Limit, NotNegative, limited
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.kernels.probe import depth_kernel, distance_kernel
from robotics_bridge.sensors.noise.model import PROBE_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext
from robotics_bridge.sensors.sensor import QuerySensor


@dataclass(frozen=True, kw_only=True)
@limited
class SurfaceDistanceProbe(QuerySensor):
    """Shortest signed distance [N] from each probe to the surfaces it tracks (m), negative inside.

    Needs no contact. Its noise knob ``radius`` is an error of the distance.
    """

    max_range: Annotated[float, Limit(above=0, infinite=True)] = math.inf
    """Distance (m) that is read where nothing is nearer."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:DistanceRuntime"


@dataclass(frozen=True, kw_only=True)
class ContactDepthProbe(QuerySensor):
    """Depth [N] to which each probe's sensing sphere overlaps what touches the link (m; thesis 4.2)."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:DepthRuntime"


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
    runtime: ClassVar[str] = "robotics_bridge.sensors.probes.sensors:DepthRuntime"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.release is not None:
            check_number("release", self.release, least=0, most=self.threshold)


class DistanceRuntime(ProbeRuntime):
    """Serves surface-distance probes of one group."""

    def __init__(self, sensors: Mapping[str, SurfaceDistanceProbe], context: SuiteContext) -> None:
        super().__init__(sensors, 1, context, reach=None)
        first = next(iter(sensors.values()))
        self._kernel = distance_kernel(self.kinds, first.query == "raycast", self.mode, *self.stores)
        self._limits = context.array([sensor.max_range for sensor in sensors.values()], float)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        inputs = [self.probes, c.solids.struct, c.pairs.struct, self.io]
        self.launch(self._kernel, *inputs, self._limits)


class DepthRuntime(ProbeRuntime):
    """Serves contact-depth probes, or contact probes, which are read as 0 or 1."""

    def __init__(
        self, sensors: Mapping[str, ContactDepthProbe] | Mapping[str, ContactProbe], context: SuiteContext
    ) -> None:
        super().__init__(sensors, 1, context)
        first = next(iter(sensors.values()))
        binary = isinstance(first, ContactProbe)
        self._kernel = depth_kernel(self.kinds, first.query == "raycast", binary, self.mode, *self.stores)
        limits = np.zeros((len(sensors), 2))
        for row, sensor in zip(limits, sensors.values(), strict=True):
            if isinstance(sensor, ContactProbe):
                row[:] = sensor.threshold, sensor.threshold if sensor.release is None else sensor.release
        self._limits = context.array(limits, warp().vec2f)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        self.launch(self._kernel, self.probes, c.solids.struct, c.pairs.struct, self.io, self._limits)
