"""Probes: distance to surfaces before contact, depth in contact, and contact as a bit (thesis 4.2–4.3)."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from robotics_bridge.sensors.noise.model import PROBE_KNOBS, TAXEL_KNOBS
from robotics_bridge.sensors.sensor import ProbeRuntime, QuerySensor

if TYPE_CHECKING:
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.sensor import Context


@dataclass(frozen=True, kw_only=True)
class SurfaceDistanceProbe(QuerySensor):
    """Shortest signed distance [N] from each probe to the surfaces it tracks (m), negative inside.

    Needs no contact. Its noise knob ``radius`` is an error of the distance.

    Raises:
        UsageError: ``max_range`` is not positive.
    """

    nearest: bool = False
    """Whether the nearest surface points are kept too (``SensorSuite.read_nearest``)."""
    max_range: float = math.inf
    """Distance (m) that is read where nothing is nearer."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.max_range > 0:
            raise UsageError(f"max_range is a positive distance (m); received {self.max_range!r}.")

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return (self.query, self.nearest)

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> DistanceRuntime:
        """Return the runtime that serves these sensors together."""
        return DistanceRuntime(sensors, context)


class DistanceRuntime(ProbeRuntime):
    """Serves surface-distance probes.

    Args:
        sensors: Of one group, by name; those of a group share what decides which kernels run.
        context: Of the suite: scene, environments, device, clock and geometries.
    """

    def __init__(self, sensors: Mapping[str, SurfaceDistanceProbe], context: Context) -> None:
        super().__init__(sensors, 1, context, reach=None)
        first = next(iter(sensors.values()))
        wp = warp()
        self._options = (first.query == "raycast", first.nearest)
        ranges = np.array([sensor.max_range for sensor in sensors.values()], np.float32)
        self._limits = wp.array(ranges, dtype=wp.float32, device=context.device)
        shape = (3, context.num_envs, self.count) if first.nearest else (1, 1, 1)
        self.points: Any = wp.zeros(shape, dtype=wp.float32, device=context.device)
        """Nearest points [3, B, N] in the link frame (m)."""

    def update(self, state: HandState, dt: float) -> None:
        """Read the state."""
        from robotics_bridge.sensors.probes.kernels.probe import distance_kernel

        self.begin(state, dt)
        kernel = distance_kernel(self.kinds, *self._options, self.mode, *self.stores)
        c = self.context
        self.launch(
            kernel, self.probes, c.solids.struct, c.pairs.struct, self.io, self.knobs, self._limits, self.points
        )
        self.finish(dt)

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes], readings included, without history and delay."""
        return super().state_bytes + (12 * self.count if self._options[1] else 0)


@dataclass(frozen=True, kw_only=True)
class ContactDepthProbe(QuerySensor):
    """How deep each probe's sensing sphere overlaps what touches the link [N] (m; thesis 4.2)."""

    units: ClassVar[str] = "m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> DepthRuntime:
        """Return the runtime that serves these sensors together."""
        return DepthRuntime(sensors, context, binary=False)


@dataclass(frozen=True, kw_only=True)
class ContactProbe(QuerySensor):
    """Contact [N] as 0 or 1, from the depth by a Schmitt trigger (thesis 4.3); noise acts on the depth.

    Raises:
        UsageError: the threshold is negative, or the release lies outside 0 and the threshold.
    """

    threshold: float = 5e-4
    """Depth η_on (m) beyond which contact begins."""
    release: float | None = None
    """Depth η_off (m) down to which it lasts; by default the threshold (published with noise: 2e-4)."""

    units: ClassVar[str] = "1"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.threshold < 0 or (self.release is not None and not 0 <= self.release <= self.threshold):
            raise UsageError(
                f"Contact ends at a depth between 0 and the threshold; received threshold={self.threshold!r} m and "
                f"release={self.release!r} m."
            )

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> DepthRuntime:
        """Return the runtime that serves these sensors together."""
        return DepthRuntime(sensors, context, binary=True)


class DepthRuntime(ProbeRuntime):
    """Serves contact-depth and contact probes.

    Args:
        sensors: Of one group, by name; those of a group share what decides which kernels run.
        context: Of the suite: scene, environments, device, clock and geometries.
        binary: Whether the sensors are contact probes, read as 0 or 1.
    """

    def __init__(
        self, sensors: Mapping[str, ContactDepthProbe] | Mapping[str, ContactProbe], context: Context, *, binary: bool
    ) -> None:
        super().__init__(sensors, 1, context)
        wp = warp()
        self._options = (next(iter(sensors.values())).query == "raycast", binary)
        limits = np.zeros((len(sensors), 2), np.float32)
        for row, sensor in zip(limits, sensors.values(), strict=True):
            if isinstance(sensor, ContactProbe):
                row[:] = sensor.threshold, sensor.threshold if sensor.release is None else sensor.release
        self._limits = wp.array(limits, dtype=wp.vec2f, device=context.device)

    def update(self, state: HandState, dt: float) -> None:
        """Read the state."""
        from robotics_bridge.sensors.probes.kernels.probe import depth_kernel

        self.begin(state, dt)
        kernel = depth_kernel(self.kinds, *self._options, self.mode, *self.stores)
        c = self.context
        self.launch(kernel, self.probes, c.solids.struct, c.pairs.struct, self.io, self.knobs, self._limits)
        self.finish(dt)
