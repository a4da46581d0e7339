"""The native environment: many copies of a task stepped together, as torch tensors on one device.

Letters: B environment, A action, J joint, F finger tip, K object, S physics step of a control step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.cuda_graphs import CudaGraphStep, warp_recorder
from brainbench.core.devices import pick_device
from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.rotations import conjugate, from_xyzw, multiply, rotate
from robotics_bridge.envs.actions import ActionMap
from robotics_bridge.envs.actuators import Drives
from robotics_bridge.envs.checkpoint import restore, saved
from robotics_bridge.envs.contacts import Contacts
from robotics_bridge.envs.goal_state import GoalState
from robotics_bridge.envs.observations import observe, shapes_of
from robotics_bridge.envs.reset import Resets
from robotics_bridge.envs.simulation import World
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.tasks.scenes import build
from robotics_bridge.tasks.step_context import StepContext

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.tactile import TactileLayout
    from robotics_bridge.hands import Hand
    from robotics_bridge.tasks.task import Task
    from robotics_bridge.tasks.task_state import TaskState

ENGINES = ("mujoco", "warp")
_WILD = 1e4
"""Speed (m/s or rad/s) beyond which an environment counts as diverged."""
_ADVICE = (
    "Terms and watches of a task may not copy from the processor or wait for it (brainbench.core.rotations.constant "
    "keeps constants on the device); change them, or make the environment with graphs=False."
)


class Env:
    """A batch of environments; environments that end are reset within the same step.

    Args:
        task: what to do.
        hand: with which hand.
        num_envs: B.
        device: ``cpu``, ``cuda`` or ``cuda:1``.
        engine: ``mujoco`` (C MuJoCo) or ``warp`` (MuJoCo Warp); by default the one for the device.
        observe: tactile observation type (table 4.3); ``none`` builds no tactile sensor.
        placement: ``hand``, ``fingers``, ``tips`` or ``palm``.
        resolution: ``low``, ``med`` or ``high``.
        noisy: tactile readings with the published imperfections, and noise on joints.
        seed: of all random numbers.
        link_pose: also observe the poses of the tactile links in the palm's frame.
        keep_final: return the last observations of episodes that ended as ``info["final_observations"]``.
        threads: of C MuJoCo.
        knobs: further settings of the tactile sensors, e.g. ``{"points": 500}``.
        graphs: replay what a control step does around physics as CUDA graphs, recorded in the third step; by default
            on CUDA. A task whose terms cannot be recorded runs without, and says so; with ``True`` it is an error.

    Raises:
        UsageError: a name or number is not valid.
    """

    def __init__(
        self,
        task: Task,
        hand: Hand,
        *,
        num_envs: int = 1,
        device: str = "cpu",
        engine: str | None = None,
        observe: str = "none",
        placement: str = "hand",
        resolution: str = "med",
        noisy: bool = False,
        seed: int = 0,
        link_pose: bool = False,
        keep_final: bool = False,
        threads: int | None = None,
        knobs: dict[str, Any] | None = None,
        graphs: bool | None = None,
    ) -> None:
        import torch

        if num_envs < 1:
            raise UsageError(f"There must be at least one environment; received {num_envs}.")
        engine = engine or ("mujoco" if device == "cpu" else "warp")
        if engine not in ENGINES:
            raise unknown_name("engine", engine, ENGINES)
        observation_type(observe)
        pick_device(device)
        self.task, self.hand, self.num_envs, self.observe = task, hand, num_envs, observe
        self.model = build(task, hand)
        self.world = World(self.model.models, num_envs, device=device, engine=engine, threads=threads)
        self.device: torch.device = self.world.device
        if graphs and self.device.type != "cuda":
            raise UsageError(
                f"Graphs are recorded on CUDA only, and the environment is on {self.device}; leave it out."
            )
        self.decimation, self.physics_dt, self.step_dt = task.solver.decimation, self.world.timestep, task.step_dt
        self.max_episode_length = math.ceil(task.episode / self.step_dt)
        self._generator = torch.Generator(device=self.device)
        self._generator.manual_seed(seed)
        self.keeps_final = keep_final
        """Whether ``step`` returns the last observations of episodes."""
        self.drives = Drives(self.world, self.model, task.actuators, substeps=self.decimation, seed=seed)
        self.goals = GoalState(task, num_envs, self.device)
        self.touch = None
        if observe != "none":
            from robotics_bridge.envs.tactile import TactileObservation

            self.touch = TactileObservation(
                self.model, hand, self.world.engine.scene, observe=observe, placement=placement,
                resolution=resolution, noisy=noisy, num_envs=num_envs, substeps=self.decimation,
                device=self.world.warp_device, seed=seed, knobs=knobs or {},
            )  # fmt: skip
        elif link_pose:
            raise UsageError("Poses of tactile links belong to tactile sensors; choose an observation type.")
        self._with_link_pose = link_pose
        self._buffers()
        self.contacts = Contacts(self.world, self.model, step_dt=self.step_dt, seed=seed)
        self.watch: TaskState | None = None if task.watch is None else task.watch(self)
        """The part of the task with a state of its own."""
        self._resets = Resets(self)
        # Functions, not bound methods: an environment that refers to itself would outlive its use.
        self._aim_part: Callable[[Env], Any] = Env._aim
        self._judge_part: Callable[[Env], Any] = Env._judge
        if self.device.type == "cuda" and graphs is not False:
            kept = [self._extent] if self.touch is None else [self._extent, self.touch.reading]
            generators = [self._generator]
            recorder = warp_recorder(self.world.warp_device, generators)
            self._aim_part, self._judge_part = (
                CudaGraphStep(
                    part, recorder, subject="The control step", advice=_ADVICE, generators=generators, kept=kept,
                    required=bool(graphs),
                )
                for part in (Env._aim, Env._judge)
            )  # fmt: skip
        self.observations: dict[str, torch.Tensor] = {}
        """Of the last step or reset."""
        self.reset()
        self.observation_shapes = shapes_of(self.observations)
        """Group → shape per environment."""

    # --- facts -------------------------------------------------------------------------------------------------

    @property
    def num_actions(self) -> int:
        """Number of actions A."""
        return len(self.model.moved)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Driven joints J."""
        return self.model.joints

    @property
    def action_names(self) -> tuple[str, ...]:
        """Joints A that actions move."""
        return self.model.moved

    @property
    def action_map(self) -> ActionMap:
        """How actions become joint targets."""
        low, high = self.model.low[self._columns], self.model.high[self._columns]
        scale = self.task.action_ratio * (high - low)
        return ActionMap(self.model.moved, self.model.rest[self._columns], scale, low, high)

    @property
    def frozen(self) -> dict[str, float]:
        """Joint → position (rad) of joints that actions do not move."""
        rest = zip(self.model.joints, self.model.rest.tolist(), strict=True)
        return {name: value for name, value in rest if name not in self.model.moved}

    @property
    def tactile(self) -> TactileLayout | None:
        """Where the columns of the group ``tactile`` sit; None without touch."""
        return None if self.touch is None else self.touch.layout

    @property
    def link_pose(self) -> torch.Tensor:
        """Poses [B, L, 7] of the tactile links in the palm's frame (x y z, qx qy qz qw)."""
        import torch

        if self.touch is None:
            raise UsageError("There are no tactile links; make the environment with an observation type.")
        pose = self.world.pose
        palm, links = pose[:, self._palm : self._palm + 1], pose[:, self._tactile_links]
        inverse = conjugate(from_xyzw(palm[..., 3:])).expand(-1, links.shape[1], -1)
        place = rotate(inverse, links[..., :3] - palm[..., :3])
        turn = multiply(inverse, from_xyzw(links[..., 3:]))
        return torch.cat((place, turn[..., 1:], turn[..., :1]), dim=-1)

    @property
    def recorded(self) -> bool:
        """Whether what a control step does around physics is replayed as CUDA graphs by now."""
        return isinstance(self._judge_part, CudaGraphStep) and self._judge_part.recorded

    @property
    def object_pose(self) -> torch.Tensor:
        """Poses [B, K, 7] of the objects (x y z, qw qx qy qz)."""
        return self.world.qpos[:, self._object_columns].unflatten(1, (-1, 7))

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps [B] by which episodes end; learners write to it to start episodes at random ages."""
        return self._age

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        if value is not self._age:
            self._age.copy_(value)

    # --- life --------------------------------------------------------------------------------------------------

    def reset(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Start new episodes in some environments ([B] bool; all by default) and return the observations."""
        import torch

        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        elif mask.shape != (self.num_envs,) or mask.dtype != torch.bool:
            raise UsageError(f"A mask has one bool per environment ({self.num_envs}); received {tuple(mask.shape)}.")
        self._resets.begin(self, mask)
        self.observations = observe(self)
        return self.observations

    def step(
        self, action: torch.Tensor
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance all environments by one control step.

        Args:
            action: [B, A]; 0 is the rest position, 1 is ``task.action_ratio`` of the joint's range from it. Beyond
                ``task.action_limit`` it counts as that limit.

        Returns:
            Observations by group (the next step overwrites ``tactile``), reward [B], terminated [B] and truncated [B]
            (bool), and a dictionary with ``time_outs`` (truncated), ``diverged`` [B], of ended episodes ``metric``,
            ``return``, ``steps``, ``goals`` reached and ``turned`` [B] (rotation about the commanded axis while
            anything touched the object, rad), and ``final_observations`` if asked for.

        Raises:
            UsageError: the action has another shape.
        """
        if tuple(action.shape) != (self.num_envs, self.num_actions):
            raise UsageError(
                f"Actions have the shape {(self.num_envs, self.num_actions)} (environments, joints moved); "
                f"received {tuple(action.shape)}."
            )
        self.last_action.copy_(self.action)
        limit = self.task.action_limit
        self.action.copy_(action.detach() if limit is None else action.detach().clamp(-limit, limit))
        self._aim_part(self)
        self._advance()
        result = self._judge_part(self)
        self.observations = result[0]
        return result

    def seed(self, seed: int) -> None:
        """Begin the random numbers anew, from the next reset on."""
        self._generator.manual_seed(seed)
        self.drives.seed(seed)

    def statistics(self) -> dict[str, float]:
        """Return means over the episodes that ended since the last call; waits for the device."""
        totals = self._totals.tolist()
        episodes = totals[0]
        self._totals.zero_()
        names = ("success", "metric", "return", "length", "diverged", *(f"reward/{n}" for n in self.task.rewards))
        return {"episodes": episodes} | {
            name: value / episodes if episodes else float("nan") for name, value in zip(names, totals[1:], strict=True)
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return everything that the future depends on, but for the memory of noisy or slow tactile sensors."""
        return saved(self)

    def load_state_dict(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take up what :meth:`state_dict` returned."""
        restore(self, values)

    # --- parts of a step ---------------------------------------------------------------------------------------

    def _buffers(self) -> None:
        import torch

        count, first = self.num_envs, self.world.model

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(count, *shape, dtype=dtype, device=self.device)

        self.rows = torch.arange(count, device=self.device)
        """[B] numbers of the environments, for indexing."""
        self.action, self.last_action = zeros(self.num_actions), zeros(self.num_actions)
        self._age = zeros(dtype=torch.long)
        self._steps, self._return, self.metric = zeros(dtype=torch.long), zeros(), zeros()
        self.friction, self.mass = zeros(), zeros()
        self._push_left = zeros()
        self._start_joints, self._start_position = zeros(len(self.model.joints)), zeros(3)
        self._sums = zeros(len(self.task.rewards))
        self._totals = torch.zeros(6 + len(self.task.rewards), device=self.device)
        self._columns = np.array([self.model.joints.index(name) for name in self.model.moved], dtype=np.int64)
        self._moved = torch.as_tensor(self._columns, device=self.device)

        def floats(values: Any) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

        self._low, self._high = floats(self.model.low), floats(self.model.high)
        self._rest = floats(self.model.rest)
        self._home = self._rest.repeat(count, 1)
        self._scale = self.task.action_ratio * (self._high - self._low)[self._moved]
        bodies = [first.body(name).id for name in self.model.objects]
        self._bodies = torch.as_tensor(bodies, device=self.device)
        addresses = [int(first.jnt_qposadr[first.body_jntadr[body]]) for body in bodies]
        speeds = [int(first.jnt_dofadr[first.body_jntadr[body]]) for body in bodies]
        self._object_columns = torch.as_tensor([a + k for a in addresses for k in range(7)], device=self.device)
        self._object_speeds = torch.as_tensor([a + k for a in speeds for k in range(6)], device=self.device)
        self.target = zeros(dtype=torch.long)
        """[B] number of the object that counts."""
        kind = torch.as_tensor(self.world.shape_of, device=self.device)
        self._extent = floats([shape.extent for shape in self.model.shapes])[kind]
        scene = self.world.engine.scene
        self._palm = scene.link_index(self.hand.palm)
        if self.touch is not None:
            links = [scene.link_index(link) for link in self.touch.layout.links]
            self._tactile_links = torch.as_tensor(links, device=self.device)

    def _aim(self) -> None:
        """Set the drives' targets for the action, and what pushes the object."""
        import torch

        target = self.drives.target
        target.copy_(self._home)
        moved = target[:, self._moved] + self._scale * self.action
        target[:, self._moved] = torch.clamp(moved, self._low[self._moved], self._high[self._moved])
        self._shove()

    def _advance(self) -> None:
        """Run the physics steps of one control step, and sense after each."""
        for substep in range(self.decimation):
            self.drives.launch(substep)
            self.world.step()
            if substep == 0 and self.task.push is not None:
                self.world.push.index_fill_(1, self._bodies, 0.0)
                self.world.apply_push()
            if self.touch is not None:
                self.touch.update(self.world.state, self.physics_dt, substep)
            if self.watch is not None:
                self.watch.during(self.physics_dt)

    def _shove(self) -> None:
        push = self.task.push
        if push is None:
            return
        self._push_left -= self.step_dt
        now = (self._push_left <= 0).unsqueeze(1)
        for axis, span in enumerate((push.x, push.y, push.z)):
            force = self._draw(len(self.model.objects), *span) * now
            self.world.push[:, self._bodies, axis] = force
        self._push_left.copy_(self._push_left.where(~now[:, 0], self._draw(1, *push.interval)[:, 0]))
        self.world.apply_push()

    def _judge(self) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Read the state after a control step, reward, begin new episodes, and return what ``step`` returns."""
        self.contacts.read()
        diverged = self._contain()
        moment = self._moment()
        endings = {n: e.condition(moment, **e.params) for n, e in self.task.endings.items()}
        if self.watch is not None:
            self.watch.after(moment)
        moment.endings = endings
        reward, parts = self._reward(moment, diverged)
        self.episode_length_buf += 1
        self._steps += 1
        terminated = diverged.clone()
        for condition in endings.values():
            terminated |= condition
        truncated = (self.episode_length_buf >= self.max_episode_length) & ~terminated
        done = terminated | truncated
        info = {"time_outs": truncated, "diverged": diverged, "log": self._account(parts, done, diverged)}
        info |= {"goals": self.goals.count.clone(), "turned": self.goals.turned_held.clone()}
        info |= {"metric": self.metric.clone(), "return": self._return.clone(), "steps": self._steps.clone()}
        self.goals.account(done)
        self.goals.advance(self._object_quat(), self._draw)
        if self.keeps_final:
            info["final_observations"] = {k: v.clone() for k, v in observe(self).items()}
        self._resets.begin(self, done)
        return observe(self), reward, terminated, truncated, info

    def _contain(self) -> torch.Tensor:
        """Return which environments [B] diverged, and put numbers back into them until they are reset."""
        import torch

        world = self.world
        flaw = (world.qpos.sum(dim=1) * 0 + world.qvel.sum(dim=1) * 0).isnan()
        diverged = flaw | (world.qvel.abs() > _WILD).any(dim=1)
        column = diverged.unsqueeze(1)
        world.qpos.copy_(torch.where(column, world.start, world.qpos))
        world.qvel.masked_fill_(column, 0.0)
        self.drives.power.copy_(torch.nan_to_num(self.drives.power) * ~column)
        self.contacts.forces.masked_fill_(column.unsqueeze(2), 0.0)
        return diverged

    def _moment(self) -> StepContext:
        quat = self._object_quat()
        force = self.contacts.on_object(self.rows, self.target)
        self.goals.update(quat, force > 0)
        goals, world = self.goals, self.world
        pose, rows = self.object_pose, self.rows
        speed = world.qvel[:, self._object_speeds].unflatten(1, (-1, 6))[rows, self.target]
        return StepContext(
            dt=self.step_dt, joint_names=self.model.joints, joint_position=world.qpos[:, self.drives.positions],
            joint_velocity=world.qvel[:, self.drives.speeds], joint_low=self._low, joint_high=self._high,
            start_joints=self._start_joints, power=self.drives.power.sum(dim=1), action=self.action,
            last_action=self.last_action, object_position=pose[rows, self.target, :3], object_quat=quat,
            object_velocity=speed[:, :3], object_spin=rotate(quat, speed[:, 3:]), start_position=self._start_position,
            object_force=force, tip_force=self.tip_force,
            surface_distance=self.surface_distance, step_count=self._steps, goal_angle=goals.angle,
            previous_goal_angle=goals.angle_before, reached=goals.reached, missed=goals.missed,
            goals_reached=goals.count, axis_rate=goals.rate, off_axis=goals.off_axis,
            allowed_off_axis=goals.allowed_off_axis, turned=goals.turned,
            turned_before=goals.turned_before,
        )  # fmt: skip

    @property
    def tip_force(self) -> torch.Tensor:
        """Net normal contact force [B, F, 3] on finger tips in their own frame, within ±10 N as published."""
        return self.contacts.tip_force

    @property
    def surface_distance(self) -> torch.Tensor:
        """Distance [B, F] from each finger tip to the object (m), at most 0.5."""
        return self.contacts.surface_distance

    def _object_quat(self) -> torch.Tensor:
        return self.object_pose[self.rows, self.target, 3:]

    def _reward(self, moment: StepContext, diverged: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the reward [B] and its terms [B, terms], zero where diverged."""
        import torch

        parts = [r.weight * r.term(moment, **r.params) * self.step_dt for r in self.task.rewards.values()]
        if not parts:
            return torch.zeros(self.num_envs, device=self.device), self._sums
        table = torch.stack(parts, dim=1).masked_fill(diverged.unsqueeze(1), 0.0)
        return table.sum(dim=1), table

    def _account(self, parts: torch.Tensor, done: torch.Tensor, diverged: torch.Tensor) -> dict[str, torch.Tensor]:
        import torch

        self._sums += parts
        self._return += parts.sum(dim=1)
        success = self.task.success
        if success.metric == "goals":
            self.metric.copy_(self.goals.count)
        elif success.metric == "turned":
            self.metric.copy_(self.goals.turned)
        elif self.watch is not None:
            self.metric.copy_(self.watch.metric())
        won = self.metric >= success.threshold
        columns = [torch.ones_like(self.metric), won.float(), self.metric, self._return, self._steps.float()]
        table = torch.cat((torch.stack([*columns, diverged.float()], dim=1), self._sums), dim=1)
        self._totals += (table * done.unsqueeze(1)).sum(dim=0)
        episodes = self._totals[0].clamp(min=1)
        names = ("success", "metric", "return", "length", "diverged")
        return {f"/episode/{name}": self._totals[index + 1] / episodes for index, name in enumerate(names)}

    def _draw(self, count: int, low: float, high: float) -> torch.Tensor:
        """Return uniform random numbers [B, count]."""
        import torch

        numbers = torch.rand(self.num_envs, count, generator=self._generator, device=self.device)
        return low + (high - low) * numbers
