"""Runtimes of kinematic and proximity taxels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import fill
from robotics_bridge.sensors.kernels.contact_load import ContactNodes, PressArrays, SpreadPlan
from robotics_bridge.sensors.kernels.kinematic import KinematicParams, StickArrays, kinematic_kernel
from robotics_bridge.sensors.kernels.proximity import ProximityArrays, ProximityParams, proximity_kernel
from robotics_bridge.sensors.kernels.readout import FUSED
from robotics_bridge.sensors.queries.surface_points import list_by_cells, sample_cloud
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext, probe_rows
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel, ProximityTaxel

wp = warp()


class KinematicRuntime(ProbeRuntime):
    """Serves kinematic taxels of one group, each by its own law."""

    summed: ClassVar[bool] = False
    """True if the kernel leaves readings to others and writes what sums with contact forces need."""

    def __init__(self, sensors: Mapping[str, KinematicTaxel], context: SuiteContext) -> None:
        first = next(iter(sensors.values()))
        # Readings of a taxel whose forces are summed depend on others, so that none can be finished, noise included.
        super().__init__(sensors, 6, context, fusable=not self.summed)
        rows = probe_rows(self.slices.values(), context, self.mode)
        self._kernel = kinematic_kernel(
            self.kinds, first.query == "raycast", first.convention == "physical", first.sticky, self.summed, self.mode,
            *self.stores, context.device.is_cuda, self.mode == FUSED and len(rows) == self.count,
        )  # fmt: skip
        laws = [
            fill(KinematicParams, sensor, friction=sensor.friction or 0.0, twist=sensor.torsion)
            for sensor in sensors.values()
        ]
        self._laws = context.array(laws, KinematicParams)
        self.rows: Any = context.array(rows, wp.vec4i)
        """Warp array [R]: rows of taxels that one thread takes in turn."""
        self.plan, self.nodes, self.press = SpreadPlan(), ContactNodes(), PressArrays()
        """Warp structures of the sums, empty here."""
        sticks, shape = StickArrays(), (context.num_envs, self.count) if first.sticky else (1, 1)
        sticks.anchor, sticks.body = context.zeros(shape, wp.vec3f), context.zeros(shape, int)
        sticks.stamp = context.array(np.full(shape, -1), int)
        self._sticks = sticks
        self.lasting = [sticks.anchor, sticks.body, sticks.stamp] if first.sticky else []

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernel."""
        c = self.context
        inputs = [self.probes, self.rows, c.solids.struct, c.pairs.struct, self.io, self._laws, self._sticks]
        c.launch(self._kernel, c.num_envs * self.rows.shape[0], *inputs, self.plan, self.nodes, self.press)


class ProximityRuntime(ProbeRuntime):
    """Serves proximity taxels that track the same geometries."""

    def __init__(self, sensors: Mapping[str, ProximityTaxel], context: SuiteContext) -> None:
        super().__init__(sensors, 6, context, reach=max(sensor.noise.radius for sensor in sensors.values()))
        first = next(iter(sensors.values()))
        tracked, rows = first.tracked(context.scene), context.solids.rows
        self.cloud = sample_cloud(context.solids, tracked, first.points)
        laws = [fill(ProximityParams, sensor) for sensor in sensors.values()]
        densities = np.zeros((len(sensors), rows))
        for row, sensor in zip(densities, sensors.values(), strict=True):
            # ρ_b of 4.14, by variant: a body with more points does not push harder.
            row[:] = sensor.density / np.maximum(self.cloud.counts, 1)
        options = first.convention == "physical", self.mode, *self.stores
        self._kernel, own = proximity_kernel(*options), ProximityArrays()
        own.laws, own.densities = context.array(laws, ProximityParams), context.array(densities, float)
        own.links = context.array([context.scene.link_index(sensor.link) for sensor in sensors.values()], int)
        self._own = own
        reach = max(float(s.probes.radius.max(initial=0.0)) + s.noise.radius for s in sensors.values())
        self._cells = list_by_cells(self.cloud, reach, context.device)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        inputs = [self.probes, c.pairs.struct, self.cloud.struct, self._cells, self.io, self._own, state.arrays]
        self.launch(self._kernel, *inputs)
