"""What a control step feels: contacts of finger tips and objects, and the readings of a hand's taxels.

Letters: B environment, F finger tip, K object, S physics step of a control step, N column (active taxel, or link for
``agg_*``), C channel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brainbench.core.devices import warp
from brainbench.core.rotations import conjugate, from_xyzw, rotate
from robotics_bridge.envs.kernels.actuation import add_contact_forces
from robotics_bridge.envs.simulation import EnvOptions, Simulation
from robotics_bridge.hands import Hand
from robotics_bridge.hands.observations import (
    PATCH_FORCE_SCALE,
    TAXELS_IN_CONTACT,
    center_of_pressure,
    observation_type,
    sensors_for,
)
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors import Probes, SensorSuite, SurfaceDistanceProbe
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Task

_REACH = 0.5
"""Largest distance that is told (m)."""
_LIMIT = 10.0
"""Bounds of the components of a force on a finger tip, as published (N)."""


class Contacts:
    """Privileged senses of a task, read once per control step."""

    def __init__(self, simulation: Simulation, model: TaskModel, *, step_dt: float, seed: int) -> None:
        wp, scene, device = warp(), simulation.engine.scene, simulation.warp_device
        self._simulation, self._kernel, self._dt = simulation, add_contact_forces, step_dt
        tips = list(model.tips)
        self._tips = len(tips)
        self.tip_links = torch.as_tensor([scene.link_index(tip) for tip in tips], device=simulation.device)
        """[F] numbers of the links of finger tips."""
        up, radius, probes = np.array([[0.0, 0.0, 1.0]]), np.array([0.5]), {}
        for tip, point in model.tips.items():
            place = Probes(np.array([point]), up, radius, (1,))
            probes[tip] = SurfaceDistanceProbe(link=tip, probes=place, track=model.objects, max_range=_REACH)
        self._suite = SensorSuite(scene, probes, num_envs=simulation.num_envs, device=device, seed=seed)
        (runtime,) = self._suite.runtimes
        self.planes: torch.Tensor = wp.to_torch(runtime.measured())
        """[1, B, F] distances (m)."""
        rows = np.full(len(scene.geometries), -1, dtype=np.int32)
        for row, link in enumerate((*tips, *model.objects)):
            rows[list(scene.geometries_of(link))] = row
        self._rows = wp.array(rows, dtype=wp.int32, device=device)
        shape = (simulation.num_envs, len(tips) + len(model.objects))
        self._forces: Any = wp.zeros(shape, dtype=wp.vec3f, device=device)
        self.forces: torch.Tensor = wp.to_torch(self._forces)
        """[B, F + K, 3] net normal contact forces on finger tips, then on objects, world axes (N); a view."""

    def read(self) -> None:
        """Take forces and distances from the simulation's state."""
        wp, state = warp(), self._simulation.state
        # One thread per contact adds its force, so the sums start from zero in every control step.
        self._forces.zero_()
        inputs = [state.contact_count, state.contact_geom, state.contact_env, state.contact_normal]
        inputs += [state.contact_force, self._rows, self._forces]
        wp.launch(self._kernel, dim=state.contact_env.shape[0], inputs=inputs, device=self._simulation.warp_device)
        self._suite.update(state, self._dt)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes in some environments [B] bool."""
        self._suite.reset(mask)

    def refresh(self, mask: torch.Tensor) -> None:
        """Take distances of new episodes, which have no contacts yet, from the refreshed state."""
        self.forces.masked_fill_(mask[:, None, None], 0.0)
        self._suite.update(self._simulation.state, self._dt)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves of what was read last, by name."""
        return {"forces": self.forces, "distances": self.planes}

    def on_object(self, rows: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the size [B] of the force on the objects ``target`` [B] (N); ``rows`` numbers the environments."""
        return self.forces[rows, self._tips + target].norm(dim=1)

    @property
    def tip_force(self) -> torch.Tensor:
        """Net normal contact force [B, F, 3] on finger tips in their own frame, within ±10 N as published."""
        # World to link: the inverse of a unit quaternion is its conjugate. A lost force reads as 0, since a network
        # cannot take NaN.
        turn = conjugate(from_xyzw(self._simulation.pose[:, self.tip_links, 3:]))
        return rotate(turn, self.forces[:, : self._tips]).clamp(-_LIMIT, _LIMIT).nan_to_num()

    @property
    def surface_distance(self) -> torch.Tensor:
        """Distance [B, F] from each finger tip to the nearest object (m), at most 0.5."""
        return self.planes[0].nan_to_num(_REACH)


class TactileObservation:
    """The tactile sensors of an environment, read after every physics step; the observation type is not ``none``."""

    def __init__(self, model: TaskModel, hand: Hand, simulation: Simulation, options: EnvOptions, task: Task) -> None:
        observe, num_envs, device = options.observe, options.num_envs, simulation.warp_device
        kind = observation_type(observe)
        taxels = hand.layout(options.resolution, options.placement)
        taxels = {link: probes for link, probes in taxels.items() if probes.active.any()}
        # The task's torsional friction of force taxels, where the options name none.
        knobs = {"twist": task.taxel_twist, **options.knobs}
        sensors = sensors_for(observe, taxels, noisy=options.noisy, track=model.objects, **knobs)
        self.suite = SensorSuite(simulation.engine.scene, sensors, num_envs=num_envs, device=device, seed=options.seed)
        self._name, self.links = observe, tuple(taxels)
        """Links with taxels, in the order of their columns."""
        active = {link: np.flatnonzero(probes.active) for link, probes in taxels.items()}
        counts = [len(active[link]) for link in taxels]
        links = np.repeat(np.arange(len(counts)), counts)
        where = simulation.device
        self._parts: list[tuple[Any, torch.Tensor, torch.Tensor]] = []
        starts = dict(zip(taxels, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
        for runtime in self.suite.runtimes:
            source = np.concatenate([place.start + active[name] for name, place in runtime.slices.items()])
            target = np.concatenate([starts[name] + np.arange(len(active[name])) for name in runtime.slices])
            planes = warp().to_torch(runtime.measured())
            self._parts.append((planes, torch.as_tensor(source, device=where), torch.as_tensor(target, device=where)))
        width: int = 3 if observe == "force" else int(self._parts[0][0].shape[0])
        self._taxels = torch.zeros(num_envs, len(links), width, device=where)
        self._pool = None
        self._patches: list[tuple[torch.Tensor, ...]] = []
        columns = len(links)
        if observe == "center_of_pressure":
            columns = len(taxels)
            for number, (link, probes) in enumerate(taxels.items()):
                arrays = (probes.position[active[link]], probes.normal[active[link]])
                patch = [torch.as_tensor(array, dtype=torch.float32, device=where) for array in arrays]
                self._patches.append((torch.as_tensor(np.flatnonzero(links == number), device=where), *patch))
        elif kind.per_link:
            columns = len(taxels)
            pool = np.zeros((len(links), columns, kind.channels))
            # Sum over the taxels of a link as one matrix product: counts of contacts, or 10⁴ Σ d n with axes z, y, x
            # (4.29).
            normal = np.concatenate([probes.normal[active[link]] for link, probes in taxels.items()])
            pool[np.arange(len(links)), links] = 1.0 if observe == "agg_bool" else PATCH_FORCE_SCALE * normal[:, ::-1]
            self._pool = torch.as_tensor(pool, dtype=torch.float32, device=where).flatten(1)
        self.reading = torch.zeros(num_envs, task.solver.decimation, columns, kind.channels, device=where)
        """[B, S, N, C] of the last control step, oldest first; zeros after a reset."""

    def update(self, state: HandState, dt: float, substep: int) -> None:
        """Read the sensors after a physics step of duration dt (s)."""
        self.suite.update(state, dt)
        for planes, source, target in self._parts:
            part = planes[: self._taxels.shape[2]].index_select(2, source).permute(1, 2, 0)
            if len(self._parts) == 1:
                self._taxels = part
            else:
                self._taxels.index_copy_(1, target, part)
        if self._patches:
            # The index tensors lie on the device, so that a graph can record the step.
            parts = [
                center_of_pressure(self._taxels.index_select(1, members), place, normal)
                for members, place, normal in self._patches
            ]
            self.reading[:, substep] = torch.stack(parts, dim=1)
            return
        if self._pool is None:
            self.reading[:, substep] = self._taxels
            return
        # One product for all links: no sum has to be taken by index, whose order differs from run to run on a GPU.
        pooled = self._taxels[..., 0] @ self._pool
        if self._name == "agg_bool":
            pooled = (pooled > TAXELS_IN_CONTACT).float()
        self.reading[:, substep] = pooled.unflatten(1, self.reading.shape[2:])

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes in some environments [B] bool."""
        self.suite.reset(mask)
        self.reading.masked_fill_(mask[:, None, None, None], 0.0)
