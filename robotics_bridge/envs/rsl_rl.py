"""Adapter to rsl_rl's ``VecEnv``: observations as a TensorDict of the groups of table 4.7."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from brainbench.core.errors import needing

if TYPE_CHECKING:
    from tensordict import TensorDict

    from robotics_bridge.envs.env import Env


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

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Start new episodes everywhere (rsl_rl itself never calls this)."""
        self.unwrapped.reset()
        return self.get_observations(), {}
