"""Imperfect position drives: the published actuator randomisation as one kernel per physics step.

Torque = strength · (stiffness · e − damping · q̇ + kick · sign e) + noise, held within the joint's effort. The error e
is between target and measured position, which carries a bias and the play of the gears (a stop operator on the
joint's motion); below the deadband it counts as none. Letters: B environment, J joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import warp

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.simulation import World
    from robotics_bridge.tasks.scenes import TaskModel
    from robotics_bridge.tasks.task import ActuatorRandomisation

_DRAWN = ("stiffness", "damping", "strength", "bias", "deadband", "backlash", "kick")
_KEPT = ("play", "before")


class Drives:
    """Drives of all joints of all environments."""

    def __init__(
        self, world: World, model: TaskModel, changes: ActuatorRandomisation | None, *, substeps: int, seed: int
    ) -> None:
        import torch

        from robotics_bridge.envs.kernels.actuation import environment_kernels

        self._world, self._changes, self._substeps, self._seed = world, changes, substeps, seed & 0x3FFFFFFF
        self._kernels = environment_kernels()
        device, count, joints = world.device, world.num_envs, len(model.joints)
        first = model.models[0]
        ids = [first.joint(name).id for name in model.joints]
        self.positions = torch.as_tensor(np.array(first.jnt_qposadr[ids]), device=device).long()
        """[J] columns of ``qpos``."""
        self.speeds = torch.as_tensor(np.array(first.jnt_dofadr[ids]), device=device).long()
        """[J] columns of ``qvel``."""
        self.nominal = {
            name: torch.as_tensor(getattr(model, name), dtype=torch.float32, device=device)
            for name in ("stiffness", "damping", "effort")
        }
        shape = (count, joints)
        self.values = {name: torch.zeros(shape, device=device) for name in (*_DRAWN, *_KEPT)}
        self.target = torch.zeros(shape, device=device)
        """[B, J] positions that the drives seek (rad)."""
        self.power = torch.zeros(shape, device=device)
        """[B, J] mean |torque · speed| over the last control step (W)."""
        self._tick = torch.zeros(1, dtype=torch.int32, device=device)
        self._noise = self.nominal["effort"] * (changes.torque_noise if changes else 0.0)
        wp = warp()
        drive = self._kernels.Drive()
        for name, value in self.values.items():
            setattr(drive, name, wp.from_torch(value, dtype=wp.float32))
        drive.effort = wp.from_torch(self.nominal["effort"])
        drive.noise = wp.from_torch(self._noise)
        channels = [first.actuator(name).id for name in model.joints]
        columns = {"position": first.jnt_qposadr[ids], "speed": first.jnt_dofadr[ids], "channel": channels}
        for name, numbers in columns.items():
            column = wp.array(np.array(numbers, dtype=np.int32), dtype=wp.int32, device=world.warp_device)
            setattr(drive, name, column)
        self._drive = drive
        self._arrays: dict[str, Any] = {
            name: wp.from_torch(value)
            for name, value in (("target", self.target), ("power", self.power), ("tick", self._tick))
        }
        self._arrays |= {name: wp.from_torch(getattr(world, name)) for name in ("qpos", "qvel", "ctrl")}

    def reset(self, mask: torch.Tensor, draw: Any) -> None:
        """Draw imperfections anew in some environments [B] bool.

        Args:
            mask: which.
            draw: ``draw(n, low, high)`` returns uniform random numbers [B, n].
        """
        import torch

        column, joints = mask.unsqueeze(1), self.target.shape[1]
        position = self._world.qpos[:, self.positions]
        c = self._changes
        values = {"stiffness": self.nominal["stiffness"], "damping": self.nominal["damping"]}
        if c is not None:
            values = {
                "stiffness": self.nominal["stiffness"] * draw(joints, *c.stiffness),
                "damping": self.nominal["damping"] * draw(joints, *c.damping),
                "strength": draw(joints, *c.strength), "bias": draw(joints, *c.position_bias),
                "deadband": draw(joints, *c.deadband), "backlash": draw(joints, *c.backlash),
                "kick": c.kick * draw(joints, *c.kick_ratio),
            }  # fmt: skip
        else:
            values["strength"] = torch.ones_like(self.target)
        for name, value in {**values, "play": torch.zeros_like(self.target), "before": position}.items():
            own = self.values[name]
            own.copy_(torch.where(column, value, own))
        self.target.copy_(torch.where(column, position, self.target))

    def seed(self, seed: int) -> None:
        """Begin the torque noise anew."""
        self._seed = seed & 0x3FFFFFFF
        self._tick.zero_()

    def launch(self, substep: int) -> None:
        """Write the torques of one physics step to the world's ``ctrl``."""
        wp, a, device = warp(), self._arrays, self._world.warp_device
        inputs = [self._drive, a["qpos"], a["qvel"], a["target"], self._seed, a["tick"]]
        inputs += [int(substep == 0), 1.0 / self._substeps, a["ctrl"], a["power"]]
        wp.launch(self._kernels.drive, dim=self.target.shape, inputs=inputs, device=device)
        wp.launch(self._kernels.count, dim=1, inputs=[a["tick"]], device=device)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all memory."""
        own = {**self.values, "target": self.target, "power": self.power, "tick": self._tick}
        import torch

        return {**{name: value.clone() for name, value in own.items()}, "seed": torch.tensor(self._seed)}

    def load_state_dict(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take up what :meth:`state_dict` returned."""
        own = {**self.values, "target": self.target, "power": self.power, "tick": self._tick}
        for name, value in own.items():
            value.copy_(values[name])
        self._seed = int(values["seed"])
