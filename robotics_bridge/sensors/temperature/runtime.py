"""The runtime of temperature grids: buffers, diffusion matrices and the order of the kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import warp
from robotics_bridge.sensors.sensor import ReadoutRuntime
from robotics_bridge.sensors.temperature.materials import ThermalBody, material

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.sensor import Context
    from robotics_bridge.sensors.temperature.grid import TemperatureGrid


class TemperatureRuntime(ReadoutRuntime):
    """Serves temperature grids."""

    def __init__(self, sensors: Mapping[str, TemperatureGrid], context: Context) -> None:
        from robotics_bridge.sensors.temperature.kernels.heat import CAPACITY, ThermalParams

        super().__init__(sensors, 1, context, fusable=False)
        wp, device, scene = warp(), context.device, context.scene
        self._sensors = list(sensors.values())
        self._edges: list[NDArray[np.float64]] = []
        structures, part, exposed, source = [], [], [], []
        for number, (sensor, place) in enumerate(zip(self._sensors, self.places.values(), strict=True)):
            structures.append(self._structure(sensor, place.start))
            part.append(np.full(place.count, number))
            exposed.append(_exposed(sensor.cells, self._edges[number]).ravel())
            watts = np.broadcast_to(np.asarray(sensor.source, float), sensor.cells) * self._edges[number].prod()
            source.append(watts.ravel())

        def floats(values: ArrayLike) -> Any:
            return wp.array(np.asarray(values, np.float32), dtype=wp.float32, device=device)

        self._structures = wp.array(structures, dtype=ThermalParams, device=device)
        self._part = wp.array(np.concatenate(part).astype(np.int32), dtype=wp.int32, device=device)
        self._exposed, self._source = floats(np.concatenate(exposed)), floats(np.concatenate(source))
        self._link_of = wp.array(scene.link_of.astype(np.int32), dtype=wp.int32, device=device)
        links = [_body(self._sensors, name) for name in scene.links]
        materials = [material(body.material) for body in links]
        self._conductivity = floats([item.conductivity for item in materials])
        self._diffusivity = floats([item.diffusivity for item in materials])
        self.link_temperature = floats(np.tile([body.temperature for body in links], (context.num_envs, 1)))
        """Warp array [B, L] (°C) of the bodies that may be touched."""
        shape = (context.num_envs, self.count)
        many = (context.num_envs, len(structures))
        self.found_contacts = wp.zeros(many, dtype=wp.int32, device=device)
        """Warp array [B, S]: contacts of each grid at the last update."""
        self._kept = wp.zeros((*many, CAPACITY), dtype=wp.int32, device=device)
        fields = [wp.zeros(shape, dtype=wp.float64, device=device) for _ in range(4)]
        self._field, self._first, self._second, self._element = fields
        self._touched, self._g, self._inflow = (wp.zeros(shape, dtype=wp.float32, device=device) for _ in range(3))
        self._axes = [axis for axis in range(3) if any(sensor.cells[axis] > 1 for sensor in self._sensors)]
        if not self.noisy and any(_lags(sensor) for sensor in self._sensors):
            self._measured = wp.zeros_like(self._truth)
        self._dt = math.nan
        self._set_step(1e-2)

    def _structure(self, sensor: TemperatureGrid, first: int) -> Any:
        low, high = sensor.corners(self.context.scene)
        edges = (high - low) / np.array(sensor.cells)
        self._edges.append(edges)
        from robotics_bridge.sensors.temperature.kernels.heat import ThermalParams

        own, wp = material(sensor.material), warp()
        item = ThermalParams()
        item.link, item.first = self.context.scene.link_index(sensor.link), first
        item.shape, item.low, item.cell = wp.vec3i(*sensor.cells), wp.vec3f(*low), wp.vec3f(*edges)
        item.conductivity = own.conductivity
        item.capacity = own.density * own.specific_heat * edges.prod()
        item.emissivity = own.emissivity if sensor.radiates else 0.0
        item.convection, item.ambient, item.base = (
            sensor.convection,
            sensor.ambient_temperature,
            sensor.base_temperature,
        )
        item.contact = sensor.contact_conductance if math.isfinite(sensor.contact_conductance) else 0.0
        item.bluntness, item.depth_weight = sensor.contact_radius, sensor.depth_weight
        item.published = int(sensor.conduction == "thesis")
        item.tau = sensor.tau
        item.cold, item.warm = (min(value, 1e9) for value in (sensor.cold_range, sensor.warm_range))
        return item

    def _set_step(self, dt: float) -> None:
        """Exponentiate the diffusion of every axis for a time step (s)."""
        if dt == self._dt:
            return
        wp, device = warp(), self.context.device
        matrices, offsets, start = [], [], 0
        for sensor, edges in zip(self._sensors, self._edges, strict=True):
            row = []
            for axis in range(3):
                block = diffusion(sensor.cells[axis], edges[axis], material(sensor.material).diffusivity * dt)
                row.append(start)
                start += block.size
                matrices.append(block.ravel())
            offsets.append(row)
        values = np.concatenate(matrices).astype(np.float32)
        if math.isnan(self._dt):
            self._matrix = wp.array(values, dtype=wp.float32, device=device)
            self._offset = wp.array(np.array(offsets, np.int32), dtype=wp.int32, device=device)
        else:
            self._matrix.assign(values)
        self._dt = dt

    def update(self, state: HandState, dt: float) -> None:
        """Read the state; a new time step re-computes the diffusion matrices first."""
        self._set_step(dt)
        from robotics_bridge.sensors.temperature.kernels import heat as k

        wp, c = warp(), self.context
        cells = (c.num_envs, self.count)

        def run(kernel: Any, dim: Any, *inputs: Any) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, device=c.device)

        self.found_contacts.zero_()
        run(
            k.collect_contacts, state.contact_env.shape[0], state.contact_count, state.contact_env, state.contact_geom,
            self._link_of, self._structures, self.found_contacts, self._kept,
        )  # fmt: skip
        run(
            k.conduct_contacts, self._kept.shape, state.contact_geom, state.contact_distance, state.contact_position,
            state.contact_normal, self._link_of, self._structures, self.found_contacts, self._kept, state.status,
            state.pose, self._conductivity, self._diffusivity, self.link_temperature, self._touched, dt, self._g,
            self._inflow,
        )  # fmt: skip
        age = c.clock.age
        run(
            k.exchange_heat, cells, self._structures, self._part, self._exposed, self._source, age, state.status, dt,
            self._g, self._inflow, self._touched, self._field, self._first,
        )  # fmt: skip
        now, spare = self._first, self._second
        for axis in self._axes:
            run(k.diffuse_heat, cells, axis, self._structures, self._part, self._offset, self._matrix, now, spare)
            now, spare = spare, now
        run(
            k.sense_temperature, cells, self._structures, self._part, age, state.status, dt, now, self._field, self._element,
            self._truth, self._measured,
        )  # fmt: skip
        self.finish(dt)

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes]."""
        from robotics_bridge.sensors.temperature.kernels.heat import CAPACITY

        lists = len(self._sensors) * (1 + CAPACITY) * 4 + 4 * self.link_temperature.shape[1]
        return super().state_bytes + (4 * 8 + 3 * 4) * self.count + lists


