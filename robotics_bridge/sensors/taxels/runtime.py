"""Runtimes of kinematic taxels, by their law or by the contact forces of the engine, and of proximity taxels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from scipy.spatial import KDTree

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import fill
from robotics_bridge.sensors.kernels.contact_load import (
    ContactFaces,
    Face,
    SpreadPlan,
    join_faces,
    list_contacts,
    spread_kernel,
)
from robotics_bridge.sensors.kernels.kinematic import KinematicParams, StickArrays, kinematic_kernel, measure_kernel
from robotics_bridge.sensors.kernels.proximity import ProximityArrays, ProximityParams, proximity_kernel
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, PressArrays
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.queries.solids import list_by_cells, sample_cloud
from robotics_bridge.sensors.runtime import ProbeRuntime, SuiteContext, probe_rows
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel, ProximityTaxel

wp = warp()


class KinematicRuntime(ProbeRuntime):
    """Serves kinematic taxels of one group, each by its own law."""

    summed: ClassVar[bool] = False
    """True if the kernel leaves readings to others and writes what sums with contact forces need."""

    def __init__(self, sensors: Mapping[str, KinematicTaxel], context: SuiteContext) -> None:
        first = next(iter(sensors.values()))
        super().__init__(sensors, 6, context, others=self.summed)
        rows = probe_rows(self.slices.values(), context, self.mode)
        self._kernel = kinematic_kernel(
            self.kinds, first.query == "raycast", first.convention == "physical", first.sticky, self.summed, self.mode,
            *self.stores, context.device.is_cuda, self.mode == FUSED and len(rows) == self.count,
        )  # fmt: skip
        laws = [fill(KinematicParams, sensor, friction=sensor.friction or 0.0) for sensor in sensors.values()]
        self._laws = context.array(laws, KinematicParams)
        self.rows: Any = context.array(rows, wp.vec4i)
        """Warp array [R]: rows of taxels that one thread takes in turn."""
        self.plan, self.faces, self.press = SpreadPlan(), ContactFaces(), PressArrays()
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
        c.launch(self._kernel, c.num_envs * self.rows.shape[0], *inputs, self.plan, self.faces, self.press)


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
        places = np.full((len(context.scene.links), max(order) + 1), -1)
        places[links, order] = np.arange(len(links))
        spans = [(p.start, p.start + p.count, slot) for p, slot in zip(self.slices.values(), self.slots, strict=True)]
        plan, cuda, envs = self.plan, context.device.is_cuda, context.num_envs
        plan.sensors, plan.link = context.array(places, int), context.array(links, int)
        plan.spans = context.array(spans, wp.vec3i)
        plan.reach = context.array(np.concatenate([contact_reach(sensor.probes) for sensor in configs]), float)
        plan.whole = context.array([int(not sensor.track) for sensor in configs], int)
        plan.links = context.array(sorted(set(links)), int)
        widths = np.zeros(len(places), np.float32)
        np.maximum.at(widths, links, [float(sensor.probes.radius.max(initial=0.0)) for sensor in configs])
        plan.loads, fresh = context.pairs.count_loads(sorted(set(links)), widths)
        plan.fresh, plan.told = context.array(fresh, int), context.pairs.told
        plan.widths = context.array(widths, float)
        plan.slip = 1.0 if configs[0].convention == "physical" else -1.0
        sticky = configs[0].sticky
        # A few threads for the taxels of a link; as many groups of them as the GPU holds take the links in turn.
        most, items = max(part.count for part in self.slices.values()), envs * plan.links.shape[0]
        self._lanes = 1 if not cuda else 8 if most <= 64 else 16 if most <= 256 else 32
        options = self.kinds, configs[0].query == "raycast", self.mode, sticky, self._lanes
        groups = 2048 // self._lanes * context.device.sm_count if cuda else 8
        self._spread = [(spread_kernel(*options, True), min(items, groups // 8))]
        if cuda:
            self._spread.insert(0, (spread_kernel(*options, False), min(items, groups)))
        shape, press = (envs, self.count), self.press
        press.touch, press.body = context.zeros(shape, wp.vec4f), context.zeros(shape, int)
        press.listed, press.end = context.zeros(shape, int), context.zeros((envs, len(configs)), int)
        press.noisy = context.zeros(shape if self.mode != CLEAN else (1, 1))
        press.sigma = context.zeros(shape if sticky else (1, 1), wp.vec3f)
        faces = self.faces
        faces.head, faces.listed = (context.array(np.full((envs, len(places)), -1), int) for _ in range(2))
        faces.items, faces.count = context.zeros((2, items), wp.vec2i), context.zeros(2, int)
        press.filled = context.zeros(shape, wp.uint8)
        self.lasting.append(press.filled)
        # Launches that were packed or recorded for other states go on with what they had.
        self._rooms = list[Any]()
        self._room(0)

    def _room(self, contacts: int) -> None:
        for name, dtype in (("follower", int), ("watched", int), ("chain", int), ("face", Face)):
            self._rooms.append(self.context.zeros(2 * contacts, dtype))
            setattr(self.faces, name, self._rooms[-1])

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c, room, cuda = self.context, state.contact_env.shape[0], self.context.device.is_cuda
        if self.faces.face.shape[0] < 2 * room:
            self._room(room)
        plan, faces, link_of = self.plan, self.faces, c.solids.struct.link
        scene = [link_of, state.arrays]
        # A processor takes all contacts in one thread, so that the launch stays the same whatever their number.
        threads = max(room, 1) if cuda else 1
        c.launch(list_contacts, threads, plan, c.pairs.plan, link_of, state.arrays, threads, faces)
        c.launch(join_faces, (c.num_envs, plan.links.shape[0]), plan, *scene, faces, self.io, block=32)
        super().run_kernels(state, dt)
        for kernel, groups in self._spread:
            inputs = [plan, self.probes, *scene, c.solids.struct, c.pairs.struct, faces, self.press, groups, self.io]
            c.launch(kernel, groups * self._lanes, *inputs, block=32)
        if self.mode == FUSED:
            c.launch(measure_kernel(*self.stores), c.num_envs * self.count, self.probes, self.press, self.io)


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
