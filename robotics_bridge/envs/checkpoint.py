"""The memory of an environment batch as named tensors, so that a saved batch goes on exactly."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from brainbench.core.devices import warp
from robotics_bridge.envs.state import EnvState

FORMER_NAMES = {
    "episode_length_buf": "age", "_steps": "steps", "_return": "returns", "_push_left": "push_left",
    "_start_joints": "start_joints", "_start_position": "start_position", "_home": "rest_targets",
    "_sums": "reward_sums", "_totals": "totals",
    "world": "simulation", "drives": "actuators", "watch": "task_state",
}  # fmt: skip
"""Names of tensors and parts in states that were saved before version 0.1."""


_LATER = ("goals.turned_held",)
"""Tensors that states lack which were saved before they were counted."""


def save_state(state: EnvState) -> dict[str, torch.Tensor]:
    """Return copies of all memory of an environment batch, but for that of noisy or slow tactile sensors."""
    own = {name: value.clone() for name, value in _memory(state).items()}
    own["generator"] = state.generator.get_state()
    own |= {f"simulation.{name}": value for name, value in state.simulation.state_dict().items()}
    return own | {f"observations.{name}": value.clone() for name, value in state.observations.items()}


def load_state(state: EnvState, values: Mapping[str, torch.Tensor]) -> None:
    """Put an environment batch where :func:`save_state` found one."""
    found = {}
    for key, value in values.items():
        part, dot, name = key.partition(".")
        found[f"{FORMER_NAMES.get(part, part)}{dot}{name}"] = value

    def under(part: str) -> dict[str, torch.Tensor]:
        return {name.removeprefix(part): value for name, value in found.items() if name.startswith(part)}

    for name, value in _memory(state).items():
        value.copy_(found.get(name, value) if name in _LATER else found[name])
    state.generator.set_state(found["generator"].cpu())
    state.simulation.load_state_dict(under("simulation."))
    if state.task_state is not None:
        state.task_state.restored()
    state.started = True
    state.observations = {name: value.to(state.device) for name, value in under("observations.").items()}


def _memory(state: EnvState) -> dict[str, torch.Tensor]:
    """Return the tensors themselves of all parts but the physics."""
    parts = {"actuators": state.actuators, "goals": state.goals, "contacts": state.contacts}
    if state.task_state is not None:
        parts["task_state"] = state.task_state
    found = state.episode.tensors()
    found |= {f"{part}.{name}": value for part, owner in parts.items() for name, value in owner.memory().items()}
    if state.touch is not None:
        clock, wp = state.touch.suite.clock, warp()
        found |= {"touch.age": wp.to_torch(clock.age), "touch.episode": wp.to_torch(clock.episode)}
        found["touch.reading"] = state.touch.reading
    return found
