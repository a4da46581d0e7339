"""Imperfect position actuators: the published randomisation as one kernel per physics step.

Torque = strength · (stiffness · e − damping · q̇ + kick · sign e) + noise, held within the joint's effort. The error e
is between target and measured position, which carries a bias and the play of the gears (a stop operator on the
joint's motion); below the deadband it counts as none. Letters: B environment, J joint.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brainbench.core.devices import warp
from robotics_bridge.envs.kernels.actuation import ActuatorArrays, actuate, count_launch
from robotics_bridge.envs.simulation import Simulation
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Task

_IMPERFECTIONS = ("strength", "bias", "deadband", "backlash", "kick")


class Actuators:
    """Actuators of all joints of all environments."""

    def __init__(self, simulation: Simulation, model: TaskModel, task: Task, *, seed: int) -> None:
        self._simulation, self._changes, self._substeps = simulation, task.actuators, task.solver.decimation
        device, first = simulation.device, simulation.model
        ids = [first.joint(name).id for name in model.joints]
        self.qpos_columns = torch.as_tensor(np.array(first.jnt_qposadr[ids]), device=device).long()
        """[J] columns of ``qpos``."""
        self.qvel_columns = torch.as_tensor(np.array(first.jnt_dofadr[ids]), device=device).long()
        """[J] columns of ``qvel``."""
        self.nominal = {
            name: torch.as_tensor(getattr(model, name), dtype=torch.float32, device=device)
            for name in ("stiffness", "damping", "effort")
        }

        self.lever = torch.as_tensor(model.lever, dtype=torch.float32, device=device)
        """[J] factor on imperfections and noise that are stated for hinges."""

        def zeros() -> torch.Tensor:
            return torch.zeros(simulation.num_envs, len(ids), device=device)

        names = ("stiffness", "damping", *_IMPERFECTIONS, "play", "before")
        self.values = {name: zeros() for name in names}
        """[B, J] gains and imperfections, and what the gears remember (as in ``ActuatorArrays``)."""
        self.target = zeros()
        """[B, J] positions that the actuators seek (rad)."""
        self.power = zeros()
        """[B, J] mean |torque · speed| over the last control step (W)."""
        self._noise_state = torch.zeros(2, dtype=torch.int32, device=device)
        """[2] launches so far, and where the torque noise of the seed begins."""
        self.seed(seed)
        self._noise = self.nominal["effort"] * (task.actuators.torque_noise if task.actuators else 0.0)
        wp = warp()
        self._actuate, self._count = actuate, count_launch
        self._arrays = ActuatorArrays()
        for name, value in self.values.items():
            setattr(self._arrays, name, wp.from_torch(value, dtype=wp.float32))
        self._arrays.effort, self._arrays.noise = wp.from_torch(self.nominal["effort"]), wp.from_torch(self._noise)
        channels = [first.actuator(name).id for name in model.joints]
        columns = {"position": first.jnt_qposadr[ids], "speed": first.jnt_dofadr[ids], "channel": channels}
        for name, numbers in columns.items():
            column = wp.array(np.array(numbers, dtype=np.int32), dtype=wp.int32, device=simulation.warp_device)
            setattr(self._arrays, name, column)
        shared = (simulation.qpos, simulation.qvel, self.target, self._noise_state, simulation.ctrl, self.power)
        self._qpos, self._qvel, self._target, self._random, self._ctrl, self._power = map(wp.from_torch, shared)

    def reset(self, mask: torch.Tensor, draw: Any) -> None:
        """Draw imperfections anew in some environments [B] bool; ``draw(n, low, high)`` returns numbers [B, n]."""
        column, joints = mask.unsqueeze(1), self.target.shape[1]
        position, c = self._simulation.qpos[:, self.qpos_columns], self._changes
        values = {name: self.nominal[name] for name in ("stiffness", "damping")}
        values |= {"play": torch.zeros_like(self.target), "before": position, "strength": torch.ones_like(self.target)}
        if c is not None:
            # Stated for hinges; a slide moves as the tip of a finger would.
            lever = self.lever
            values |= {
                "stiffness": self.nominal["stiffness"] * draw(joints, *c.stiffness),
                "damping": self.nominal["damping"] * draw(joints, *c.damping),
                "strength": draw(joints, *c.strength), "bias": lever * draw(joints, *c.position_bias),
                "deadband": lever * draw(joints, *c.deadband), "backlash": lever * draw(joints, *c.backlash),
                "kick": c.kick * draw(joints, *c.kick_ratio) / lever,
            }  # fmt: skip
        for name, value in values.items():
            own = self.values[name]
            own.copy_(torch.where(column, value, own))
        self.target.copy_(torch.where(column, position, self.target))

    def seed(self, seed: int) -> None:
        """Begin the torque noise anew."""
        self._noise_state[0].fill_(0)
        # The kernel adds the launch to it. An odd multiplier, 2³² over the golden ratio, keeps streams of neighbouring
        # seeds apart, which would be the same ones a launch later.
        self._noise_state[1].fill_(seed * 0x9E3779B1 & 0x3FFFFFFF)

    def launch(self, substep: int) -> None:
        """Write the torques of one physics step to the simulation's ``ctrl``."""
        wp, device = warp(), self._simulation.warp_device
        inputs = [self._arrays, self._qpos, self._qvel, self._target, self._random]
        inputs += [int(substep == 0), 1.0 / self._substeps, self._ctrl, self._power]
        wp.launch(self._actuate, dim=self.target.shape, inputs=inputs, device=device)
        wp.launch(self._count, dim=1, inputs=[self._random], device=device)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that the next launch depends on, by name."""
        own = {"target": self.target, "power": self.power}
        return {**self.values, **own, "tick": self._noise_state[:1], "seed": self._noise_state[1]}
