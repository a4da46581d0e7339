"""Beginnings of episodes: where hand and object start, what the object weighs, and grasps to start from.

Letters: B environment, J joint, G grasp.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.core.rotations import about, constant, multiply
from robotics_bridge.envs.state import EnvState
from robotics_bridge.hands import Hand
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Solver, Task

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


_VERSION = 1
"""Raised whenever the same settings would sample other grasps."""
SETTINGS = {"xhand1": GraspSampling(), "sharpa": GraspSampling(near=0.01)}
"""By hand; others take those of xhand1."""


def grasps_for(task: Task, hand: Hand, model: TaskModel, *, seed: int = 0) -> dict[str, NDArray[np.float64]]:
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
    key = content_hash(_VERSION, asdict(settings), asdict(task.contacts), task.name, seed, *numbers)
    path = cache_dir("grasps") / f"{hand.name}-{key}.npz"
    if (cached := read_sealed(path, "grasps")) is not None:
        return cached
    each = max(settings.count // len(model.models), 1)
    parts = [sample(task, hand, model, index, each, settings, seed) for index in range(len(model.models))]
    grasps = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    grasps["rows"] = np.arange(each * len(parts), dtype=float).reshape(len(parts), each)
    write_sealed(path, "grasps", grasps)
    return grasps


def sample(
    task: Task, hand: Hand, model: TaskModel, shape: int, count: int, settings: GraspSampling, seed: int
) -> dict[str, NDArray[np.float64]]:
    """Return grasps ``joints``, ``target`` [n, J] and ``object`` [n, 7] of one shape."""
    trial = _Trial(task, model, shape, settings)
    rng = np.random.default_rng((seed, shape))
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
        self._chains = [self._above(body) for body, _ in self._tips]

    def run(self, joints: NDArray[np.float64], place: NDArray[np.float64], yaw: float) -> dict[str, Any] | None:
        """Return the settled grasp, or None if it does not hold."""
        s, d = self._settings, self._d
        opened = self._opened(joints, place, yaw)
        if opened is None or self._near() < s.near_fingers:
            return None
        # Targets beyond where the fingers stand: position drives press only as far as they miss their target.
        target = np.clip(opened + s.squeeze * self._closing, self._model.low, self._model.high)
        start = d.xpos[self._object].copy()
        for _ in range(round(s.hold / self._m.opt.timestep)):
            self._step(target)
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

    def _step(self, target: NDArray[np.float64]) -> None:
        d, model = self._d, self._model
        # The same law as the environment's actuators, without their imperfections.
        torque = model.stiffness * (target - d.qpos[self._joints]) - model.damping * d.qvel[self._speeds]
        d.ctrl[self._drive] = np.clip(torque, -model.effort, model.effort)
        mujoco.mj_step(self._m, d)

    def _above(self, body: int) -> NDArray[np.int64]:
        """Return the numbers of the flexing joints that move a body; those that spread a finger are left alone."""
        model, columns = self._model, []
        # A joint whose range lies about its zero spreads the finger; flexion has a one-sided range.
        flexes = np.abs(model.low + model.high) >= 0.5 * (model.high - model.low)
        owners = np.array([self._m.jnt_bodyid[self._m.joint(name).id] for name in model.joints])
        while body > 0:
            columns.append(np.flatnonzero((owners == body) & flexes))
            body = int(self._m.body_parentid[body])
        return np.concatenate(columns)

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
        geoms = np.flatnonzero(self._m.geom_bodyid == self._object).tolist()
        places = [d.xpos[body] + d.xmat[body].reshape(3, 3) @ point for body, point in self._tips]
        return sum(min(self._distance(geom, place) for geom in geoms) < self._settings.near for place in places)

    def _distance(self, geom: int, point: NDArray[np.float64]) -> float:
        """Return the distance of a point from a cylinder or capsule (m)."""
        local = self._d.geom_xmat[geom].reshape(3, 3).T @ (point - self._d.geom_xpos[geom])
        radius, half = self._m.geom_size[geom, :2]
        # Distance to a cylinder from outside; a capsule is treated as one, which is near enough for "near".
        beyond = np.array([max(np.hypot(local[0], local[1]) - radius, 0.0), max(abs(local[2]) - half, 0.0)])
        return float(np.linalg.norm(beyond))


class EpisodeReset:
    """Starts new episodes of an environment batch, without looking at which from the host."""

    def __init__(self, state: EnvState) -> None:
        self._nominal = {name: value.clone() for name, value in state.simulation.fields.items()}
        bodies = state.object_bodies.cpu().numpy()
        geoms = np.flatnonzero(np.isin(np.asarray(state.simulation.model.geom_bodyid), bodies))
        self._geoms = torch.as_tensor(geoms, device=state.device)

        def floats(values: object) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=state.device)

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
