"""The state of a batch of environments: its parts, the goals, and what else steps remember, as named tensors.

Letters: B environment, A action, J joint, F finger tip, K object, L tactile link.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.core.rotations import angle_of, conjugate, from_xyzw, multiply, rotate, twist_and_swing, twist_of
from robotics_bridge.envs.simulation import Actuators, Contacts, EnvOptions, Simulation, TactileObservation
from robotics_bridge.hands import Hand
from robotics_bridge.hands.tree import coupled
from robotics_bridge.tasks.scenes import TaskModel, build
from robotics_bridge.tasks.task import Task
from robotics_bridge.tasks.terms import TaskState


class GoalState:
    """Buffers of goals, of rotation since the start, and of what happened in the last step.

    ``round_about`` [B, 3] are the axes of the objects about which a turn does not show, zero for those without.
    """

    def __init__(self, task: Task, num_envs: int, device: torch.device, round_about: torch.Tensor) -> None:
        zeros = partial(torch.zeros, num_envs, device=device)
        self.goal, self._dt = task.goal, task.step_dt
        self._round_about = round_about if self.goal is not None and self.goal.by_looks else None
        self._least = 0.0 if task.goal is None else task.goal.threshold
        self.threshold = torch.full((), self._least, device=device)
        """Angle [] below which a goal counts as reached now (rad)."""
        self._won = task.success.threshold if task.success.metric == "goals" else 1.0
        self._tally = torch.zeros(2, device=device)
        """[2] episodes that ended since the threshold was last judged, and successful ones among them."""
        self.quat, self.previous = zeros(4), zeros(4)
        self.quat[:, 0] = self.previous[:, 0] = 1.0
        """Goal, and orientation one step before [B, 4] (w, x, y, z)."""
        self.angle, self.angle_before, self.left = zeros(), zeros(), zeros()
        self.reached, self.missed = zeros(dtype=torch.bool), zeros(dtype=torch.bool)
        self.count, self.rate, self.off_axis, self.turned = zeros(), zeros(), zeros(), zeros()
        self.turned_held = zeros()
        """Rotation [B] about the commanded axis of this episode while anything touched the object (rad)."""
        self.allowed_off_axis = float(getattr(task.goal, "allowed_off_axis", float("inf")))
        self._axis = None
        if self.goal is not None and self.goal.axis is not None:
            self._axis = nn.functional.normalize(torch.tensor(self.goal.axis, device=device), dim=0)
        self._turn = None if task.turn_axis is None else torch.tensor(task.turn_axis, device=device)
        window = task.turn_window if self._turn is not None else 1
        self._ring = torch.full((window, num_envs), float("inf"), device=device)
        self._step = torch.zeros(1, dtype=torch.long, device=device)
        self.turned_before = torch.full((num_envs,), float("inf"), device=device)

    def reset(self, mask: torch.Tensor, quat: torch.Tensor, draw: Any) -> None:
        """Start new episodes in some environments [B] bool, whose objects have orientations ``quat`` [B, 4]."""
        self.previous.copy_(torch.where(mask.unsqueeze(1), quat, self.previous))
        for name in ("count", "rate", "off_axis", "turned", "turned_held"):
            getattr(self, name).masked_fill_(mask, 0.0)
        for name in ("reached", "missed"):
            getattr(self, name).masked_fill_(mask, value=False)
        self._ring.masked_fill_(mask, float("inf"))
        if self.goal is not None:
            self._set(mask, self.goal.first(quat, draw(2, 0.0, 1.0)), quat, draw)

    def looks(self, quat: torch.Tensor) -> torch.Tensor:
        """Return the orientations [B, 4] nearest to the goals in which the objects look as in ``quat`` [B, 4]."""
        if self._round_about is None:
            return quat
        return multiply(quat, twist_of(multiply(conjugate(quat), self.quat), self._round_about))

    def update(self, quat: torch.Tensor, held: torch.Tensor) -> None:
        """Judge the orientations [B, 4] after a control step, in which objects [B] bool were touched or not."""
        step = multiply(quat, conjugate(self.previous))
        self.previous.copy_(quat)
        if self._turn is not None:
            twist, _ = twist_and_swing(step, rotate(quat, self._turn))
            self.turned += twist
            if self._axis is None:
                # Where a goal commands an axis, rotation about that one is counted, below.
                self.turned_held += twist * held
            place = self._step % self._ring.shape[0]
            self.turned_before.copy_(self._ring.index_select(0, place)[0])
            self._ring.index_copy_(0, place, self.turned.unsqueeze(0))
            self._step += 1
        if self.goal is None:
            return
        error = multiply(self.quat, conjugate(self.looks(quat)))
        self.angle_before.copy_(self.angle)
        self.angle.copy_(angle_of(error))
        if self._axis is not None:
            # Rotation of the last step split into twist about the commanded axis and the swing across it.
            twist, _ = twist_and_swing(step, self._axis)
            self.rate.copy_(twist / self._dt)
            self.turned_held += twist * held
            _, swing = twist_and_swing(error, self._axis)
            self.off_axis.copy_(swing)
        self.left -= self._dt
        self.reached.copy_(self.angle < self.threshold)
        self.missed.copy_((self.left <= 0) & ~self.reached)
        self.count += self.reached

    def start_curriculum(self) -> None:
        """Start the curriculum of a goal that has one: from now on its threshold is wide and narrows."""
        if self.goal is not None and self.goal.start_threshold is not None:
            self.threshold.fill_(self.goal.start_threshold)
            self._tally.zero_()

    def count_episodes(self, done: torch.Tensor) -> None:
        """Count the episodes that end [B] bool, and narrow the threshold when enough of them succeeded."""
        if self.goal is None or self.goal.start_threshold is None:
            return
        won = done & (self.count >= self._won)
        self._tally += torch.stack((done.sum(), won.sum()))
        full = self._tally[0] >= len(done)
        # Decided on the device, without the host waiting for the count: recorded graphs cannot branch.
        narrow = full & (self._tally[1] > self.goal.mastered * self._tally[0])
        closer = (self.threshold * self.goal.narrowing).clamp(min=self._least)
        self.threshold.copy_(torch.where(narrow, closer, self.threshold))
        self._tally.masked_fill_(full, 0.0)

    def curriculum(self) -> dict[str, torch.Tensor]:
        """Return what remembers how far the curriculum went; nothing without one."""
        if self.goal is None or self.goal.start_threshold is None:
            return {}
        return {"threshold": self.threshold, "tally": self._tally}

    def advance(self, quat: torch.Tensor, draw: Any) -> None:
        """Propose the next goals where the present ones are reached or their time is up."""
        if self.goal is not None:
            following = self.goal.following(quat, self.quat, draw(2, 0.0, 1.0))
            self._set(self.reached | self.missed, following, quat, draw)

    def _set(self, mask: torch.Tensor, goal: torch.Tensor, quat: torch.Tensor, draw: Any) -> None:
        self.quat.copy_(torch.where(mask.unsqueeze(1), goal, self.quat))
        angle = angle_of(multiply(self.quat, conjugate(self.looks(quat))))
        self.angle.copy_(torch.where(mask, angle, self.angle))
        deadline = None if self.goal is None else self.goal.deadline
        if deadline is None:
            self.left.fill_(float("inf"))
        else:
            self.left.copy_(torch.where(mask, draw(1, *deadline)[:, 0], self.left))

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that later steps depend on, by name."""
        names = ("quat", "previous", "angle", "angle_before", "left", "reached", "missed", "count", "rate", "off_axis")
        tensors = {name: getattr(self, name) for name in (*names, "turned", "turned_held")}
        return {**tensors, "ring": self._ring, "step": self._step[0], **self.curriculum()}


