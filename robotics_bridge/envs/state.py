"""The state of a batch of environments: its parts, and what they do not remember themselves as named tensors.

Letters: B environment, A action, J joint, F finger tip, K object, L tactile link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from brainbench.core.rotations import conjugate, from_xyzw, multiply, rotate
from robotics_bridge.envs.actuators import Actuators
from robotics_bridge.envs.contacts import Contacts
from robotics_bridge.envs.goal_state import GoalState
from robotics_bridge.envs.options import EnvOptions
from robotics_bridge.envs.simulation import Simulation
from robotics_bridge.envs.tactile import TactileObservation
from robotics_bridge.hands import Hand
from robotics_bridge.tasks.scenes import TaskModel, build, coupled
from robotics_bridge.tasks.step_context import TaskState
from robotics_bridge.tasks.task import Task


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

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(num_envs, *shape, dtype=dtype, device=device)

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
            from robotics_bridge.envs.tactile import TactileObservation

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

        def floats(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

        def integers(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values, dtype=np.int64), device=self.device)

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
            own, other = (float(first.qpos0[column]) for column in columns)
            if (name := first.joint(leader).name) in model.joints:
                other = float(model.rest[model.joints.index(name)]) - other
                self.simulation.start[:, columns[0]] = own + float(np.polynomial.Polynomial(law)(other))
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
        found: dict[str, torch.Tensor] = dict(vars(self.episode))
        found |= {f"{part}.{name}": value for part, owner in parts.items() for name, value in owner.memory().items()}
        if self.touch is not None:
            clock, wp = self.touch.suite.context, warp()
            found |= {"touch.age": wp.to_torch(clock.age), "touch.episode": wp.to_torch(clock.episode)}
            found["touch.reading"] = self.touch.reading
        return found

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
