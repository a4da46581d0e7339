"""Observation groups of table 4.7. Letters: B environment, J joint, A action, F finger tip."""

from __future__ import annotations

from collections.abc import Callable

import torch

from brainbench.core.rotations import conjugate, constant, multiply, rotate, six_numbers
from robotics_bridge.envs.state import EnvState

VELOCITY = 0.2
"""Factor on velocities of joints and on angular velocities of the object (released settings)."""


def observe(state: EnvState) -> dict[str, torch.Tensor]:
    """Return every group that the task or the caller asks for, float32 [B, ...]."""
    task = state.task
    wanted = {"proprio", *task.auxiliary, *(name for names in task.groups.values() for name in names)}
    wanted |= {"tactile"} if state.touch is not None else set()
    wanted |= {"link_pose"} if state.options.link_pose else set()
    return {name: make(state) for name, make in _GROUPS.items() if name in wanted}


def _joints(state: EnvState, *, noisy: bool) -> torch.Tensor:
    simulation, noise = state.simulation, state.task.noise
    position = simulation.qpos[:, state.actuators.qpos_columns]
    velocity = VELOCITY * simulation.qvel[:, state.actuators.qvel_columns]
    if noisy:
        drawn = torch.randn(2, *position.shape, generator=state.generator, device=state.device) * state.actuators.lever
        # White noise of encoders in every control step; the privileged groups read the same joints without it.
        position = position + noise.position * drawn[0]
        velocity = velocity + noise.velocity * drawn[1]
    return torch.cat((position, velocity, state.episode.action), dim=1)


def _command(state: EnvState) -> torch.Tensor:
    parts = {"on": torch.ones(state.num_envs, 1, device=state.device), "orientation": state.goals.quat.clone()}
    return torch.cat([parts[name] for name in state.task.command], dim=1)


def _goal(state: EnvState) -> torch.Tensor:
    goals = state.goals
    # Rotation from the object to its goal, g q⁻¹, in world axes.
    difference = multiply(goals.quat, conjugate(goals.looks(state.target_pose[:, 3:])))
    parts = {"orientation": goals.quat, "difference": six_numbers(difference), "angle": goals.angle.unsqueeze(1)}
    return torch.cat([parts[name] for name in state.task.goal_terms], dim=1)


def _object(state: EnvState) -> torch.Tensor:
    pose, (velocity, spin) = state.target_pose, state.target_velocity
    parts = [pose[:, :3], six_numbers(state.goals.looks(pose[:, 3:])), velocity, VELOCITY * spin]
    if state.task.distances_in == "priv_obj_state":
        parts.append(state.contacts.surface_distance)
    return torch.cat(parts, dim=1)


def _properties(state: EnvState) -> torch.Tensor:
    parts = [state.episode.friction.unsqueeze(1), state.episode.mass.unsqueeze(1)]
    if state.task.distances_in == "priv_obj_props":
        parts.append(state.contacts.surface_distance)
    return torch.cat(parts, dim=1)


def _tilt(state: EnvState) -> torch.Tensor:
    quat = state.target_pose[:, 3:]
    axis = constant(state.task.turn_axis or (0.0, 0.0, -1.0), quat)
    return rotate(quat, -axis)[:, 2:].clamp(-1.0, 1.0).acos()


_GROUPS: dict[str, Callable[[EnvState], torch.Tensor]] = {
    "proprio": lambda state: _joints(state, noisy=True),
    "tactile": lambda state: state.touch.reading,  # type: ignore[union-attr]
    "link_pose": lambda state: state.link_pose,
    "command": _command,
    "goal": _goal,
    "priv_proprio": lambda state: torch.cat((_joints(state, noisy=False), state.contacts.tip_force.flatten(1)), dim=1),
    "priv_obj_state": _object,
    "priv_obj_props": _properties,
    "thermal": lambda state: state.task_state.observe("thermal"),  # type: ignore[union-attr]
    "priv_thermal": lambda state: state.task_state.observe("priv_thermal"),  # type: ignore[union-attr]
    "aux_obj_size": lambda state: state.extent,
    "aux_goal_dist": lambda state: state.goals.angle.unsqueeze(1).clone(),
    "aux_obj_tilt": _tilt,
    "aux_rotation_progress": lambda state: state.goals.turned.unsqueeze(1).clone(),
}
