"""ProximityTaxel: signal of the object surface near a taxel, before and in contact (thesis 4.11–4.16)."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from robotics_bridge.sensors.noise.model import TAXEL_KNOBS
from robotics_bridge.sensors.queries.surface_points import halve, sample_cloud
from robotics_bridge.sensors.sensor import Convention, ProbeRuntime, ProbeSensor
from robotics_bridge.sensors.taxels.kinematic import check_convention

if TYPE_CHECKING:
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.sensor import Context


@dataclass(frozen=True, kw_only=True)
class ProximityTaxel(ProbeSensor):
    """Force (N) and torque (N·m) [N, 6] from surface points within the sensing radius, in the link frame.

    Every tracked point p within R of the taxel adds its overlap P = R − |p − q|, scaled by density / point count:
    a force k P along the normal a, and k_s P times the point's velocity across a.

    ``thesis`` pulls along +a and takes the torque about the taxel (published); ``physical`` pushes the sensor along
    −a and takes it about the link's origin, so that taxels add up to a wrench. Defaults: published parameters.

    Raises:
        UsageError: the convention is unknown, or it follows no surface point.
    """

    stiffness: float = 300.0
    """k, N/m."""
    coupling: float = 10.0
    """k_s, N·s/m²."""
    density: float = 100.0
    """Scale of the point density (4.14)."""
    points: int = 5000
    """Surface points spread over all tracked geometries (the published configuration file has 1000)."""
    convention: Convention = "physical"

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = TAXEL_KNOBS

    def __post_init__(self) -> None:
        super().__post_init__()
        check_convention(self.convention)
        if self.points < 1:
            raise UsageError(f"A proximity taxel needs at least one surface point; received {self.points}.")

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return (self.convention, self.points, self.track, self.link if not self.track else "")

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> ProximityRuntime:
        """Return the runtime that serves these sensors together."""
        return ProximityRuntime(sensors, context)


class ProximityRuntime(ProbeRuntime):
    """Serves proximity taxels that track the same geometries.

    Args:
        sensors: Of one group, by name; those of a group share what decides which kernels run.
        context: Of the suite: scene, environments, device, clock and geometries.
    """

    def __init__(self, sensors: Mapping[str, ProximityTaxel], context: Context) -> None:
        from robotics_bridge.sensors.taxels.kernels.proximity import ProximityParams

        noise = max(sensor.noise.radius for sensor in sensors.values())
        super().__init__(sensors, 6, context, reach=noise)
        wp, device = warp(), context.device
        first = next(iter(sensors.values()))
        self._physical = first.convention == "physical"
        tracked, rows = first.tracked(context.scene), context.solids.rows
        self.cloud = sample_cloud(context.scene, tracked, first.points, rows, device)
        laws, densities = [], np.zeros((len(sensors), rows), np.float32)
        for row, sensor in zip(densities, sensors.values(), strict=True):
            law = ProximityParams()
            law.stiffness, law.coupling = sensor.stiffness, sensor.coupling
            laws.append(law)
            row[:] = sensor.density / np.maximum(self.cloud.counts, 1)
        self._laws = wp.array(laws, dtype=ProximityParams, device=device)
        self._densities = wp.array(densities, dtype=wp.float32, device=device)
        links = [context.scene.link_index(sensor.link) for sensor in sensors.values()]
        self._links = wp.array(np.array(links, np.int32), dtype=wp.int32, device=device)
        # A processor walks through all probes of an environment anyway, so it may list their points in between.
        self._gathered = not device.is_cuda
        room = self.cloud.total + len(tracked) + 1
        shape = (context.num_envs, room) if self._gathered else (1, 1)
        self._near = wp.zeros(shape, dtype=wp.int32, device=device)
        self._cells = self._cluster(list(sensors.values())) if self._gathered else ()

    def update(self, state: HandState, dt: float) -> None:
        """Read the state."""
        from robotics_bridge.sensors.taxels.kernels.proximity import proximity_kernel

        self.begin(state, dt)
        kernel = proximity_kernel(self._physical, self.mode, *self.stores, self._gathered)
        inputs = [self.probes, self.context.pairs.struct, self.cloud.struct, self.io, self.knobs]
        inputs += [self._laws, self._densities, self._links, state.pose, state.velocity, self._near]
        if self._gathered:
            inputs += self._cells
            warp().launch(kernel, dim=self.context.num_envs, inputs=inputs, device=self.context.device)
        else:
            self.launch(kernel, *inputs)
        self.finish(dt)

    @property
    def scratch_bytes(self) -> int:
        """Memory per environment [bytes] that every update writes anew: points near a cell of probes."""
        return 4 * self._near.shape[1] if self._gathered else 0

    def _cluster(self, sensors: list[ProximityTaxel]) -> tuple[Any, Any, Any]:
        """Return the probes [N] cell by cell, cells (first, end, slot) [C, 3], and spheres [C, 4] that hold all they
        sense."""
        from robotics_bridge.sensors.taxels.kernels.proximity import CELL

        wp, device, slots = warp(), self.context.device, self.probes.slot.numpy()
        members, cells, around = [], [], []
        for sensor, place in zip(sensors, self.places.values(), strict=True):
            position, radius = sensor.probes.position, sensor.probes.radius + sensor.noise.radius
            first = place.start
            for chosen in halve(position, np.arange(place.count), CELL):
                middle = 0.5 * (position[chosen].min(axis=0) + position[chosen].max(axis=0))
                far = (np.linalg.norm(position[chosen] - middle, axis=1) + radius[chosen]).max()
                # Rounding must not lose a point at the rim.
                around.append((*middle, far * (1 + 1e-5) + 1e-7))
                cells.append((first, first + len(chosen), slots[place.start]))
                members.append(place.start + chosen)
                first += len(chosen)
        return (
            wp.array(np.concatenate(members).astype(np.int32), dtype=wp.int32, device=device),
            wp.array(np.array(cells, np.int32), dtype=wp.vec3i, device=device),
            wp.array(np.array(around, np.float32), dtype=wp.vec4f, device=device),
        )
