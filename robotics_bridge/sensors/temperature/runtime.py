"""The runtime of temperature grids: buffers, diffusion matrices and the order of the kernels."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import fill
from robotics_bridge.sensors.kernels.heat import (
    CAPACITY,
    HeatArrays,
    ThermalParams,
    collect_contacts,
    conduct_contacts,
    diffuse_heat,
    exchange_heat,
    sense_temperature,
)
from robotics_bridge.sensors.kernels.readout import CLEAN
from robotics_bridge.sensors.runtime import Runtime, SuiteContext
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import ThermalBody, material

wp = warp()

SPREAD = 0.1
"""Largest α Δt / edge² of a cell that is stepped at once: what a face takes up must not stay in the outermost cell."""
PARTS = 64  # most parts into which an update is split


class TemperatureRuntime(Runtime):
    """Serves temperature grids."""

    def __init__(self, sensors: Mapping[str, TemperatureGrid], context: SuiteContext) -> None:
        super().__init__(sensors, 1, context, fusable=False)
        scene = context.scene
        self._sensors = list(sensors.values())
        self._edges: list[NDArray[np.float64]] = []
        structures, exposed, source = [], [], []
        for sensor, place in zip(self._sensors, self.slices.values(), strict=True):
            structures.append(self._structure(sensor, place.start))
            edges = self._edges[-1]
            exposed.append(_exposed(sensor.cells, edges).ravel())
            source.append((np.broadcast_to(np.asarray(sensor.source, float), sensor.cells) * edges.prod()).ravel())
        for name in self._sensors[0].bodies:
            scene.link_index(name)
        # Grids that know other bodies have another runtime, and are touched all the same.
        grids = [sensor for sensor in context.sensors if isinstance(sensor, TemperatureGrid)]
        bodies = {grid.link: ThermalBody(grid.material, grid.base_temperature) for grid in reversed(grids)}
        bodies |= self._sensors[0].bodies
        # Flexes, which are no links, come last.
        links = [*(bodies.get(name, self._sensors[0].unlisted) for name in scene.links), self._sensors[0].unlisted]
        materials = [material(body.material) for body in links]
        temperatures = np.tile([body.temperature for body in links], (context.num_envs, 1))
        shape, many = (context.num_envs, self.count), (context.num_envs, len(structures))
        heat = HeatArrays()
        heat.sensors = context.array(structures, ThermalParams)
        heat.exposed = context.array(np.concatenate(exposed), float)
        heat.source = context.array(np.concatenate(source), float)
        heat.link_of = context.solids.struct.link
        heat.link_conductivity = context.array([item.conductivity for item in materials], float)
        heat.link_diffusivity = context.array([item.diffusivity for item in materials], float)
        heat.link_temperature = context.array(temperatures, float)
        heat.number, heat.listed = context.zeros(many, int), context.zeros((*many, CAPACITY), int)
        heat.touched, heat.covered, heat.conductance, heat.inflow = (context.zeros(shape) for _ in range(4))
        heat.temperature, heat.element = (context.zeros(shape, wp.float64) for _ in range(2))
        sizes = np.square([sensor.cells for sensor in self._sensors])
        heat.matrix = context.zeros(int(sizes.sum()))
        heat.offset = context.array((np.cumsum(sizes) - sizes.ravel()).reshape(-1, 3), int)
        self.heat = heat
        """Warp structure of contacts, bodies and fields."""
        self._buffers = [context.zeros(shape, wp.float64) for _ in range(2)]
        self.lasting = [*self._buffers, heat.temperature, heat.element, heat.touched, heat.covered]
        self.lasting += [heat.conductance, heat.inflow, heat.number, heat.listed, heat.link_temperature]
        self._axes = [axis for axis in range(3) if any(sensor.cells[axis] > 1 for sensor in self._sensors)]
        # What the element shows differs from the cell where it lags, or where its range ends.
        limits = [value for sensor in self._sensors for value in (sensor.warm_range, sensor.cold_range)]
        if self.mode == CLEAN and (min(limits) < math.inf or any(sensor.tau > 0 for sensor in self._sensors)):
            self.io.measured = wp.zeros_like(self.io.truth)
        self._warned = False
        self._dt = math.nan
        self._set_step(1e-2)

    def _structure(self, sensor: TemperatureGrid, first: int) -> Any:
        low, high = sensor.corners(self.context.scene)
        edges = (high - low) / np.array(sensor.cells)
        self._edges.append(edges)
        solid = material(sensor.material)
        # C = ρ c_p V of a whole cell; the source is given per volume for the same reason, not per area as in 4.36.
        capacity = solid.density * solid.specific_heat * edges.prod()
        return fill(
            ThermalParams, sensor, solid, link=self.context.scene.link_index(sensor.link), first=first, corner=low,
            cell=edges, capacity=capacity, published=sensor.conduction == "thesis",
            emissivity=solid.emissivity if sensor.radiates else 0.0,
        )  # fmt: skip

    def _set_step(self, dt: float) -> None:
        """Exponentiate the diffusion of every axis for a time step (s)."""
        # Exponentials are taken on the host and only when the step changes.
        if dt == self._dt:
            return
        spreads = [
            material(sensor.material).diffusivity * dt / edges[axis] ** 2
            for sensor, edges in zip(self._sensors, self._edges, strict=True)
            for axis in range(3)
            if sensor.cells[axis] > 1
        ]
        # Rounding must not split a step that is just as long as it may be.
        parts = min(max(1, math.ceil(max(spreads, default=0.0) / SPREAD - 1e-6)), PARTS)
        matrices = [
            diffusion(cells, edge, material(sensor.material).diffusivity * dt / parts).ravel()
            for sensor, edges in zip(self._sensors, self._edges, strict=True)
            for cells, edge in zip(sensor.cells, edges, strict=True)
        ]
        self.heat.matrix.assign(np.concatenate(matrices).astype(np.float32))
        self._dt, self._parts = dt, parts

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels; a new time step re-computes the diffusion matrices first."""
        self._set_step(dt)
        c, heat, cells = self.context, self.heat, (self.context.num_envs, self.count)
        heat.number.zero_()
        c.launch(collect_contacts, state.contact_env.shape[0], state.arrays, heat)
        # On a GPU, where looking would wait for the device, ``lost_contacts`` tells.
        if not (self._warned or c.device.is_cuda) and (most := int(heat.number.numpy().max(initial=0))) > CAPACITY:
            self._warned = True
            warnings.warn(
                f"{most} contacts touched one temperature grid at once; heat flows through {CAPACITY} alone. Give its "
                "link fewer or simpler geometries.",
                RuntimeWarning,
                stacklevel=5,
            )
        self.io.dt = dt / self._parts
        for part in range(self._parts):
            heat.begins = int(part == 0)
            for measure in (1, 0):
                c.launch(conduct_contacts, heat.listed.shape, measure, state.arrays, heat, self.io)
            # Sources, contacts and surfaces first, then diffusion axis by axis: the exponentials of the axes commute,
            # so their order does not matter. Cells read their neighbours, hence two buffers in turn.
            now, spare = self._buffers
            c.launch(exchange_heat, cells, heat, self.io, now)
            for axis in self._axes:
                c.launch(diffuse_heat, cells, axis, heat, self.io, now, spare)
                now, spare = spare, now
            c.launch(sense_temperature, cells, heat, self.io, now)


