"""A world small enough to know the right answer, since touch alone tells where to go; small worlds of shipped tasks."""

from __future__ import annotations

from dataclasses import make_dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch

from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.envs.step import ActionMap
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.encoders.arms import EncoderConfig
from robotics_bridge.tasks.settings import ContactModel
from robotics_bridge.tasks.task import ObjectRandomisation


class TouchWorld:
    """Two joints must follow an aim that a touch on two taxels shows; episodes last 8 steps."""

    def __init__(self, num_envs: int = 16, *, observe: str = "force_torque", seed: int = 0) -> None:
        self.num_envs, self.num_actions, self.device = num_envs, 2, torch.device("cpu")
        self.step_dt, self.decimation, self.max_episode_length = 0.025, 5, 8
        self.joint_names, self.frozen = ("a", "b"), {"c": 0.5}
        self.action_map = ActionMap(("a", "b"), (0.0, 0.0), (1.0, 1.0), (-1.0, -1.0), (1.0, 1.0))
        self.hand = SimpleNamespace(physics=None)
        self.touch: Any = None
        if observation_type(observe).sensor is not None:
            self.touch = SimpleNamespace(links=tuple(f"tip{i}" for i in range(5)))
        student = ("proprio", "goal", "tactile") if self.touch else ("proprio", "goal")
        facts: dict[str, Any] = {
            "groups": {"student": student},
            "taxel_twist": None,
            "action_limit": None,
            "starts": None,
            "command": ("on",),
            "contacts": ContactModel(),
            "decoders": (SimpleNamespace(target="aux_aim", weight=0.5, scale=2.0, hidden=(16,)),),
            "student": SimpleNamespace(
                iterations=4, learning_rate=1e-3, epochs=2, gradient_length=2, clip=None, max_grad_norm=None, loss="mse"
            ),
        }
        self.task: Any = make_dataclass("Task", facts)(**facts)
        if self.touch:
            config = EncoderConfig(placement="tips", resolution="low", observe=observe, name="mlp")
            self.shape = config.build().shape
        self.generator = torch.Generator().manual_seed(seed)
        self.place, self.aim = torch.zeros(num_envs, 2), torch.zeros(num_envs, 2)
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.observations = self.reset()
        self.observation_shapes = {name: tuple(value.shape[1:]) for name, value in self.observations.items()}

    def reset(self, mask: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        chosen = torch.ones(self.num_envs, dtype=torch.bool) if mask is None else mask
        fresh = torch.randn(self.num_envs, 2, generator=self.generator)
        self.aim[chosen], self.place[chosen] = fresh[chosen], 0.0
        self.episode_length_buf[chosen] = 0
        self.observations = self._observe()
        return self.observations

    def _observe(self) -> dict[str, torch.Tensor]:
        found = {"proprio": self.place.clone(), "goal": torch.ones(self.num_envs, 1), "aux_aim": self.aim.clone()}
        if self.touch:
            touch = torch.zeros(self.num_envs, *self.shape)
            touch[:, :, 3, 0], touch[:, :, 20, 0] = 0.2 * self.aim[:, :1], 0.2 * self.aim[:, 1:]
            found["tactile"] = touch
        return found

    def step(self, action: torch.Tensor):
        self.place = self.place + 0.2 * action
        self.episode_length_buf += 1
        over = self.episode_length_buf >= self.max_episode_length
        self.reset(over)
        reward = -(self.place - self.aim).norm(dim=1)
        return self.observations, reward, torch.zeros_like(over), over, {"log": {}}

    def statistics(self) -> dict[str, float]:
        return {"episodes": 1.0, "success": 0.5}

    def state_dict(self) -> dict[str, torch.Tensor]:
        own = {
            "place": self.place,
            "aim": self.aim,
            "episode_length_buf": self.episode_length_buf,
            "generator": self.generator.get_state(),
        }
        own |= {f"observations.{name}": value for name, value in self.observations.items()}
        return {name: value.clone() for name, value in own.items()}

    def load_state_dict(self, values: dict[str, torch.Tensor]) -> None:
        for name in ("place", "aim", "episode_length_buf"):
            setattr(self, name, values[name].clone())
        self.generator.set_state(values["generator"])
        start = "observations."
        self.observations = {k.removeprefix(start): v.clone() for k, v in values.items() if k.startswith(start)}


class Follower:
    """The teacher of the world above: it sees the aim."""

    def __call__(self, obs) -> torch.Tensor:
        return obs["aux_aim"] - obs["proprio"]


def make_env(num_envs: int = 4, task: Any = "in_palm_rotate", **options: Any) -> Env:
    """Return a few environments of a task."""
    return tasks.make(task, num_envs=num_envs, threads=1, **options)


def random_actions(env: Env, count: int, seed: int = 0) -> list[torch.Tensor]:
    """Return so many actions of normal numbers."""
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(env.num_envs, env.num_actions, generator=g) for _ in range(count)]


def calm_task(**changes: Any) -> Any:
    """Return the rotation task without anything random but where the object lies."""
    still = {"actuators": None, "push": None, "object_changes": ObjectRandomisation()}
    return replace(tasks.load("in_palm_rotate", "published"), **(still | changes))
