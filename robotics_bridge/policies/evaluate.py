"""Evaluation of an agent: whole episodes from fresh starts, with intervals. Letters: B environment, A action."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_name, listing, repeats
from brainbench.core.progress import Progress, track
from brainbench.core.statistics import wilson_interval
from robotics_bridge.envs.env import Env
from robotics_bridge.policies.shipped import AGENTS

_log = logging.getLogger(__name__)

Acting = Callable[[Mapping[str, torch.Tensor]], torch.Tensor]  # observations by group → actions [B, A]
QUANTITIES = ("metric", "returns", "lengths", "goals", "turn_rate", "seconds", "dropped")
"""Quantities of each episode beside its success."""
_Z = 1.959964  # normal quantile of a 95 % interval: episodes are many


@dataclass(frozen=True)
class PolicyEvaluation:
    """Episodes of one agent. The episodes of one evaluation are independent given the agent."""

    agent: str
    task: str
    seeds: tuple[int, ...]
    success: tuple[bool, ...]
    """Success of each episode; one that diverged has none, whatever it reached before."""
    metric: tuple[float, ...]
    """Success metric of each episode: goals reached, rotation (rad) or seconds of contact."""
    returns: tuple[float, ...]
    """Undiscounted reward of each episode."""
    lengths: tuple[int, ...]
    """Control steps of each episode."""
    diverged: int
    """Episodes that ended because the physics diverged."""
    per_seed: tuple[float, ...]
    """Success rate of each seed."""
    goals: tuple[float, ...] = ()
    """Goals reached in each episode."""
    turn_rate: tuple[float, ...] = ()
    """Mean rate of each episode about the commanded axis (rad/s), counted while anything touched the object."""
    seconds: tuple[float, ...] = ()
    """Duration of each episode: until the object was dropped, or the longest there is."""
    dropped: tuple[bool, ...] = ()
    """True where an ending of the task (not time, divergence or the last goal) ended the episode."""
    objects: tuple[str, ...] = ()
    """Name of the object of each episode."""

    @property
    def success_rate(self) -> float:
        """Share of episodes that succeeded."""
        return sum(self.success) / len(self.success)

    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the success rate."""
        interval = wilson_interval(sum(self.success), len(self.success), over="episodes")
        return interval.low, interval.high

    def mean(self, name: str) -> tuple[float, float]:
        """Return mean and half width of its 95 % interval over episodes of one of :data:`QUANTITIES`."""
        check_name("quantity of an episode", name, QUANTITIES)
        return mean_of_episodes(getattr(self, name))

    def summary(self) -> dict[str, Any]:
        """Return what reports print, as plain numbers."""
        low, high = self.interval()
        facts: dict[str, Any] = {"agent": self.agent, "task": self.task, "episodes": len(self.success)}
        facts |= {"seeds": list(self.seeds), "success_rate": self.success_rate, "success_interval": [low, high]}
        facts |= {"success_per_seed": list(self.per_seed), "diverged": self.diverged}
        for name in (name for name in QUANTITIES if getattr(self, name)):
            facts[name], facts[f"{name}_half_width"] = self.mean(name)
        if self.objects:
            facts["objects"] = {name: self._of(name) for name in sorted(set(self.objects))}
        return facts

    def _of(self, name: str) -> dict[str, float]:
        """Return what :meth:`summary` says of the episodes with one object."""
        rows = [index for index, other in enumerate(self.objects) if other == name]
        quantities = {"success_rate": self.success, "goals": self.goals, "dropped": self.dropped}
        means = {key: sum(values[row] for row in rows) / len(rows) for key, values in quantities.items()}
        return {"episodes": len(rows), **means}


def mean_of_episodes(values: ArrayLike) -> tuple[float, float]:
    """Return the mean of a quantity of episodes [n], and the half width of its 95 % interval (NaN for one episode)."""
    array = np.asarray(values, dtype=float)
    spread = array.std(ddof=1) if len(array) > 1 else math.nan
    return float(array.mean()), float(_Z * spread / math.sqrt(len(array)))


