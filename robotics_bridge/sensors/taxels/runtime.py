"""Runtimes of kinematic taxels, by their law or by the contact forces of the engine, and of proximity taxels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import KDTree

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import fill
from robotics_bridge.sensors.kernels import contact_load as kernels
from robotics_bridge.sensors.kernels.contact_load import ContactNodes, PressArrays, SpreadPlan, settle_kernel
from robotics_bridge.sensors.kernels.kinematic import KinematicParams, StickArrays, kinematic_kernel
from robotics_bridge.sensors.kernels.proximity import ProximityArrays, ProximityParams, proximity_kernel
from robotics_bridge.sensors.kernels.readout import FUSED
from robotics_bridge.sensors.probes.placement import Probes
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
        super().__init__(sensors, 6, context, fusable=not self.summed, others=self.summed)
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
        self._kernel, arrays = proximity_kernel(*options), ProximityArrays()
        arrays.laws, arrays.densities = context.array(laws, ProximityParams), context.array(densities, float)
        arrays.links = context.array([context.scene.link_index(sensor.link) for sensor in sensors.values()], int)
        self._own = arrays
        reach = max(float(s.probes.radius.max(initial=0.0)) + s.noise.radius for s in sensors.values())
        self._cells = list_by_cells(self.cloud, reach, context.device)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c = self.context
        inputs = [self.probes, c.pairs.struct, self.cloud.struct, self._cells, self.io, self._own, state.arrays]
        self.launch(self._kernel, *inputs)


class ContactLoadRuntime(KinematicRuntime):
    """Serves kinematic taxels with ``total="engine"``: contact forces, spread by the depths of the law."""

    summed = True

    def __init__(self, sensors: Mapping[str, KinematicTaxel], context: SuiteContext) -> None:
        super().__init__(sensors, context)
        configs = list(sensors.values())
        links = [context.scene.link_index(sensor.link) for sensor in configs]
        order = [links[:number].count(link) for number, link in enumerate(links)]
        self._most = max(order) + 1
        places = np.full((len(context.scene.links), self._most), -1)
        places[links, order] = np.arange(len(links))
        spans = [(p.start, p.start + p.count, slot) for p, slot in zip(self.slices.values(), self.slots, strict=True)]
        plan = self.plan
        plan.sensors, plan.link = context.array(places, int), context.array(links, int)
        plan.order, plan.spans = context.array(order, int), context.array(spans, wp.vec3i)
        plan.reach = context.array(np.concatenate([contact_reach(sensor.probes) for sensor in configs]), float)
        plan.row_first = context.array(np.searchsorted(self.rows.numpy()[:, 3], np.arange(len(spans) + 1)), int)
        plan.whole = context.array([int(not sensor.track) for sensor in configs], int)
        plan.links = context.array(sorted(set(links)), int)
        plan.fresh = int(context.pairs.loads is None)
        plan.loads, plan.told = context.pairs.count_loads(), context.pairs.told
        self._settle = settle_kernel(self.kinds, configs[0].query == "raycast", in_turn=not context.device.is_cuda)
        plan.slip = 1.0 if configs[0].convention == "physical" else -1.0
        shape, press = (context.num_envs, self.count), self.press
        press.weight, press.total = context.zeros(shape), context.zeros(shape)
        press.part = context.zeros((context.num_envs, self.rows.shape[0]), wp.spatial_vectorf)
        press.noisy = context.zeros(shape if self.noisy else (1, 1))
        press.normal, press.body = context.zeros(shape, wp.vec3f), context.zeros(shape, int)
        press.sigma = context.zeros(shape if configs[0].sticky else (0, 0), wp.vec3f)
        self.scratch = [press.weight, press.total, press.normal, press.body, press.sigma, press.part]
        self.scratch += [press.noisy] if self.noisy else []
        # Stages after this one write into the measured readings, which are then never left alone.
        self._written = context.array(np.full((context.num_envs, self.rows.shape[0]), self.noisy), wp.uint8)
        self.nodes = self._make_nodes(0)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c, room = self.context, state.contact_env.shape[0]
        if self.nodes.felt.shape[0] != 2 * room:
            self.nodes = self._make_nodes(room)
        plan, nodes, press, cuda = self.plan, self.nodes, self.press, c.device.is_cuda
        # A processor takes all contacts in one thread, so that the launch stays the same whatever their number.
        threads = room if cuda else 1
        c.launch(kernels.list_contacts, threads, plan, c.pairs.plan, c.solids.struct.link, state.arrays,
                 state.contact_friction, threads, nodes)  # fmt: skip
        links = plan.links.shape[0]
        inputs = [int(self.noisy), self._written, self.io]
        if cuda:
            c.launch(kernels.find_taxels, (c.num_envs, links), plan, self.probes, nodes)
        super().run_kernels(state, dt)
        if cuda:
            seen = [plan, c.solids.struct.link, state.arrays, self.probes, press, nodes]
            c.launch(kernels.share_contacts, (2 * room, self._most), *seen)
            spread = [plan, self.probes, self.rows, press, nodes, *inputs]
            c.launch(kernels.spread_contacts, (c.num_envs, self.rows.shape[0]), *spread)
        c.launch(self._settle, (c.num_envs, links), plan, self.probes, self.rows, c.solids.struct,
                 c.pairs.struct, nodes, press, *inputs)  # fmt: skip

    def _make_nodes(self, room: int) -> Any:
        c, nodes = self.context, kernels.ContactNodes()
        nodes.head = c.array(np.full((c.num_envs, len(c.scene.links)), -1), int)
        for name in ("follower", "watched", "felt", "other", "geometry"):
            setattr(nodes, name, c.zeros(2 * room, int))
        nodes.carried, nodes.overlap = c.zeros((2 * room, self._most), int), c.zeros(2 * room)
        for name in ("point", "normal", "force"):
            setattr(nodes, name, c.zeros(2 * room, wp.vec3f))
        nodes.load, nodes.share = c.zeros(2 * room), c.zeros((2 * room, self._most), wp.vec4f)
        return nodes


def contact_reach(probes: Probes) -> np.ndarray:
    """Return how near [N] a contact must be to be felt (m): the sensing radius, or the corner of a taxel's own cell.

    Fillers get −1. The corner of a square cell is 1/√2 of the pitch away; of a grid's three nearest neighbours the
    third lies along its wider pitch.
    """
    reach, active = np.full(len(probes.radius), -1.0), np.asarray(probes.active, dtype=bool)
    places = np.asarray(probes.position)[active]
    cell = np.zeros(len(places))
    if len(places) > 1:
        cell = KDTree(places).query(places, k=min(4, len(places)))[0][:, -1] / np.sqrt(2)
    reach[active] = np.maximum(probes.radius[active], cell)
    return reach