@dataclass(eq=False)
class EpisodeState:
    """Memory of the running episodes beside physics, goals and sensors."""

    action: torch.Tensor
    """[B, A] of this control step, within ``task.action_limit``."""
    last_action: torch.Tensor
    """[B, A] of the control step before."""
    age: torch.Tensor
    """[B] control steps by which episodes end; learners write to it to start episodes at random ages."""
    steps: torch.Tensor
    """[B] control steps since the episode began."""
    returns: torch.Tensor
    """[B] undiscounted reward since the episode began."""
    reward_sums: torch.Tensor
    """[B, terms] the same of each term."""
    metric: torch.Tensor
    """[B] success metric of the task since the episode began."""
    friction: torch.Tensor
    """[B] factor on the friction of the objects."""
    mass: torch.Tensor
    """[B] of the first object (kg)."""
    push_left: torch.Tensor
    """[B] time until the next push (s)."""
    start_joints: torch.Tensor
    """[B, J] positions at the start of the episode (rad)."""
    start_position: torch.Tensor
    """[B, 3] of the object that counts at the start of the episode (m)."""
    rest_targets: torch.Tensor
    """[B, J] targets of the actuators without action (rad)."""
    target: torch.Tensor
    """[B] number of the object that counts."""
    totals: torch.Tensor
    """[6 + terms] sums over episodes that ended since the statistics were read: episodes, successes, metric, return,
    length, divergences, and the reward of each term."""

    @classmethod
    def start(
        cls, num_envs: int, device: torch.device, *, actions: int, terms: int, rest: torch.Tensor
    ) -> EpisodeState:
        """Return the state before the first episode, with rest positions [J] as targets."""
        zeros = partial(torch.zeros, num_envs, device=device)
        return cls(
            action=zeros(actions), last_action=zeros(actions), age=zeros(dtype=torch.long),
            steps=zeros(dtype=torch.long), returns=zeros(), reward_sums=zeros(terms), metric=zeros(), friction=zeros(),
            mass=zeros(), push_left=zeros(), start_joints=zeros(len(rest)), start_position=zeros(3),
            rest_targets=rest.repeat(num_envs, 1), target=zeros(dtype=torch.long),
            totals=torch.zeros(6 + terms, device=device),
        )  # fmt: skip


