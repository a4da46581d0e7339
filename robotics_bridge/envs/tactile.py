"""Readings of a hand's taxels during a control step, as one tensor.

Letters: B environment, S physics step of a control step, N column (active taxel, or link for ``agg_*``), C channel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brainbench.core.devices import warp
from robotics_bridge.envs.options import EnvOptions
from robotics_bridge.envs.simulation import Simulation
from robotics_bridge.hands import Hand
from robotics_bridge.hands.observations import PATCH_FORCE_SCALE, TAXELS_IN_CONTACT, observation_type, sensors_for
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors import SensorSuite
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Task


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
        columns = len(links)
        if kind.per_link:
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
