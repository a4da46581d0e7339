"""The memory of an environment batch as named tensors, so that a saved batch goes on exactly."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from brainbench.core.devices import warp
from robotics_bridge.envs.state import EnvState


def save_state(state: EnvState) -> dict[str, torch.Tensor]:
    """Return copies of all memory of an environment batch, but for that of noisy or slow tactile sensors."""
    own = {name: value.clone() for name, value in _memory(state).items()}
    own["generator"] = state.generator.get_state()
    own |= {f"simulation.{name}": value for name, value in state.simulation.state_dict().items()}
    return own | {f"observations.{name}": value.clone() for name, value in state.observations.items()}


def load_state(state: EnvState, values: Mapping[str, torch.Tensor]) -> None:
    """Put an environment batch where :func:`save_state` found one."""

    def under(part: str) -> dict[str, torch.Tensor]:
        return {name.removeprefix(part): value for name, value in values.items() if name.startswith(part)}

    for name, value in _memory(state).items():
        value.copy_(values[name])
    state.generator.set_state(values["generator"].cpu())
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