def link_temperature(suite: SensorSuite, name: str) -> torch.Tensor:
    """Return the temperatures [B, L] (°C) of the links that a grid may touch, a view to write to."""
    return wp.to_torch(_runtime_of(suite, name).heat.link_temperature)[:, : len(suite.scene.links)]


def lost_contacts(suite: SensorSuite, name: str) -> torch.Tensor:
    """Return how many contacts [B] of the last update a grid had no room for (it looks at 48)."""
    runtime = _runtime_of(suite, name)
    column = list(runtime.slices).index(name)
    return (wp.to_torch(runtime.heat.number)[:, column] - CAPACITY).clamp(min=0)


def _runtime_of(suite: SensorSuite, name: str) -> TemperatureRuntime:
    return cast(TemperatureRuntime, suite.runtime_of(name, TemperatureGrid, "temperature grid"))


def diffusion(cells: int, edge: float, spread: float) -> NDArray[np.float64]:
    """Return the matrix [n, n] that spreads heat along a row of cells with insulated ends.

    The exponential of the second difference: no entry is negative, rows and columns sum to one, so that no new
    extreme arises and no heat is lost, at any time step. ``edge`` is the length of a cell [m], ``spread`` α Δt [m²].
    """
    # The second difference with insulated ends is diagonal in cosines (DCT-II) with eigenvalues 2 (1 − cos(π m / n)) /
    # edge²; mode 0 has the rate zero, which keeps the mean.
    place = (np.arange(cells) + 0.5) * np.pi / cells
    modes = np.cos(np.outer(place, np.arange(cells)))
    modes /= np.linalg.norm(modes, axis=0)
    rate = 2 * (1 - np.cos(np.pi * np.arange(cells) / cells)) / edge**2
    return np.maximum((modes * np.exp(-spread * rate)) @ modes.T, 0.0)


def _exposed(cells: tuple[int, int, int], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the outer surface [nx, ny, nz] of each cell (m²)."""
    area = np.zeros(cells)
    for axis in range(3):
        # A cell at an end of an axis shows one face there, two where the axis has one cell only.
        face = edges.prod() / edges[axis]
        ends = np.moveaxis(area, axis, 0)
        ends[0] += face
        ends[-1] += face
    return area