class EnvState:
    """A batch of environments of a task: what resets, steps and observations read and write."""

    def __init__(self, task: Task, hand: Hand, options: EnvOptions) -> None:
        self.task, self.hand, self.options, self.num_envs = task, hand, options, options.num_envs
        self.model: TaskModel = build(task, hand)
        self.simulation = Simulation(self.model.models, options, substeps=task.contacts.substeps)
        self.device: torch.device = self.simulation.device
        self.step_dt: float = task.step_dt
        """Duration of a control step (s)."""
        self.substeps: int = task.solver.decimation
        """Physics steps of a control step."""
        self.generator = torch.Generator(device=self.device)
        self.generator.manual_seed(options.seed)
        self.actuators = Actuators(self.simulation, self.model, task, seed=options.seed)
        axes = [shape.round_about or (0.0, 0.0, 0.0) for shape in self.model.shapes]
        round_about = torch.tensor([axes[shape] for shape in self.simulation.shape_of], device=self.device)
        self.goals = GoalState(task, self.num_envs, self.device, round_about)
        self.touch: TactileObservation | None = None
        if options.observe != "none":
            self.touch = TactileObservation(self.model, hand, self.simulation, options, task)
        self._index()
        self.episode = EpisodeState.start(
            self.num_envs, self.device, actions=len(self.model.moved), terms=len(task.rewards), rest=self.rest
        )
        self.contacts = Contacts(self.simulation, self.model, step_dt=self.step_dt, seed=options.seed)
        self.observations: dict[str, torch.Tensor] = {}
        """Observations of the last step or reset, by group."""
        self.started = False
        """True once an episode began; friction and mass of the objects are drawn for the first one in any case."""
        self.task_state: TaskState | None = None if task.task_state is None else task.task_state(self)
        """The part of the task with a state of its own."""

    def _index(self) -> None:
        """Set the constants of the task, and where its joints, objects and links stand in the physics."""
        floats, integers = (
            partial(torch.as_tensor, dtype=kind, device=self.device) for kind in (torch.float32, torch.long)
        )
        model, first = self.model, self.simulation.model
        self.rows = torch.arange(self.num_envs, device=self.device)
        """[B] numbers of the environments, for indexing."""
        self.moved = integers([model.joints.index(name) for name in model.moved])
        """[A] numbers of the joints that actions move."""
        self.low, self.high, self.rest = floats(model.low), floats(model.high), floats(model.rest)
        """[J] limits and positions at rest (rad)."""
        for follower, leader, law in coupled(first):
            # Joints that follow others start where their law has them; of joints at 0 that is mostly 0.
            columns = [int(first.jnt_qposadr[joint]) for joint in (follower, leader)]
            start, offset = (float(first.qpos0[column]) for column in columns)
            if (name := first.joint(leader).name) in model.joints:
                offset = float(model.rest[model.joints.index(name)]) - offset
                self.simulation.start[:, columns[0]] = start + float(np.polynomial.Polynomial(law)(offset))
        # An action of 1 is the same share of every joint's range.
        self.action_scale = self.task.action_ratio * (self.high - self.low)[self.moved]
        """[A] change of a target per unit of action (rad)."""
        self.target_step: torch.Tensor | None = None
        """[A] largest change of a target in a control step (rad or m); None where it may jump."""
        if self.task.rated_speed:
            driven = [name for name in model.moved if not name.startswith("carriage_")]
            rated = dict(zip(driven, self.hand.rated_speeds(driven), strict=True))
            speeds = np.array([rated.get(name, self.task.carriage_speed) for name in model.moved])
            self.target_step = floats(self.step_dt * speeds)
        bodies = [first.body(name).id for name in model.objects]
        self.object_bodies = integers(bodies)
        """[K] numbers of the objects' bodies."""
        joints = [int(first.body_jntadr[body]) for body in bodies]
        self.object_qpos = integers([int(first.jnt_qposadr[j]) + k for j in joints for k in range(7)])
        """[K·7] columns of ``qpos``."""
        self.object_qvel = integers([int(first.jnt_dofadr[j]) + k for j in joints for k in range(6)])
        """[K·6] columns of ``qvel``."""
        self.shape_of = integers(self.simulation.shape_of)
        """[B] number of the shape that the objects of each environment have."""
        self.extent = floats([shape.extent for shape in model.shapes])[self.shape_of]
        """[B, 3] edges of the box around the object (m)."""
        scene = self.simulation.engine.scene
        self._palm = scene.link_index(self.hand.palm)
        links = () if self.touch is None else self.touch.links
        self._tactile_links = integers([scene.link_index(link) for link in links])

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that the future depends on, by name, of all parts."""
        parts = {"actuators": self.actuators, "goals": self.goals, "contacts": self.contacts}
        parts["simulation"] = self.simulation
        if self.task_state is not None:
            parts["task_state"] = self.task_state
        tensors: dict[str, torch.Tensor] = dict(vars(self.episode))
        tensors |= {f"{part}.{name}": value for part, owner in parts.items() for name, value in owner.memory().items()}
        if self.touch is not None:
            felt = self.touch.suite.memory(self.simulation.timestep)
            tensors |= {"touch.reading": self.touch.reading, **{f"touch.{name}": value for name, value in felt.items()}}
        return tensors

    def draw(self, count: int, low: float, high: float) -> torch.Tensor:
        """Return uniform random numbers [B, count]."""
        # For all environments, whoever needs them: the draws of one do not depend on the resets of others.
        numbers = torch.rand(self.num_envs, count, generator=self.generator, device=self.device)
        return low + (high - low) * numbers

    @property
    def object_pose(self) -> torch.Tensor:
        """Poses [B, K, 7] of the objects (x y z, qw qx qy qz)."""
        return self.simulation.qpos[:, self.object_qpos].unflatten(1, (-1, 7))

    @property
    def target_pose(self) -> torch.Tensor:
        """Pose [B, 7] of the object that counts (x y z, qw qx qy qz)."""
        return self.object_pose[self.rows, self.episode.target]

    @property
    def target_velocity(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Velocity [B, 3] (m/s) and angular velocity [B, 3] (rad/s) of the object that counts, world axes."""
        speed = self.simulation.qvel[:, self.object_qvel].unflatten(1, (-1, 6))[self.rows, self.episode.target]
        # MuJoCo's free joints have their angular velocity in the body's own frame.
        return speed[:, :3], rotate(self.target_pose[:, 3:], speed[:, 3:])

    @property
    def link_pose(self) -> torch.Tensor:
        """Poses [B, L, 7] of the tactile links in the palm's frame (x y z, qw qx qy qz)."""
        if self.touch is None:
            raise UsageError("There are no tactile links; make the environment with an observation type.")
        pose = self.simulation.pose
        palm, links = pose[:, self._palm : self._palm + 1], pose[:, self._tactile_links]
        # Pose relative to the palm, p = R₀ᵀ (x − x₀) and q = q₀⁻¹ q: it does not change when the whole hand is carried.
        inverse = conjugate(from_xyzw(palm[..., 3:])).expand(-1, links.shape[1], -1)
        place = rotate(inverse, links[..., :3] - palm[..., :3])
        return torch.cat((place, multiply(inverse, from_xyzw(links[..., 3:]))), dim=-1)
