"""A control step as reward terms see it, and a part of a task that keeps a state of its own over the steps.

Such a part are thermometers and what they showed so far. Letters: B environment, J joint, A action, F finger tip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import torch

    from robotics_bridge.hands import Hand


@dataclass(eq=False)
class StepContext:
    """Tensors at the end of a control step, before any environment is reset. World axes, SI units."""

    dt: float
    """Duration of a control step (s)."""
    joint_names: tuple[str, ...]
    joint_position: torch.Tensor
    """[B, J] (rad)."""
    joint_low: torch.Tensor
    """[J] limits (rad)."""
    joint_high: torch.Tensor
    """[J]."""
    start_joints: torch.Tensor
    """[B, J] positions at the start of the episode (rad)."""
    power: torch.Tensor
    """[B] mean of Σ|torque · speed| over the control step (W)."""
    action: torch.Tensor
    """[B, A]."""
    last_action: torch.Tensor
    """[B, A] of the step before."""
    object_position: torch.Tensor
    """[B, 3] of the object that counts (m)."""
    object_quat: torch.Tensor
    """[B, 4] (w, x, y, z)."""
    object_velocity: torch.Tensor
    """[B, 3] (m/s)."""
    object_spin: torch.Tensor
    """[B, 3] angular velocity (rad/s)."""
    start_position: torch.Tensor
    """[B, 3] of the object at the start of the episode (m)."""
    object_force: torch.Tensor
    """[B] size of the net normal contact force on the object (N)."""
    tip_force: torch.Tensor
    """[B, F, 3] net normal contact force on finger tips, link frame (N)."""
    surface_distance: torch.Tensor
    """[B, F] from finger tips to the nearest object, whichever counts (m)."""
    goal_angle: torch.Tensor
    """[B] angle to the goal (rad)."""
    previous_goal_angle: torch.Tensor
    """[B] the same one step before, to the same goal."""
    reached: torch.Tensor
    """[B] bool: the goal was reached in this step."""
    missed: torch.Tensor
    """[B] bool: the goal's deadline passed in this step."""
    goals_reached: torch.Tensor
    """[B] goals of this episode so far."""
    axis_rate: torch.Tensor
    """[B] rotation about the commanded axis in this step (rad/s)."""
    off_axis: torch.Tensor
    """[B] tilt against the commanded axis (rad)."""
    allowed_off_axis: float
    """Tilt that the goal allows (rad)."""
    turned: torch.Tensor
    """[B] rotation about ``task.turn_axis`` since the start of the episode (rad)."""
    turned_before: torch.Tensor
    """[B] the same ``task.turn_window`` steps ago; infinite before."""
    endings: Mapping[str, torch.Tensor] = field(default_factory=dict)
    """Name → [B] bool: conditions of the task that end the episode in this step."""
    extras: dict[str, Any] = field(default_factory=dict)
    """Additions of the task's own state, by name."""


class TaskScene(Protocol):
    """What a part of a task with a state of its own sees of B environments (``robotics_bridge.envs.state.EnvState``).

    It reads there poses and contacts, and may write ``episode.target`` [B], the number of the object that counts.
    """

    hand: Hand
    num_envs: int
    device: torch.device
    model: Any
    """Compiled physics of the task (:class:`~robotics_bridge.tasks.scenes.TaskModel`)."""
    simulation: Any
    """Physics: its engine, ``state`` and ``pose`` [B, L, 7] of links (m; x y z, qx qy qz qw)."""
    contacts: Any
    """Contacts of finger tips; ``tip_links`` [F] are their links."""
    episode: Any
    """Memory of the running episodes."""

    @property
    def target_pose(self) -> torch.Tensor:
        """Pose [B, 7] of the object that counts (m; x y z, qw qx qy qz)."""
        ...

    def draw(self, count: int, low: float, high: float) -> torch.Tensor:
        """Return uniform random numbers [B, count]."""
        ...


class TaskState(Protocol):
    """Made once by ``task.task_state(scene)``, given the :class:`TaskScene` of B environments."""

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
