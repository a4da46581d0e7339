"""The native environment: many copies of a task stepped together, as torch tensors on one device; for rsl_rl too.

Letters: B environment, A action, J joint, L tactile link.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch

from brainbench.core.devices import CudaGraphStep
from brainbench.core.errors import UsageError, check_kind, check_number, needing
from robotics_bridge import hands
from robotics_bridge.envs.simulation import EnvOptions, warp_recorder
from robotics_bridge.envs.state import EnvState
from robotics_bridge.envs.step import (
    STATISTICS,
    ActionMap,
    EpisodeReset,
    StepResult,
    apply_action,
    compute_step,
    observe,
    run_physics,
)
from robotics_bridge.tasks.registry import load
from robotics_bridge.tasks.task import Task

if TYPE_CHECKING:
    from tensordict import TensorDict

_NOISE_SEED = "noise_seed"  # name in kept states of the seed of tactile noise
_SENSED = (_NOISE_SEED, "touch.", "task_state.")  # beginnings of the names of what sensors remember
_ADVICE = (
    "Terms and the state of a task may not copy from the processor or wait for it (brainbench.core.rotations.constant "
    "keeps constants on the device); change them, or make the environment with graphs=False."
)


def make(
    name: str | Task, *, hand: str | os.PathLike[str] | hands.Hand = "xhand1", config: str = "default", **options: Any
) -> Env:
    """Return the batched environment of a task.

    Args:
        name: of a task (:func:`robotics_bridge.tasks.list_tasks`), or a :class:`~robotics_bridge.tasks.Task`.
        hand: a hand, its name, or the path of a URDF or MJCF file.
        config: configuration of a named task: ``default`` or ``published``.
        **options: fields of :class:`~robotics_bridge.envs.EnvOptions`: ``num_envs``, ``device``, ``observe``, …

    Example::

        env = tasks.make("in_palm_rotate", num_envs=16, observe="force_torque")
        observations = env.reset()
        observations, reward, terminated, truncated, info = env.step(torch.zeros(16, env.num_actions))
    """
    task = name if isinstance(name, Task) else load(name, config)
    return Env(task, hand if isinstance(hand, hands.Hand) else hands.load(hand), EnvOptions(**options))


class Env:
    """A batch of environments; environments that end are reset within the same step."""

    def __init__(self, task: Task, hand: hands.Hand, options: EnvOptions | None = None) -> None:
        options = options or EnvOptions()
        self.task, self.hand, self.options = task, hand, options
        self.state = state = EnvState(task, hand, options)
        """All that steps read and change."""
        self.model, self.simulation, self.goals, self.touch = state.model, state.simulation, state.goals, state.touch
        self.device: torch.device = state.device
        self.num_envs, self.decimation, self.step_dt = options.num_envs, state.substeps, state.step_dt
        self.max_episode_length = task.max_episode_length
        self.joint_names, self.action_names = state.model.joints, state.model.moved
        """Driven joints J, and those A that actions move."""
        self.num_actions = len(self.action_names)
        self.reset_episodes = EpisodeReset(state)
        self.apply_action: Callable[[EnvState], None] = apply_action
        """First part of a control step; replayed as a CUDA graph once it is recorded."""
        self.compute_step: Callable[[EnvState, EpisodeReset], StepResult] = compute_step
        """Last part of a control step; the same holds."""
        if self.device.type == "cuda" and options.graphs is not False:
            generators = [state.generator]
            recorder = warp_recorder(self.simulation.warp_device, generators)
            self.apply_action, self.compute_step = (
                CudaGraphStep(
                    part, recorder, subject="The control step", advice=_ADVICE, generators=generators,
                    retained=self.lasting, required=bool(options.graphs),
                )
                for part in (apply_action, compute_step)
            )  # fmt: skip
        self.reset()
        self.observation_shapes = {name: tuple(value.shape[1:]) for name, value in self.observations.items()}
        """Group → shape per environment."""

    @property
    def action_map(self) -> ActionMap:
        """The map from actions to joint targets."""
        columns = [self.model.joints.index(name) for name in self.model.moved]
        low, high = self.model.low[columns], self.model.high[columns]
        rows = (self.model.rest[columns], self.task.action_ratio * (high - low), low, high)
        return ActionMap(self.model.moved, *(tuple(row.tolist()) for row in rows))

    @property
    def frozen(self) -> dict[str, float]:
        """Joint → position (rad) of joints that actions do not move."""
        rest = zip(self.model.joints, self.model.rest.tolist(), strict=True)
        return {name: value for name, value in rest if name not in self.model.moved}

    @property
    def observations(self) -> dict[str, torch.Tensor]:
        """Observations [B, …] of the last step or reset, by group."""
        return self.state.observations

    @property
    def link_pose(self) -> torch.Tensor:
        """Poses [B, L, 7] of the tactile links in the palm's frame (x y z, qw qx qy qz)."""
        return self.state.link_pose

    @property
    def object_pose(self) -> torch.Tensor:
        """Poses [B, K, 7] of the objects (x y z, qw qx qy qz)."""
        return self.state.object_pose

    @property
    def lasting(self) -> list[torch.Tensor]:
        """Observations [B, …] that are the same tensors after every step."""
        return [self.state.extent] if self.touch is None else [self.state.extent, self.touch.reading]

    @property
    def recorded(self) -> bool:
        """True once the parts of a control step around physics are replayed as CUDA graphs."""
        return isinstance(self.compute_step, CudaGraphStep) and self.compute_step.recorded

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps [B] by which episodes end; learners write to it to start episodes at random ages."""
        return self.state.episode.age

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        if value.shape != self.state.episode.age.shape:
            raise UsageError(f"Steps by environment have the shape ({self.num_envs},); received {tuple(value.shape)}.")
        if value is not self.state.episode.age:
            self.state.episode.age.copy_(value)

    def reset(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Start new episodes in some environments ([B] bool; all by default) and return the observations."""
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        elif mask.shape != (self.num_envs,) or mask.dtype != torch.bool:
            raise UsageError(
                f"A mask is a torch tensor with one bool per environment ({self.num_envs}); received "
                f"{tuple(mask.shape)} of {mask.dtype}."
            )
        self.reset_episodes(self.state, mask)
        self.state.observations = observe(self.state)
        return self.observations

    def step(self, action: torch.Tensor) -> StepResult:
        """Advance all environments by one control step.

        Args:
            action: [B, A]; 0 is the rest position, 1 is ``task.action_ratio`` of the joint's range from it. Beyond
                ``task.action_limit`` it counts as that limit.

        Returns:
            Observations by group (the next step overwrites ``tactile``), reward [B], terminated [B] and truncated [B]
            (bool), and a dictionary with ``time_outs`` (truncated), ``diverged`` [B], of ended episodes ``success``
            (none that diverged), ``dropped`` (by an ending that is not the last goal), ``metric``, ``return``,
            ``steps``, ``goals`` reached and ``turned`` [B] (rotation about the commanded axis while anything touched
            the object, rad), and ``final_observations`` if asked for.
        """
        check_kind("action", action, torch.Tensor, "a torch tensor [environments, joints moved]")
        if tuple(action.shape) != (self.num_envs, self.num_actions):
            raise UsageError(
                f"Actions have the shape {(self.num_envs, self.num_actions)} (environments, joints moved); "
                f"received {tuple(action.shape)}."
            )
        episode, limit = self.state.episode, self.task.action_limit
        episode.last_action.copy_(episode.action)
        episode.action.copy_(action.detach() if limit is None else action.detach().clamp(-limit, limit))
        self.apply_action(self.state)
        run_physics(self.state)
        result = self.compute_step(self.state, self.reset_episodes)
        self.state.observations = result[0]
        return result

    def seed(self, seed: int) -> None:
        """Begin the random numbers anew, from the next reset on, those of tactile noise included."""
        check_number("seed", seed, least=0, below=2**63, whole=True)
        if self.touch is not None:
            self.touch.suite.seed(seed)
        self.state.generator.manual_seed(seed)
        self.state.actuators.seed(seed)
        # Friction and mass that are drawn once belong to the seed, not to what ran before it.
        self.state.started = False

    def statistics(self) -> dict[str, float]:
        """Return means over the episodes that ended since the last call; waits for the device."""
        episodes, *sums = self.state.episode.totals.tolist()
        self.state.episode.totals.zero_()
        names = (*STATISTICS, *(f"reward/{name}" for name in self.task.rewards))
        means = [value / episodes if episodes else float("nan") for value in sums]
        return {"episodes": episodes, **dict(zip(names, means, strict=True))}

    def _memory(self) -> dict[str, torch.Tensor]:
        """Return by name what :meth:`state_dict` copies."""
        state = self.state
        tensors = {**state.memory(), "generator": state.generator.get_state()}
        if self.touch is not None:
            tensors[_NOISE_SEED] = torch.tensor(self.touch.suite.context.seed)
        return tensors | {f"observations.{name}": value for name, value in state.observations.items()}

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return copies of all that the future depends on."""
        return {name: value.clone() for name, value in self._memory().items()}

    def load_state_dict(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take up what :meth:`state_dict` returned."""
        state = self.state
        for name, present in self._memory().items():
            # Sensors that an earlier version stored nothing of begin anew.
            if name.startswith(_SENSED) and name not in values:
                continue
            if name not in values or (name != "generator" and values[name].shape != present.shape):
                shape = tuple(values[name].shape) if name in values else "none"
                raise UsageError(
                    f"This is the state of other environments: {name!r} has the shape {tuple(present.shape)} here; "
                    f"received {shape}. Make the environments as those were."
                )

        def _under(part: str) -> dict[str, torch.Tensor]:
            return {name.removeprefix(part): value for name, value in values.items() if name.startswith(part)}

        if self.touch is not None and _NOISE_SEED in values:
            self.touch.suite.seed(int(values[_NOISE_SEED]))
        for name, value in state.memory().items():
            value.copy_(values.get(name, value))
        state.generator.set_state(values["generator"].cpu())
        state.simulation.restored(_under("simulation."))
        state.started = True
        state.observations = {name: value.to(state.device) for name, value in _under("observations.").items()}


