"""Adapters to gymnasium: ``make_vec("brainbench/InPalmRotate-v0", num_envs=8)``, and ``make`` for a single one.

Autoreset mode of vectors is SAME_STEP: an episode that ends is followed by the first observation of the next one in
the same call, with the last observation in ``info["final_obs"]``. Importing this module registers the ids.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from brainbench.core.errors import UsageError, check_each, needing
from robotics_bridge import tasks
from robotics_bridge.envs.env import Env
from robotics_bridge.tasks.task import ACTION_LIMIT, MEASURED, check_measured

with needing("gymnasium", extra="policies", purpose="The gymnasium adapter"):
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv


IDS = {
    "brainbench/InPalmRotate-v0": "in_palm_rotate",
    "brainbench/InHandRepose-v0": "in_hand_repose",
    "brainbench/Screwdriver-v0": "screwdriver",
    "brainbench/HotBall-v0": "hot_ball",
}
"""Registered id → task."""


class GymVectorEnv(VectorEnv):
    """The environments of a task as numpy arrays; observations are a dictionary of groups, by default what a hand has.

    ``privileged`` groups of the simulation are given to who asks for them, such as a teacher.
    """

    def __init__(self, env: Env, groups: tuple[str, ...] = (), *, privileged: bool = False) -> None:
        if not env.options.keep_final:
            raise UsageError("Gymnasium needs the last observations of episodes: tasks.make(..., keep_final=True).")
        check_each("observation group of the task", groups, env.observation_shapes)
        if not privileged:
            check_measured(groups, "Without privileged=True, a policy in gymnasium")
        self.native = env
        """The native environment."""
        self.num_envs = env.num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        measured = (name for name in env.observation_shapes if privileged or name in MEASURED)
        self._groups = groups or tuple(measured)
        shapes, box = env.observation_shapes, gymnasium.spaces.Box
        spaces: Any = {name: box(-np.inf, np.inf, shapes[name], np.float32) for name in self._groups}
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.single_action_space = box(-ACTION_LIMIT, ACTION_LIMIT, (env.num_actions,), np.float32)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start new episodes, some with ``options={"reset_mask": [B] bool}``."""
        super().reset(seed=None)
        if isinstance(seed, list):
            raise UsageError("Environments draw their random numbers together: give one seed, not a list.")
        if seed is not None:
            self.native.seed(seed)
        check_each("option of a reset", options or (), ("reset_mask",))
        mask = (options or {}).get("reset_mask")
        chosen = None if mask is None else torch.as_tensor(np.asarray(mask, dtype=bool), device=self.native.device)
        return self._numpy(self.native.reset(chosen)), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance by one control step with actions [B, A]."""
        tensor = torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.native.device)
        observations, reward, terminated, truncated, info = self.native.step(tensor)
        ended = (terminated | truncated).cpu().numpy()
        facts: dict[str, Any] = {"diverged": info["diverged"].cpu().numpy()}
        if ended.any():
            final = self._numpy(info["final_observations"])
            rows = np.empty(self.num_envs, dtype=object)
            for index in np.flatnonzero(ended):
                rows[index] = {name: value[index] for name, value in final.items()}
            facts |= {"final_obs": rows, "_final_obs": ended}
            metric = {"metric": info["metric"].cpu().numpy(), "return": info["return"].cpu().numpy()}
            facts |= {"final_info": metric, "_final_info": ended}
        ends = (terminated.cpu().numpy(), truncated.cpu().numpy())
        return self._numpy(observations), reward.cpu().numpy().astype(np.float64), *ends, facts

    def _numpy(self, observations: dict[str, Any]) -> dict[str, np.ndarray]:
        return {name: observations[name].detach().cpu().numpy().copy() for name in self._groups}


class GymEnv(gymnasium.Env):
    """The one environment of a vector (else UsageError); the user resets it when an episode has ended."""

    def __init__(self, vector: GymVectorEnv) -> None:
        if vector.num_envs != 1:
            raise UsageError(f"A single environment has num_envs=1; received {vector.num_envs}. Use make_vec for more.")
        self.vector = vector
        self.metadata = {"render_modes": []}
        self.observation_space, self.action_space = vector.single_observation_space, vector.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start a new episode; return its observations by group, without an axis of environments."""
        super().reset(seed=seed)
        observations, _ = self.vector.reset(seed=seed, options=options)
        return {name: value[0] for name, value in observations.items()}, {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Advance by one control step with an action [A].

        The last observation of an episode is its own; ``info`` has ``diverged``, at the end ``metric`` and ``return``.
        """
        batch, reward, terminated, truncated, facts = self.vector.step(np.asarray(action)[None])
        info: dict[str, Any] = {"diverged": bool(facts["diverged"][0])}
        observations = {name: value[0] for name, value in batch.items()}
        if "final_obs" in facts:
            observations = facts["final_obs"][0]
            info |= {name: float(value[0]) for name, value in facts["final_info"].items()}
        return observations, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


def make(task: str, **options: Any) -> GymEnv:
    """Return one environment of a task for gymnasium; options as for :func:`make_vec`."""
    return GymEnv(make_vec(task, 1, **options))


def make_vec(
    task: str,
    num_envs: int = 1,
    *,
    touch: str = "center_of_pressure",
    groups: tuple[str, ...] = (),
    privileged: bool = False,
    **options: Any,
) -> GymVectorEnv:
    """Return the environments of a task for gymnasium.

    Args:
        task: Name of a task.
        num_envs: Environments.
        touch: Type of the observation ``tactile``, such as ``force_torque``; ``none``: the hand feels nothing.
        groups: Observation groups, by default all that a hand has.
        privileged: Give groups that only the simulation knows, too.
        **options: Those of :func:`robotics_bridge.tasks.make`.
    """
    native = tasks.make(task, num_envs=num_envs, keep_final=True, **{"observe": touch, **options})
    return GymVectorEnv(native, groups, privileged=privileged)


def register() -> None:
    """Register the ids :data:`IDS` with gymnasium; doing so again changes nothing."""
    for name, task in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point="robotics_bridge.envs.gymnasium:make",
                vector_entry_point="robotics_bridge.envs.gymnasium:make_vec",
                kwargs={"task": task},
            )


register()
