"""Observation groups of table 4.7. Letters: B environment, J joint, A action, F finger tip."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from brainbench.core.rotations import conjugate, constant, multiply, rotate, six_numbers

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.env import Env

VELOCITY = 0.2
"""Factor on velocities of joints and on angular velocities of the object (released settings)."""


def observe(env: Env) -> dict[str, torch.Tensor]:
    """Return every group that the task or the caller asks for, float32 [B, ...]."""
    wanted = {name for names in env.task.groups.values() for name in names} | set(env.task.auxiliary)
    wanted.add("proprio")
    if env.touch is not None:
        wanted.add("tactile")
        wanted |= {"link_pose"} if env._with_link_pose else set()
    return {name: make(env) for name, make in _GROUPS.items() if name in wanted}


def shapes_of(observations: Mapping[str, torch.Tensor]) -> dict[str, tuple[int, ...]]:
    """Return the shape of every group for one environment."""
    return {name: tuple(value.shape[1:]) for name, value in observations.items()}


def _joints(env: Env, *, noisy: bool) -> torch.Tensor:
    import torch

    world, noise = env.world, env.task.noise
    position = world.qpos[:, env.drives.positions]
    velocity = VELOCITY * world.qvel[:, env.drives.speeds]
    if noisy:
        drawn = torch.randn(2, *position.shape, generator=env._generator, device=env.device)
        position = position + noise.position * drawn[0]
        velocity = velocity + noise.velocity * drawn[1]
    return torch.cat((position, velocity, env.action), dim=1)


def _goal(env: Env) -> torch.Tensor:
    import torch

    goals = env.goals
    difference = multiply(goals.quat, conjugate(env._object_quat()))
    parts = {"orientation": goals.quat, "difference": six_numbers(difference), "angle": goals.angle.unsqueeze(1)}
    return torch.cat([parts[name] for name in env.task.goal_terms], dim=1)


def _object(env: Env) -> torch.Tensor:
    import torch

    pose = env.object_pose[env.rows, env.target]
    speed = env.world.qvel[:, env._object_speeds].unflatten(1, (-1, 6))[env.rows, env.target]
    quat = pose[:, 3:]
    parts = [pose[:, :3], six_numbers(quat), speed[:, :3], VELOCITY * rotate(quat, speed[:, 3:])]
    if env.task.distances_in == "priv_obj_state":
        parts.append(env.surface_distance)
    return torch.cat(parts, dim=1)


def _properties(env: Env) -> torch.Tensor:
    import torch

    parts = [env.friction.unsqueeze(1), env.mass.unsqueeze(1)]
    if env.task.distances_in == "priv_obj_props":
        parts.append(env.surface_distance)
    return torch.cat(parts, dim=1)


def _privileged_joints(env: Env) -> torch.Tensor:
    import torch

    return torch.cat((_joints(env, noisy=False), env.tip_force.flatten(1)), dim=1)


def _tactile(env: Env) -> torch.Tensor:
    assert env.touch is not None
    return env.touch.reading


def _tilt(env: Env) -> torch.Tensor:
    quat = env._object_quat()
    axis = constant(env.task.turn_axis or (0.0, 0.0, -1.0), quat)
    return rotate(quat, -axis)[:, 2:].clamp(-1.0, 1.0).acos()


def _thermal(env: Env) -> torch.Tensor:
    assert env.watch is not None
    return env.watch.observe("thermal")


def _privileged_thermal(env: Env) -> torch.Tensor:
    assert env.watch is not None
    return env.watch.observe("priv_thermal")


_GROUPS: dict[str, Callable[[Env], torch.Tensor]] = {
    "proprio": lambda env: _joints(env, noisy=True),
    "tactile": _tactile,
    "link_pose": lambda env: env.link_pose,
    "goal": _goal,
    "priv_proprio": _privileged_joints,
    "priv_obj_state": _object,
    "priv_obj_props": _properties,
    "thermal": _thermal,
    "priv_thermal": _privileged_thermal,
    "aux_obj_size": lambda env: env._extent,
    "aux_goal_dist": lambda env: env.goals.angle.unsqueeze(1).clone(),
    "aux_obj_tilt": _tilt,
    "aux_rotation_progress": lambda env: env.goals.turned.unsqueeze(1).clone(),
}
