"""The parts of a control step in their order: targets, physics and senses, reward and resets, observations.

Letters: B environment, A action, J joint, F finger tip, K object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from brainbench.core.rotations import conjugate, constant, multiply, rotate, six_numbers
from robotics_bridge.envs.reset import EpisodeReset
from robotics_bridge.envs.state import EnvState
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.terms import StepContext

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


StepResult = tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]

_DIVERGED_SPEED = 1e4
"""Speed (m/s or rad/s) beyond which an environment counts as diverged."""


@dataclass(frozen=True, eq=False)
class ActionMap:
    """The map from actions to targets of the actuators: target = clip(default + scale · action, low, high)."""

    names: tuple[str, ...]
    """Names of the joints A."""
    default: np.ndarray
    """[A] targets of zero actions (rad)."""
    scale: np.ndarray
    """[A] (rad per unit of action)."""
    low: np.ndarray
    """[A] least targets (rad)."""
    high: np.ndarray
    """[A] greatest targets (rad)."""

    def targets(self, action: np.ndarray) -> np.ndarray:
        """Return the targets [..., A] (rad) of actions [..., A]."""
        return np.clip(self.default + self.scale * action, self.low, self.high)

    def plain(self) -> dict[str, list[Any]]:
        """Return the map as files hold it."""
        return {field.name: np.asarray(getattr(self, field.name)).tolist() for field in fields(self)}


def apply_action(state: EnvState) -> None:
    """Set the actuators' targets for the action, and what pushes the object."""
    target, moved = state.actuators.target, state.moved
    before = target[:, moved]
    target.copy_(state.episode.rest_targets)
    wanted = target[:, moved] + state.action_scale * state.episode.action
    if state.target_step is not None:
        wanted = torch.clamp(wanted, before - state.target_step, before + state.target_step)
    target[:, moved] = torch.clamp(wanted, state.low[moved], state.high[moved])
    push, left = state.task.push, state.episode.push_left
    if push is None:
        return
    left -= state.step_dt
    now = (left <= 0).unsqueeze(1)
    for axis, span in enumerate((push.x, push.y, push.z)):
        force = state.draw(len(state.model.objects), *span) * now
        state.simulation.push[:, state.object_bodies, axis] = force
    left.copy_(left.where(~now[:, 0], state.draw(1, *push.interval)[:, 0]))
    state.simulation.apply_push()


def run_physics(state: EnvState) -> None:
    """Run the physics steps of one control step, and sense after each."""
    simulation = state.simulation
    for substep in range(state.substeps):
        state.actuators.launch(substep)
        simulation.step()
        if substep == 0 and state.task.push is not None:
            simulation.push.index_fill_(1, state.object_bodies, 0.0)
            simulation.apply_push()
        if state.touch is not None:
            state.touch.update(simulation.state, simulation.timestep, substep)
        if state.task_state is not None:
            state.task_state.after_physics_step(simulation.timestep)


def compute_step(state: EnvState, reset: EpisodeReset) -> StepResult:
    """Read the state after a control step, reward, begin new episodes, and return what ``Env.step`` returns."""
    task, episode, goals = state.task, state.episode, state.goals
    state.contacts.read()
    diverged = isolate_diverged(state)
    context = step_context(state)
    endings = {n: e.condition(context, **e.params) for n, e in task.endings.items()}
    if state.task_state is not None:
        state.task_state.after_control_step(context)
    context.endings = endings
    reward, parts = _reward(state, context, diverged)
    episode.age += 1
    episode.steps += 1
    terminated = diverged.clone()
    for condition in endings.values():
        terminated |= condition
    # Episodes cut by time are told apart from ended ones: learners go on with the value of the last state there.
    truncated = (episode.age >= task.max_episode_length) & ~terminated
    done = terminated | truncated
    log, won = _count_episodes(state, parts, done, diverged)
    info = {"time_outs": truncated, "diverged": diverged, "log": log, "success": won}
    full = [endings[name] for name, ending in task.endings.items() if ending.condition is terms.enough_goals]
    info["dropped"] = terminated & ~diverged & ~sum(full, torch.zeros_like(diverged))
    info |= {"goals": goals.count.clone(), "turned": goals.turned_held.clone()}
    info |= {"metric": episode.metric.clone(), "return": episode.returns.clone(), "steps": episode.steps.clone()}
    goals.count_episodes(done)
    goals.advance(state.target_pose[:, 3:], state.draw)
    if state.options.keep_final:
        info["final_observations"] = {k: v.clone() for k, v in observe(state).items()}
    reset(state, done)
    return observe(state), reward, terminated, truncated, info


