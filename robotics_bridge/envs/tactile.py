"""Readings of a hand's taxels during a control step, as one tensor, and the place of each of its columns.

Letters: B environment, S physics step of a control step, N column (active taxel, or link for ``agg_*``), C channel,
L link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module, warp
from brainbench.core.rotations import to_matrices
from robotics_bridge.envs.options import EnvOptions
from robotics_bridge.envs.simulation import Simulation
from robotics_bridge.hands import Hand
from robotics_bridge.hands.observations import (
    PATCH_FORCE_SCALE,
    TAXELS_IN_CONTACT,
    observation_type,
    sensors_for,
)
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors import SensorSuite
from robotics_bridge.tasks.scenes import TaskModel

mujoco = mujoco_module()


@dataclass(frozen=True, eq=False)
class TactileLayout:
    """Layout of the columns of a tactile observation. Readings are in the link frame, torques about its origin."""

    observe: str
    """Observation type (table 4.3)."""
    placement: str
    resolution: str
    noisy: bool
    units: str
    channels: int
    """C."""
    links: tuple[str, ...]
    """L links with taxels."""
    link: NDArray[np.int64]
    """[N] number of the link of each column."""
    position: NDArray[np.float64]
    """[N, 3] in the link frame (m); the mean of a link's taxels for ``agg_*``."""
    normal: NDArray[np.float64]
    """[N, 3] outward, link frame."""
    radius: NDArray[np.float64]
    """[N] sensing radius (m)."""
    rest: NDArray[np.float64]
    """[L, 7] poses of the links in the palm's frame at the task's rest position (x y z, qw qx qy qz)."""
    base_position: NDArray[np.float64]
    """[N, 3] in the palm's frame at rest (m)."""
    base_normal: NDArray[np.float64]
    """[N, 3]."""


class TactileObservation:
    """The tactile sensors of an environment, read after every physics step.

    Args:
        model: physics of the task.
        hand: the hand.
        simulation: what moves the hand.
        options: of the environments, with an observation type other than ``none``.
        substeps: S.

    Raises:
        UsageError: a name is unknown.
    """

    def __init__(
        self, model: TaskModel, hand: Hand, simulation: Simulation, options: EnvOptions, *, substeps: int
    ) -> None:
        observe, num_envs, device = options.observe, options.num_envs, simulation.warp_device
        kind = observation_type(observe)
        taxels = hand.layout(options.resolution, options.placement)
        taxels = {link: probes for link, probes in taxels.items() if probes.active.any()}
        sensors = sensors_for(observe, taxels, noisy=options.noisy, track=model.objects, **options.knobs)
        self.suite = SensorSuite(simulation.engine.scene, sensors, num_envs=num_envs, device=device, seed=options.seed)
        self._name, self._substeps = observe, substeps
        active = {link: np.flatnonzero(probes.active) for link, probes in taxels.items()}
        counts = [len(active[link]) for link in taxels]
        links = np.repeat(np.arange(len(counts)), counts)
        position, normal = (
            np.concatenate([getattr(probes, name)[active[link]] for link, probes in taxels.items()])
            for name in ("position", "normal")
        )
        radius = np.concatenate([next(iter([sensors[link]])).probes.radius[active[link]] for link in taxels])  # type: ignore[attr-defined]
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
            pool[np.arange(len(links)), links] = 1.0 if observe == "agg_bool" else PATCH_FORCE_SCALE * normal[:, ::-1]
            self._pool = torch.as_tensor(pool, dtype=torch.float32, device=where).flatten(1)
            mean = np.zeros((columns, len(links)))
            mean[links, np.arange(len(links))] = 1.0 / np.array(counts)[links]
            position, radius = mean @ position, mean @ radius
            normal = mean @ normal
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            links = np.arange(columns)
        self.reading = torch.zeros(num_envs, substeps, columns, kind.channels, device=where)
        """[B, S, N, C] of the last control step, oldest first; zeros after a reset."""
        rest = rest_poses(model, hand.palm, tuple(taxels))
        axes = to_matrices(rest[links, 3:])

        def turn(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.einsum("nij,nj->ni", axes, vectors)

        self.layout = TactileLayout(
            observe=observe, placement=options.placement, resolution=options.resolution, noisy=options.noisy,
            units=type(next(iter(sensors.values()))).units, channels=kind.channels, links=tuple(taxels), link=links,
            position=position, normal=normal, radius=radius, rest=rest,
            base_position=rest[links, :3] + turn(position),
            base_normal=turn(normal),
        )  # fmt: skip

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


def rest_poses(model: TaskModel, base: str, links: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the poses [L, 7] (x y z, qw qx qy qz) of links in the frame of a base link, joints at rest."""
    first = model.models[0]
    data = mujoco.MjData(first)
    for name, angle in zip(model.joints, model.rest, strict=True):
        data.qpos[first.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(first, data)
    home = first.body(base).id
    matrix = data.xmat[home].reshape(3, 3)
    found = np.zeros((len(links), 7))
    inverse = np.zeros(4)
    mujoco.mju_negQuat(inverse, data.xquat[home])
    for row, name in zip(found, links, strict=True):
        body = first.body(name).id
        row[:3] = matrix.T @ (data.xpos[body] - data.xpos[home])
        mujoco.mju_mulQuat(row[3:], inverse, data.xquat[body])
    return found
