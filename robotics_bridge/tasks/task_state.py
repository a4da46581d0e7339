"""A part of a task that keeps a state of its own, such as thermometers and what they showed so far."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import torch

    from robotics_bridge.tasks.step_context import StepContext


class TaskState(Protocol):
    """Made by ``task.watch(env)`` once; B environments."""

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes where the mask [B] is set."""
        ...

    def during(self, dt: float) -> None:
        """Look at the state after a physics step of duration dt (s)."""
        ...

    def after(self, moment: StepContext) -> None:
        """Add to the moment at the end of a control step."""
        ...

    def metric(self) -> torch.Tensor:
        """Return the success metric [B] of the episode so far."""
        ...

    def observe(self, group: str) -> torch.Tensor:
        """Return an observation group [B, ...] that the task adds."""
        ...

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return all memory."""
        ...

    def load_state_dict(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take up what :meth:`state_dict` returned."""
        ...
