"""The memory of an environment batch as named tensors, so that a saved batch goes on exactly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from brainbench.core.devices import warp

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.state import EnvState

FORMER_NAMES = {
    "episode_length_buf": "age", "_steps": "steps", "_return": "returns", "_push_left": "push_left",
    "_start_joints": "start_joints", "_start_position": "start_position", "_home": "rest_targets",
    "_sums": "reward_sums", "_totals": "totals",
    "world": "simulation", "drives": "actuators", "watch": "task_state",
}  # fmt: skip
"""Names of tensors and parts in states that were saved before version 0.1."""


def save_state(state: EnvState) -> dict[str, torch.Tensor]:
    """Return copies of all memory of an environment batch, but for that of noisy or slow tactile sensors."""
    own = {name: value.clone() for name, value in state.episode.tensors().items()}
    own["generator"] = state.generator.get_state()
    for part, source in _parts(state).items():
        own |= {f"{part}.{name}": value for name, value in source.state_dict().items()}
    own |= {f"touch.{name}": value.clone() for name, value in _touch(state).items()}
    return own | {f"observations.{name}": value.clone() for name, value in state.observations.items()}


def load_state(state: EnvState, values: Mapping[str, torch.Tensor]) -> None:
    """Put an environment batch where :func:`save_state` found one."""
    found: dict[str, dict[str, torch.Tensor]] = {"": {}}
    for key, value in values.items():
        part, dot, name = key.partition(".")
        part = FORMER_NAMES.get(part, part)
        found.setdefault(part if dot else "", {})[name if dot else part] = value
    for name, value in state.episode.tensors().items():
        value.copy_(found[""][name])
    state.generator.set_state(found[""]["generator"].cpu())
    for part, source in _parts(state).items():
        source.load_state_dict(found[part])
    for name, value in _touch(state).items():
        value.copy_(found["touch"][name])
    state.started = True
    state.observations = {name: value.to(state.device) for name, value in found["observations"].items()}


def _parts(state: EnvState) -> dict[str, Any]:
    parts: dict[str, Any] = {
        "simulation": state.simulation, "actuators": state.actuators, "goals": state.goals, "contacts": state.contacts,
    }  # fmt: skip
    return parts if state.task_state is None else {**parts, "task_state": state.task_state}


def _touch(state: EnvState) -> dict[str, torch.Tensor]:
    if state.touch is None:
        return {}
    clock, wp = state.touch.suite.clock, warp()
    return {"reading": state.touch.reading, "age": wp.to_torch(clock.age), "episode": wp.to_torch(clock.episode)}
