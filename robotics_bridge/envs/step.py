"""The parts of a control step in their order: targets, physics and senses, reward and resets, observations.

Letters: B environment, A action, J joint, F finger tip, K object.

Beginnings of episodes: where hand and object start, what the object weighs, and grasps to start from (G grasp).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.core.rotations import about, conjugate, constant, multiply, rotate, six_numbers
from robotics_bridge.envs.state import EnvState
from robotics_bridge.hands import Hand
from robotics_bridge.hands.tree import lineage
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Solver, Task
from robotics_bridge.tasks.terms import StepContext

VELOCITY = 0.2  # factor on velocities of joints and on angular velocities of the object (released settings)


def observe(state: EnvState) -> dict[str, torch.Tensor]:
    """Return every group that the task or the caller asks for, float32 [B, ...]."""
    task = state.task
    wanted = {"proprio", *task.auxiliary, *(name for names in task.groups.values() for name in names)}
    wanted |= {"tactile"} if state.touch is not None else set()
    wanted |= {"link_pose"} if state.options.link_pose else set()
    return {name: make(state) for name, make in _GROUPS.items() if name in wanted}


def _joints(state: EnvState, *, noisy: bool) -> torch.Tensor:
    """Return positions, scaled velocities and the last action [B, 2J + A]."""
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

_DIVERGED_SPEED = 1e4  # speed (m/s or rad/s) beyond which an environment counts as diverged


JOINTS = 255  # most joints; a frame counts them in one byte
Name = Annotated[str, Meta(min_length=1, max_length=4096)]
Names = Annotated[tuple[Name, ...], Meta(min_length=1, max_length=JOINTS)]
Angle = Annotated[float, Meta(ge=-4 * math.pi, le=4 * math.pi)]  # position of a joint (rad)
_Scale = Annotated[float, Meta(ge=-10, le=10)]  # 0 is not allowed


@dataclass(frozen=True)
class ActionMap:
    """The map from actions to targets of the actuators: target = clip(default + scale · action, low, high)."""

    names: Names
    """Names of the joints A."""
    default: tuple[Angle, ...]
    """[A] targets of zero actions (rad)."""
    scale: tuple[_Scale, ...]
    """[A] (rad per unit of action)."""
    low: tuple[Angle, ...]
    """[A] least targets (rad)."""
    high: tuple[Angle, ...]
    """[A] greatest targets (rad)."""

    def targets(self, action: np.ndarray) -> np.ndarray:
        """Return the targets [..., A] (rad) of actions [..., A]."""
        return np.clip(np.array(self.default) + np.array(self.scale) * action, self.low, self.high)


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

mujoco = mujoco_module()


@dataclass(frozen=True, kw_only=True)
class GraspSampling:
    """Settings of the search for grasps of the screwdriver, as released with the thesis.

    A candidate is a random change of the task's joints, the tool upright near its place with any yaw. Fingers that
    would begin inside the tool are opened until they hardly touch. It is kept if enough finger tips are near the
    surface, nothing penetrates, and the tool stays where it is while the drives hold.
    """

    count: int = 64
    """Grasps in total, shared evenly between shapes."""
    perturb: float = 0.2
    """Half range of the change of each joint [rad]."""
    near_fingers: int = 3
    """Finger tips that must be near the surface."""
    near: float = 0.02
    """Distance of a finger tip that counts as near [m]."""
    max_penetration: float = 0.003
    """[m]."""
    max_displacement: float = 0.01
    """Displacement of the object while it is held [m]."""
    shift: float = 0.01
    """Half range of the object's x and y [m]."""
    hold: float = 0.5
    """For how long it must be held [s]."""
    squeeze: float = 0.06
    """By how much targets lie beyond the surface that the fingers touch [rad]."""
    tries: int = 4000
    """Candidates per shape before giving up."""


_SEED = 0  # of the candidates
_VERSION = 1  # raised whenever the same settings would sample other grasps
SETTINGS = {"xhand1": GraspSampling(), "sharpa": GraspSampling(near=0.01)}  # by hand; others take those of xhand1