def isolate_diverged(state: EnvState) -> torch.Tensor:
    """Return which environments [B] diverged, and put numbers back into them until they are reset."""
    simulation, action = state.simulation, state.episode.action
    # A sum times zero is NaN as soon as one of its terms is NaN or infinite: one number per environment to look at.
    flaw = (simulation.qpos.sum(dim=1) * 0 + simulation.qvel.sum(dim=1) * 0).isnan()
    # The engine may have ignored targets of no numbers; rewards and observations would pass the action on.
    flaw |= (action.sum(dim=1) * 0).isnan()
    diverged = flaw | (simulation.qvel.abs() > _DIVERGED_SPEED).any(dim=1)
    column = diverged.unsqueeze(1)
    simulation.qpos.copy_(torch.where(column, simulation.start, simulation.qpos))
    simulation.qvel.masked_fill_(column, 0.0)
    action.masked_fill_(column, 0.0)
    state.actuators.power.copy_(torch.nan_to_num(state.actuators.power) * ~column)
    state.contacts.forces.masked_fill_(column.unsqueeze(2), 0.0)
    return diverged


def step_context(state: EnvState) -> StepContext:
    """Return what reward terms see of a control step, and judge the goals."""
    actuators, simulation, contacts = state.actuators, state.simulation, state.contacts
    goals, episode = state.goals, state.episode
    pose, (velocity, spin) = state.target_pose, state.target_velocity
    force = contacts.on_object(state.rows, episode.target)
    goals.update(pose[:, 3:], force > 0)
    return StepContext(
        dt=state.step_dt, joint_names=state.model.joints, joint_position=simulation.qpos[:, actuators.qpos_columns],
        joint_low=state.low, joint_high=state.high, start_joints=episode.start_joints,
        power=actuators.power.sum(dim=1), action=episode.action, last_action=episode.last_action,
        object_position=pose[:, :3], object_quat=pose[:, 3:], object_velocity=velocity, object_spin=spin,
        start_position=episode.start_position, object_force=force, tip_force=contacts.tip_force,
        surface_distance=contacts.surface_distance, goal_angle=goals.angle,
        previous_goal_angle=goals.angle_before, reached=goals.reached, missed=goals.missed, goals_reached=goals.count,
        axis_rate=goals.rate, off_axis=goals.off_axis, allowed_off_axis=goals.allowed_off_axis,
        turned=goals.turned, turned_before=goals.turned_before,
    )  # fmt: skip


def _reward(state: EnvState, context: StepContext, diverged: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the reward [B] and its terms [B, terms], zero where diverged."""
    # Weights are per second, so that rewards do not depend on the control rate.
    parts = [r.weight * r.term(context, **r.params) * state.step_dt for r in state.task.rewards.values()]
    if not parts:
        return torch.zeros(state.num_envs, device=state.device), state.episode.reward_sums
    table = torch.stack(parts, dim=1).masked_fill(diverged.unsqueeze(1), 0.0)
    return table.sum(dim=1), table


def _count_episodes(
    state: EnvState, parts: torch.Tensor, done: torch.Tensor, diverged: torch.Tensor
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Add rewards and metric to the running episodes and ended ones to the totals.

    Returns:
        Means over these, and the success [B] bool so far.
    """
    episode, success = state.episode, state.task.success
    episode.reward_sums += parts
    episode.returns += parts.sum(dim=1)
    if success.metric == "goals":
        episode.metric.copy_(state.goals.count)
    elif success.metric == "turned":
        episode.metric.copy_(state.goals.turned)
    elif state.task_state is not None:
        episode.metric.copy_(state.task_state.metric())
    # What an object reached while the physics broke down is no success.
    won = (episode.metric >= success.threshold) & ~diverged
    columns = [torch.ones_like(episode.metric), won.float(), episode.metric, episode.returns, episode.steps.float()]
    table = torch.cat((torch.stack([*columns, diverged.float()], dim=1), episode.reward_sums), dim=1)
    episode.totals += (table * done.unsqueeze(1)).sum(dim=0)
    episodes = episode.totals[0].clamp(min=1)
    return {f"/episode/{name}": episode.totals[index + 1] / episodes for index, name in enumerate(STATISTICS)}, won


STATISTICS = ("success", "metric", "return", "length", "diverged")
"""Means over ended episodes, in the order of ``EpisodeState.totals`` after the number of episodes."""
