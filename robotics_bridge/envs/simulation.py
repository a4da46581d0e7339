"""The physics of a batch of environments as torch tensors, on either engine. Letters: B environment, J joint.

With MuJoCo Warp the tensors are views of the engine's own memory; with C MuJoCo they are copies that this class keeps
in step, so that what stands above knows no engine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from brainbench.core.devices import mujoco_module, pick_device, warp
from brainbench.core.errors import UsageError
from robotics_bridge.envs.options import EnvOptions
from robotics_bridge.physics import MujocoEngine, MujocoWarpEngine

mujoco = mujoco_module()

FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "geom_friction")
"""Numbers of the model that differ between environments and change at resets."""


class Simulation:
    """Batched physics by the engine ``mujoco`` or ``warp``, with a ``mujoco.MjModel`` per shape of the object."""

    def __init__(self, models: Sequence[Any], options: EnvOptions, *, substeps: int = 1) -> None:
        device, num_envs = options.device, options.num_envs
        if options.engine == "mujoco" and device != "cpu":
            raise UsageError("C MuJoCo runs on the processor: use device='cpu', or engine='warp'.")
        self.model = models[0]
        self.num_envs, self._substeps = num_envs, substeps
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        starts = zip(self.model.jnt_bodyid, self.model.jnt_type, self.model.jnt_dofadr, strict=True)
        # A body whose centre of mass is not its origin is not simple: its inertia depends on how it lies.
        self._free = {int(b): int(d) for b, kind, d in starts if kind == free and self.model.body_simple[b]}
        # Shapes in turn: every environment keeps its shape, whatever the size of the batch.
        order = np.arange(num_envs) % len(models)
        self.shape_of = order
        """Number [B] of the shape that each environment has."""
        nominal = {name: np.stack([getattr(m, name) for m in models])[order] for name in FIELDS}
        self.uses_warp = options.engine == "warp"
        """True for MuJoCo Warp, False for C MuJoCo."""
        if self.uses_warp:
            self.engine: Any = MujocoWarpEngine(list(models), num_envs, device=device, fields=nominal)
            self.qpos, self.qvel, self.ctrl = self.engine.qpos, self.engine.qvel, self.engine.ctrl
            self.push = warp().to_torch(self.engine.data.xfrc_applied)
            self._warmstart = warp().to_torch(self.engine.data.qacc_warmstart)
            self.fields = {name: self.engine.field(name) for name in FIELDS}
        else:
            self.engine = MujocoEngine(list(models), num_envs, fields=nominal, threads=options.threads)
            self.qpos = torch.from_numpy(self.engine.qpos.astype(np.float32))
            self.qvel = torch.from_numpy(self.engine.qvel.astype(np.float32))
            self.ctrl = torch.zeros(num_envs, self.model.nu)
            self.push = torch.zeros(num_envs, self.model.nbody, 6)
            self.fields = {name: torch.from_numpy(np.array(nominal[name], np.float32)) for name in FIELDS}
        self.device = self.qpos.device
        self.state = self.engine.state
        self.pose: torch.Tensor = self.state.pose_torch
        """[B, L, 7] world poses of links (m; x y z, qx qy qz qw) as of the last step or refresh; a view."""
        self._time = warp().to_torch(self.state.time)
        self.warp_device = pick_device(device)
        self.start = self.qpos.clone()
        self._pushed = False

    @property
    def timestep(self) -> float:
        """Duration of a step (s)."""
        return self._substeps * self.engine.timestep

    def step(self) -> None:
        """Advance all environments by one step, of ``substeps`` physics steps, with ``ctrl`` and ``push``."""
        if self.uses_warp:
            self.engine.step(self._substeps)
            return
        self.engine.set(ctrl=self.ctrl.numpy())
        self.engine.step(self._substeps)
        self.qpos.copy_(torch.from_numpy(self.engine.qpos))
        self.qvel.copy_(torch.from_numpy(self.engine.qvel))

    def apply_push(self) -> None:
        """Hand ``push`` (force and torque on bodies [B, nbody, 6], N and N·m, world axes) to the engine."""
        if self.uses_warp:
            return
        pushing = bool(self.push.any())
        if pushing or self._pushed:
            self.engine.set(xfrc_applied=self.push.numpy())
        self._pushed = pushing

    def refresh(self) -> None:
        """Bring poses and velocities of the state up to ``qpos`` and ``qvel``."""
        self.engine.kinematics()

    def reset(self, mask: torch.Tensor, qpos: torch.Tensor) -> None:
        """Put some environments [B] bool to positions [B, nq], at rest, and make changed ``fields`` valid there."""
        column = mask.unsqueeze(1)
        self.qpos.copy_(torch.where(column, qpos, self.qpos))
        self.qvel.masked_fill_(column, 0.0)
        self.ctrl.masked_fill_(column, 0.0)
        self.push.masked_fill_(column.unsqueeze(2), 0.0)
        self._time.masked_fill_(mask, 0.0)
        if self.uses_warp:
            self._warmstart.masked_fill_(column, 0.0)
            return
        for env in torch.nonzero(mask).flatten().tolist():
            data = self.engine.data[env]
            mujoco.mj_resetData(self.engine.models[env], data)
            data.qpos[:] = self.qpos[env].numpy()
            self._write_fields(env)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return what the next step depends on, by name: the tensors themselves, but for C MuJoCo's own state."""
        own = {"ctrl": self.ctrl, "push": self.push, "qpos": self.qpos, "qvel": self.qvel}
        own |= {f"field.{name}": value for name, value in self.fields.items()}
        if self.uses_warp:
            return {**own, "warmstart": self._warmstart, "time": self._time}
        return {**own, "integration": torch.from_numpy(self.engine.integration_state())}

    def restored(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take note that values were written to :meth:`memory`; C MuJoCo takes its own state from there."""
        if not self.uses_warp:
            for env in range(self.num_envs):
                self._write_fields(env)
            self.engine.set_integration_state(values["integration"].numpy())
        self.refresh()

    def _write_fields(self, env: int) -> None:
        values = {name: value[env].numpy() for name, value in self.fields.items()}
        # C MuJoCo takes the inertia of free bodies from here, not from their masses.
        inertia = np.array(self.engine.models[env].dof_M0)
        for body, first in self._free.items():
            inertia[first : first + 3] = values["body_mass"][body]
            inertia[first + 3 : first + 6] = values["body_inertia"][body]
        self.engine.set_fields(env, {**values, "dof_M0": inertia})
