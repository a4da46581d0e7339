"""A part of a task that keeps a state of its own, such as thermometers and what they showed so far."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import torch

    from robotics_bridge.tasks.step_context import StepContext


class TaskState(Protocol):
    """Made once by ``task.task_state(state)``, given the ``EnvState`` of B environments.

    It reads there poses and contacts, and may write ``episode.target`` [B], the number of the object that counts.
    """

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes where the mask [B] is set."""

    def after_physics_step(self, dt: float) -> None:
        """Take in the state after a physics step of duration dt (s)."""

    def after_control_step(self, context: StepContext) -> None:
        """Add to what reward terms see at the end of a control step."""

    def metric(self) -> torch.Tensor:
        """Return the success metric [B] of the episode so far."""
        ...

    def observe(self, group: str) -> torch.Tensor:
        """Return an observation group [B, ...] that the task adds."""
        ...

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that the future depends on, by name."""
        ...

    def restored(self) -> None:
        """Take note that other values were written to :meth:`memory`."""