def grasps_for(task: Task, hand: Hand, model: TaskModel) -> dict[str, NDArray[np.float64]]:
    """Return grasps for every shape of a task, sampled once and kept in the cache.

    Returns:
        ``joints`` [G, J] (rad) and ``target`` [G, J] of the drives, ``object`` [G, 7] poses (x y z, qw qx qy qz) and
        ``rows`` [shapes, n]: which grasps belong to which shape.
    """
    settings = SETTINGS.get(hand.name, SETTINGS["xhand1"])
    fields = ("geom_size", "geom_pos", "body_pos", "body_quat", "body_mass")
    numbers = [np.round(getattr(m, name), 6).tolist() for m in model.models for name in fields]
    # By these a grasp holds too. Usual values are left out, since keys of earlier versions do not have them.
    defaults = ((task.friction, 1.0), (asdict(task.solver), asdict(Solver())), (hand.physics, None))
    numbers += [model.rest.tolist(), *(own for own, other in defaults if own != other)]
    key = content_hash(_VERSION, asdict(settings), asdict(task.contacts), task.name, _SEED, *numbers)
    path = cache_dir("grasps") / f"{hand.name}-{key}.npz"
    if (cached := read_sealed(path, "grasps")) is not None:
        return cached
    each = max(settings.count // len(model.models), 1)
    parts = [sample(task, hand, model, index, each, settings) for index in range(len(model.models))]
    grasps = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    grasps["rows"] = np.arange(each * len(parts), dtype=float).reshape(len(parts), each)
    write_sealed(path, "grasps", grasps)
    return grasps


def sample(
    task: Task, hand: Hand, model: TaskModel, shape: int, count: int, settings: GraspSampling
) -> dict[str, NDArray[np.float64]]:
    """Return grasps ``joints``, ``target`` [n, J] and ``object`` [n, 7] of one shape."""
    trial = _Trial(task, model, shape, settings)
    rng = np.random.default_rng((_SEED, shape))
    grasps: dict[str, list[NDArray[np.float64]]] = {"joints": [], "target": [], "object": []}
    for _ in range(settings.tries):
        if len(grasps["joints"]) == count:
            break
        # Candidates by rejection: random joints, places and turns, of which only those that hold are kept.
        change = rng.uniform(-settings.perturb, settings.perturb, len(model.rest))
        joints = np.clip(model.rest + change, model.low, model.high)
        place = np.append(rng.uniform(-settings.shift, settings.shift, 2), 0.0)
        held = trial.run(joints, place, rng.uniform(-np.pi, np.pi))
        if held is not None:
            for name, value in held.items():
                grasps[name].append(value)
    if len(grasps["joints"]) < count:
        raise DataError(
            f"Only {len(grasps['joints'])} of {count} grasps of {model.shapes[shape].name!r} by hand {hand.name!r} "
            f"held in {settings.tries} tries; set joints near a grasp (Task.joints) or another pose (Task.hand_poses)."
        )
    return {name: np.array(values) for name, values in grasps.items()}


class _Trial:
    """Tries candidates in one simulation."""

    def __init__(self, task: Task, model: TaskModel, shape: int, settings: GraspSampling) -> None:
        self._task, self._settings, self._model = task, settings, model
        self._m: Any = model.models[shape]
        self._d = mujoco.MjData(self._m)
        self._joints = np.array([self._m.joint(name).qposadr[0] for name in model.joints])
        self._speeds = np.array([self._m.joint(name).dofadr[0] for name in model.joints])
        self._drive = np.array([self._m.actuator(name).id for name in model.joints])
        self._object = self._m.body(model.objects[0]).id
        self._address = int(self._m.joint(model.objects[0]).qposadr[0])
        self._tips = [(self._m.body(link).id, np.array(point)) for link, point in model.tips.items()]
        # The flexing joints that move a tip: one whose range lies about its zero spreads the finger and is left alone.
        flexes = np.abs(model.low + model.high) >= 0.5 * (model.high - model.low)
        owners = np.array([self._m.jnt_bodyid[self._m.joint(name).id] for name in model.joints])
        chains = ([(owners == link) & flexes for link in lineage(self._m, body)[:-1]] for body, _ in self._tips)
        self._chains = [np.concatenate([np.flatnonzero(moved) for moved in chain]) for chain in chains]

    def run(self, joints: NDArray[np.float64], place: NDArray[np.float64], yaw: float) -> dict[str, Any] | None:
        """Return the settled grasp, or None if it does not hold."""
        s, d, model = self._settings, self._d, self._model
        opened = self._opened(joints, place, yaw)
        if opened is None or self._near() < s.near_fingers:
            return None
        # Targets beyond where the fingers stand: position drives press only as far as they miss their target.
        target = np.clip(opened + s.squeeze * self._closing, model.low, model.high)
        start = d.xpos[self._object].copy()
        for _ in range(round(s.hold / self._m.opt.timestep)):
            # The same law as the environment's actuators, without their imperfections.
            torque = model.stiffness * (target - d.qpos[self._joints]) - model.damping * d.qvel[self._speeds]
            d.ctrl[self._drive] = np.clip(torque, -model.effort, model.effort)
            mujoco.mj_step(self._m, d)
        pose = d.qpos[self._address : self._address + 7].copy()
        axis = d.xmat[self._object].reshape(3, 3) @ np.array([0.0, 1.0, 0.0])
        lost = np.linalg.norm(d.xpos[self._object] - start) > s.max_displacement or axis[2] < 0.995
        fingers = {body for body, _ in self._tips} & set(self._contacts()[0].tolist())
        if lost or not np.isfinite(d.qpos).all() or self._penetration() > s.max_penetration or len(fingers) < 2:
            return None
        return {"joints": d.qpos[self._joints].copy(), "target": target, "object": pose}

    def _opened(self, joints: NDArray[np.float64], place: NDArray[np.float64], yaw: float) -> Any:
        """Return joints at which no finger starts inside the tool (None without), and note which way they close."""
        chosen, flexed = joints.copy(), np.sign(self._model.high + self._model.low)
        self._closing = np.zeros(len(joints))
        for _ in range(12):
            self._put(chosen, place, yaw)
            touched, depths = self._contacts()
            depth = [max([0.0, *depths[touched == body]]) for body, _ in self._tips]
            if all(value <= 1e-3 for value in depth):
                break
            for columns, value in zip(self._chains, depth, strict=True):
                if value > 1e-3:
                    chosen[columns] -= 0.05 * flexed[columns]
            chosen = np.clip(chosen, self._model.low, self._model.high)
        for columns in self._chains:
            if any(self._model.joints[c] in self._model.moved for c in columns):
                self._closing[columns] = flexed[columns]
        return chosen if self._penetration() <= self._settings.max_penetration else None

    def _put(self, joints: NDArray[np.float64], place: NDArray[np.float64], yaw: float) -> None:
        d = self._d
        mujoco.mj_resetData(self._m, d)
        d.qpos[self._joints] = joints
        quat = np.zeros(4)
        turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        mujoco.mju_mulQuat(quat, turn, np.array(self._task.placement.quaternion))
        d.qpos[self._address : self._address + 7] = (*place, *quat)
        mujoco.mj_forward(self._m, d)

    def _contacts(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the other body and the depth (m) of every contact of the tool."""
        bodies = self._m.geom_bodyid[self._d.contact.geom]
        mine = (bodies == self._object).any(axis=1)
        return bodies[mine].sum(axis=1) - self._object, -self._d.contact.dist[mine]

    def _penetration(self) -> float:
        return max([0.0, *self._contacts()[1]])

    def _near(self) -> int:
        """Return how many finger tips are near the tool."""
        d = self._d
        geoms = np.flatnonzero(self._m.geom_bodyid == self._object)
        places = np.array([d.xpos[body] + d.xmat[body].reshape(3, 3) @ point for body, point in self._tips])
        local = (places[:, None, None] - d.geom_xpos[geoms][:, None]) @ d.geom_xmat[geoms].reshape(-1, 3, 3)
        out, along = np.hypot(local[..., 0, 0], local[..., 0, 1]), np.abs(local[..., 0, 2])
        radius, half = self._m.geom_size[geoms, :2].T
        distance = np.hypot((out - radius).clip(0), (along - half).clip(0))
        return int((distance.min(axis=1) < self._settings.near).sum())


class EpisodeReset:
    """Starts new episodes of an environment batch, without looking at which from the host."""

    def __init__(self, state: EnvState) -> None:
        self._nominal = {name: value.clone() for name, value in state.simulation.fields.items()}
        bodies = state.object_bodies.cpu().numpy()
        geoms = np.flatnonzero(np.isin(np.asarray(state.simulation.model.geom_bodyid), bodies))
        self._geoms = torch.as_tensor(geoms, device=state.device)
        floats = partial(torch.as_tensor, dtype=torch.float32, device=state.device)
        self._bottom = floats([shape.bottom for shape in state.model.shapes])[state.shape_of]
        self._grasps = None
        if state.task.starts == "grasps":
            self._grasps = {k: floats(v) for k, v in grasps_for(state.task, state.hand, state.model).items()}
            # Grasps belong to a shape: each environment takes one of its own.
            self._grasp_rows = self._grasps["rows"][state.shape_of].long()
        sites = state.task.placement.sites
        self._sites = floats(sites) if sites else None

    def __call__(self, state: EnvState, mask: torch.Tensor) -> None:
        """Start new episodes where the mask [B] bool is set."""
        column, episode, simulation = mask.unsqueeze(1), state.episode, state.simulation
        qpos, targets = self._starts(state)
        episode.rest_targets.copy_(torch.where(column, targets, episode.rest_targets))
        self._randomise_objects(state, mask)
        simulation.reset(mask, qpos)
        state.actuators.reset(mask, state.draw)
        if state.task_state is not None:
            state.task_state.reset(mask)
        for buffer in (episode.action, episode.last_action, episode.reward_sums):
            buffer.masked_fill_(column, 0.0)
        for buffer in (episode.age, episode.steps, episode.returns, episode.metric):
            buffer.masked_fill_(mask, 0)
        joints, pose = simulation.qpos[:, state.actuators.qpos_columns], state.target_pose
        episode.start_joints.copy_(torch.where(column, joints, episode.start_joints))
        episode.start_position.copy_(torch.where(column, pose[:, :3], episode.start_position))
        if state.task.push is not None:
            fresh = state.draw(1, *state.task.push.interval)[:, 0]
            episode.push_left.copy_(torch.where(mask, fresh, episode.push_left))
        state.goals.reset(mask, pose[:, 3:], state.draw)
        if state.touch is not None:
            state.touch.reset(mask)
        state.contacts.reset(mask)
        simulation.refresh()
        state.contacts.refresh(mask)
        state.started = True

    def _starts(self, state: EnvState) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions [B, nq] for new episodes, and the actuators' targets [B, J] without action."""
        place, count, joints = state.task.placement, len(state.model.objects), state.actuators.qpos_columns
        qpos = state.simulation.start.clone()
        if self._grasps is not None:
            size = self._grasp_rows.shape[1]
            pick = (state.draw(1, 0.0, 1.0)[:, 0] * size).long().clamp(max=size - 1)
            row = self._grasp_rows.gather(1, pick.unsqueeze(1))[:, 0]
            qpos[:, joints] = self._grasps["joints"][row]
            qpos[:, state.object_qpos] = self._grasps["object"][row]
            return qpos, self._grasps["target"][row]
        qpos[:, joints] = state.rest
        poses = torch.zeros(state.num_envs, count, 7, device=state.device)
        upright = constant(place.quaternion, poses).expand(state.num_envs, -1)
        up = constant((0.0, 0.0, 1.0), poses)
        if self._sites is not None:
            # Sorting random numbers gives a random order of the sites: objects never share one.
            order = state.draw(len(self._sites), 0.0, 1.0).argsort(dim=1)[:, :count]
            poses[..., :3] = self._sites[order]
        for index in range(count):
            x, y, yaw = (state.draw(1, *span)[:, 0] for span in (place.x, place.y, place.yaw))
            poses[:, index, 0] += x
            poses[:, index, 1] += y
            poses[:, index, 2] += place.height + self._bottom
            poses[:, index, 3:] = multiply(about(up, yaw), upright)
        qpos[:, state.object_qpos] = poses.flatten(1)
        return qpos, state.rest.expand_as(state.episode.rest_targets)

    def _randomise_objects(self, state: EnvState, mask: torch.Tensor) -> None:
        """Draw friction and mass of the objects anew where the mask [B] is set."""
        nominal, changes, fields = self._nominal, state.task.object_changes, state.simulation.fields
        if state.started and not changes.each_reset:
            return
        ratio, offset = state.draw(1, *changes.friction), state.draw(1, *changes.mass_offset)
        bodies, geoms, column = state.object_bodies, self._geoms, mask.unsqueeze(1)
        mass = (nominal["body_mass"][:, bodies] + offset).clamp(min=1e-6)
        # Inertia grows with the mass as for a body of other density and the same shape.
        growth = (mass / nominal["body_mass"][:, bodies]).unsqueeze(2)
        inertia = nominal["body_inertia"][:, bodies] * growth
        # What MuJoCo's mj_setConst derives for a body that moves freely.
        weights = torch.stack((1 / mass, (1 / inertia).mean(dim=2)), dim=2)
        values = {
            "body_mass": (bodies, mass), "body_subtreemass": (bodies, mass), "body_inertia": (bodies, inertia),
            "body_invweight0": (bodies, weights),
            "geom_friction": (geoms, nominal["geom_friction"][:, geoms] * ratio.unsqueeze(2)),
        }  # fmt: skip
        for name, (where, value) in values.items():
            chosen = column if value.ndim == 2 else column.unsqueeze(2)
            fields[name][:, where] = torch.where(chosen, value, fields[name][:, where])
        state.episode.friction.copy_(torch.where(mask, ratio[:, 0], state.episode.friction))
        state.episode.mass.copy_(torch.where(mask, mass[:, 0], state.episode.mass))