class RslRlEnv:
    """The environment as rsl_rl's runners and algorithms call it, without a state of its own.

    RND reads ``env.unwrapped.step_dt``, so ``unwrapped`` is the native environment.
    """

    def __init__(self, env: Env) -> None:
        with needing("tensordict", extra="policies", purpose="Learning with rsl_rl"):
            import tensordict  # noqa: F401
        self.unwrapped = env
        """The native environment."""
        self.num_envs, self.num_actions, self.device = env.num_envs, env.num_actions, env.device
        self.max_episode_length = env.max_episode_length
        self.cfg: dict[str, Any] = {"task": env.task.name, "hand": env.hand.name, "observe": env.options.observe}
        """Facts that rsl_rl's logger keeps."""

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps [B] of the running episodes."""
        return self.unwrapped.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        # rsl_rl assigns a new tensor to start episodes at random ages.
        self.unwrapped.episode_length_buf = value

    def get_observations(self) -> TensorDict:
        """Return the present observations, group → [B, ...]."""
        from tensordict import TensorDict

        groups = {name: value.clone() for name, value in self.unwrapped.observations.items()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)  # type: ignore[arg-type]

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance; returns observations, reward [B], done [B] and ``time_outs``, ``log``, ``info``."""
        _, reward, terminated, truncated, info = self.unwrapped.step(actions)
        extras = {"time_outs": truncated, "log": info["log"], "info": info}
        return self.get_observations(), reward, terminated | truncated, extras
