"""Runtimes of distance, depth and contact probes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.kernels.probe import depth_kernel, distance_kernel
from robotics_bridge.sensors.probes.sensors import ContactDepthProbe, ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext


class DistanceRuntime(ProbeRuntime):
    """Serves surface-distance probes of one group."""

    def __init__(self, sensors: Mapping[str, SurfaceDistanceProbe], context: SuiteContext) -> None:
        super().__init__(sensors, 1, context, reach=None)
        first = next(iter(sensors.values()))
        self._kernel = distance_kernel(self.kinds, first.query == "raycast", first.nearest, self.mode, *self.stores)
        self._limits = context.array([sensor.max_range for sensor in sensors.values()], float)
        self.points: Any = context.zeros((3, context.num_envs, self.count) if first.nearest else (1, 1, 1))
        """Nearest points [3, B, N] in the link frame (m)."""
        self.lasting = [self.points] if first.nearest else []
        self.readable += self.lasting

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        inputs = [self.probes, c.solids.struct, c.pairs.struct, self.io]
        self.launch(self._kernel, *inputs, self._limits, self.points)


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
