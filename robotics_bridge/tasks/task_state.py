"""A part of a task that keeps a state of its own, such as thermometers and what they showed so far."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import torch

    from robotics_bridge.hands import Hand
    from robotics_bridge.tasks.scenes import TaskModel
    from robotics_bridge.tasks.step_context import StepContext


class EpisodeTarget(Protocol):
    """The part of the running episodes that a task's own state may choose."""

    target: torch.Tensor
    """[B] number of the object that counts; written in place."""


class TaskEnvironment(Protocol):
    """The environments that run a task, as its own state sees them. Letters: B environment, K object."""

    num_envs: int
    """B."""
    device: torch.device
    hand: Hand
    model: TaskModel
    simulation: Any
    """The physics: ``engine.scene``, ``state`` (a ``HandState``), ``pose`` of links, ``warp_device``."""
    contacts: Any
    """``tip_links``: numbers [F] of the links of finger tips."""

    @property
    def episode(self) -> EpisodeTarget:
        """Memory of the running episodes."""
        ...

    @property
    def target_pose(self) -> torch.Tensor:
        """Pose [B, 7] of the object that counts (x y z, qw qx qy qz)."""
        ...

    def draw(self, count: int, low: float, high: float) -> torch.Tensor:
        """Return uniform random numbers [B, count]."""
        ...


class TaskState(Protocol):
    """Made by ``task.task_state(environment)`` once; B environments."""

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes where the mask [B] is set."""
        ...

    def after_physics_step(self, dt: float) -> None:
        """Take in the state after a physics step of duration dt (s)."""
        ...

    def after_control_step(self, context: StepContext) -> None:
        """Add to what reward terms see at the end of a control step."""
        ...

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
        ...