class Policy:
    """A trained teacher or student (a module with ``reset``) that acts on observation groups and may remember."""

    def __init__(self, actor: torch.nn.Module) -> None:
        self.actor: Any = actor.eval()
        self.actor.reset()

    def __call__(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the mean actions [B, A]."""
        with torch.inference_mode():
            return self.actor(observations)

    def reset(self, dones: torch.Tensor | None = None) -> None:
        """Forget the past of all environments, or of those [B] that are done."""
        self.actor.reset(dones)


def agent(name: str, env: Env, *, seed: int = 0) -> Acting:
    """Return the agent ``zero`` (rest position) or ``random`` (standard normal actions, as an untrained policy)."""
    check_name("agent", name, AGENTS)
    generator = torch.Generator(device=env.device)
    generator.manual_seed(seed)
    still = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    if name == "zero":
        return lambda _: still
    return lambda _: torch.randn(still.shape, generator=generator, device=env.device)


def forget(policy: Acting, where: torch.Tensor) -> None:
    """Let a policy that remembers begin anew in the environments of a mask [B] bool; others have nothing to forget."""
    if (reset := getattr(policy, "reset", None)) is not None:
        reset(where)


def evaluate(
    env: Env, policy: Acting, *, episodes: int = 100, seed: int | Sequence[int] = (0, 1, 2), name: str = "policy",
    progress: Progress | None = None,
) -> PolicyEvaluation:  # fmt: skip
    """Run whole episodes and return how they went.

    Each environment contributes equally many episodes, so that short ones are not counted more often.

    Args:
        policy: its ``reset(mask)``, if any, is called when episodes end.
        episodes: at least so many for every seed of the environments.
        seed: several are run one after the other.
        progress: called with seeds done, seeds and a word.
    """
    seeds = (seed,) if isinstance(seed, int) else tuple(seed)
    if episodes < 1 or not seeds:
        raise UsageError(f"An evaluation needs at least one episode and one seed; received {episodes} and {seeds}.")
    if twice := repeats(seeds):
        raise UsageError(f"The seed {twice[0]} stands there twice; its episodes would count twice in the interval.")
    shapes, held = env.model.shapes, set(env.state.shape_of.tolist())
    if missing := [shape.name for number, shape in enumerate(shapes) if number not in held]:
        _log.warning(
            "%d environments hold %d of the %d objects of the task, and success is that with these alone; there is no "
            "%s. Take at least %d environments.",
            env.num_envs, len(held), len(shapes), listing(missing, limit=3), len(shapes),
        )  # fmt: skip
    each = math.ceil(episodes / env.num_envs)
    rows: list[list[Any]] = []
    rates = []
    for number in track(seeds, f"evaluating {name}", progress):
        env.seed(number)
        observations = env.reset()
        forget(policy, torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        left = torch.full((env.num_envs,), each, device=env.device)
        ended: list[list[Any]] = []
        # Whoever is done waits for the slowest, so the device is asked once a step.
        while bool((left > 0).any()):
            observations, _, terminated, truncated, info = env.step(policy(observations))
            done = terminated | truncated
            forget(policy, done)
            names = ("success", "metric", "return", "steps", "diverged", "goals", "turned", "dropped")
            columns = [info[name].float() for name in names]
            table = torch.stack((*columns, env.state.shape_of.float()), dim=1)
            ended += table[done & (left > 0)].tolist()
            # Episodes beyond an environment's share are not counted: fast failures would otherwise be counted more
            # often.
            left -= done.long()
        rates.append(sum(row[0] for row in ended) / len(ended))
        rows += ended
    success, metric, returns, lengths, diverged, goals, turned, dropped, placed = zip(*rows, strict=True)
    seconds = tuple(n * env.step_dt for n in lengths)
    return PolicyEvaluation(
        agent=name, task=env.task.name, seeds=seeds, success=tuple(map(bool, success)), metric=metric,
        returns=returns, lengths=tuple(int(n) for n in lengths), diverged=int(sum(diverged)),
        per_seed=tuple(rates), goals=goals, seconds=seconds, dropped=tuple(map(bool, dropped)),
        turn_rate=tuple(angle / time for angle, time in zip(turned, seconds, strict=True)),
        objects=tuple(shapes[int(shape)].name for shape in placed),
    )  # fmt: skip