def diffusion(cells: int, edge: float, spread: float) -> NDArray[np.float64]:
    """Return the matrix [n, n] that spreads heat along a row of cells with insulated ends.

    The exponential of the second difference: no entry is negative, rows and columns sum to one, so that no new
    extreme arises and no heat is lost, at any time step.

    Args:
        cells: n.
        edge: Length of a cell [m].
        spread: α Δt [m²].
    """
    place = (np.arange(cells) + 0.5) * np.pi / cells
    modes = np.cos(np.outer(place, np.arange(cells)))
    modes /= np.linalg.norm(modes, axis=0)
    rate = 2 * (1 - np.cos(np.pi * np.arange(cells) / cells)) / edge**2
    return np.maximum((modes * np.exp(-spread * rate)) @ modes.T, 0.0)


def _lags(sensor: TemperatureGrid) -> bool:
    return sensor.tau > 0 or math.isfinite(sensor.warm_range) or math.isfinite(sensor.cold_range)


def _body(sensors: list[TemperatureGrid], link: str) -> ThermalBody:
    """What a link is made of: as the configuration says, as a grid on it says, or the default."""
    if link in sensors[0].bodies:
        return sensors[0].bodies[link]
    own = next((sensor for sensor in sensors if sensor.link == link), None)
    return sensors[0].other if own is None else ThermalBody(own.material, own.base_temperature)


def _exposed(cells: tuple[int, int, int], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the outer surface [nx, ny, nz] of each cell (m²)."""
    area = np.zeros(cells)
    for axis in range(3):
        face = edges.prod() / edges[axis]
        ends = np.moveaxis(area, axis, 0)
        ends[0] += face
        ends[-1] += face
    return area
