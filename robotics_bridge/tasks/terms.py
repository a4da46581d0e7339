"""Reward terms and conditions that end an episode: small functions of one control step of all environments.

A term takes a :class:`StepContext` and its parameters and returns one number per environment [B]. Weights are per
second: the environment multiplies by its weight and by the time of a control step, as manager-based environments do.
Formulas behind the names of table 4.8 are not published; those here are ours. A :class:`TaskState` is a part of a task
that keeps a state of its own over the steps, such as thermometers.

On CUDA the environment records terms into a graph: they run once as Python, later only as what they launched. A term
that copies numbers to the device takes them from :func:`~brainbench.core.rotations.constant`; one that waits for
the device, or counts in Python, needs ``graphs=False``. Letters: B environment, J joint, A action, F finger tip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from brainbench.core.rotations import constant, rotate

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


def goal_reached(m: StepContext) -> torch.Tensor:
    """Return 1 in the step in which the goal is reached."""
    return m.reached.float()


def orientation_gaussian(m: StepContext, *, sigma: float) -> torch.Tensor:
    """Return exp(−(θ/σ)²) of the angle θ to the goal."""
    # Flat far from the goal and at it: rewards the last part of the way alone.
    return (-((m.goal_angle / sigma) ** 2)).exp()


def orientation_inverse(m: StepContext, *, rot_eps: float) -> torch.Tensor:
    """Return 1 / (θ + ε) of the angle θ to the goal (1/rad)."""
    # Has a slope at any angle; ε bounds it at the goal.
    return 1 / (m.goal_angle + rot_eps)


def rotation_progress(m: StepContext, *, clip: float, penalty_scale: float) -> torch.Tensor:
    """Return the rate about the commanded axis (rad/s), at most ``clip``, while the goal allows the tilt.

    Beyond that, the excess tilt (rad) costs ``penalty_scale`` times. Backward rotation counts in full: were it limited
    too, slow turns forward and quick ones back would pay.
    """
    excess = (m.off_axis - m.allowed_off_axis).clamp(min=0)
    return m.axis_rate.clamp(max=clip) * (excess <= 0).float() - penalty_scale * excess


def approach(m: StepContext, *, clip: tuple[float, float], negative_scale: float) -> torch.Tensor:
    """Return how fast the angle to the goal shrinks (rad/s), within bounds; growth counts ``negative_scale`` times."""
    # A difference of potentials: going to and fro adds up to nothing while both directions count alike, and to a loss
    # where growth counts more.
    rate = ((m.previous_goal_angle - m.goal_angle) / m.dt).clamp(*clip)
    return rate.clamp(min=0) + abs(negative_scale) * rate.clamp(max=0)


def near_surface(m: StepContext, *, nearest_k: int, sigma: float) -> torch.Tensor:
    """Return the mean of exp(−d/σ) over the k finger tips that are nearest to an object, or over all if fewer."""
    # Overlap counts as distance zero: pressing harder must not pay.
    distance = m.surface_distance.clamp(min=0)
    nearest = distance.topk(min(nearest_k, distance.shape[1]), dim=1, largest=False).values
    return (-nearest / sigma).exp().mean(dim=1)


def ended(m: StepContext, *, names: tuple[str, ...]) -> torch.Tensor:
    """Return 1 where the episode ended for one of these reasons; per second, as all terms."""
    total = m.endings[names[0]]
    for name in names[1:]:
        total = total | m.endings[name]
    return total.float()


def off_axis(m: StepContext) -> torch.Tensor:
    """Return the tilt against the commanded axis (rad)."""
    return m.off_axis


def far_from(m: StepContext, *, target: tuple[float, float, float] | None, margin: float) -> torch.Tensor:
    """Return the distance (m) of the object from a place (or from where its episode began) beyond a margin."""
    home = m.start_position if target is None else constant(target, m.object_position)
    return ((m.object_position - home).norm(dim=1) - margin).clamp(min=0)


def squeezed(m: StepContext, *, threshold: float, clip: float) -> torch.Tensor:
    """Return the contact force on the object (N) beyond a threshold, at most ``clip``."""
    return (m.object_force - threshold).clamp(0, clip)


def goal_missed(m: StepContext) -> torch.Tensor:
    """Return 1 in the step in which the deadline of a goal passes."""
    return m.missed.float()


def action_rate(m: StepContext) -> torch.Tensor:
    """Return the squared change of the action."""
    return ((m.action - m.last_action) ** 2).sum(dim=1)


def beyond_limits(m: StepContext) -> torch.Tensor:
    """Return by how much joints lie beyond their limits, summed (rad)."""
    over = (m.joint_position - m.joint_high).clamp(min=0) + (m.joint_low - m.joint_position).clamp(min=0)
    return over.sum(dim=1)


def work(m: StepContext) -> torch.Tensor:
    """Return the mean mechanical power of the joints, Σ|τ ω| (W)."""
    return m.power


def spin(m: StepContext, *, local_axis: tuple[float, float, float], low: float, high: float) -> torch.Tensor:
    """Return the object's angular velocity about its own axis (rad/s), within bounds."""
    # The object's axis in the world, ω · a: spin about a tilted axis counts as such, not by its vertical part.
    axis = rotate(m.object_quat, constant(local_axis, m.object_quat))
    return (m.object_spin * axis).sum(dim=1).clamp(low, high)


def alignment(m: StepContext, local_up: tuple[float, float, float]) -> torch.Tensor:
    """Return the cosine [B] between an axis of the object and the vertical."""
    # The z component of the rotated axis is the cosine of its tilt.
    return rotate(m.object_quat, constant(local_up, m.object_quat))[:, 2]


def leaning(m: StepContext, *, local_up: tuple[float, float, float], margin: float) -> torch.Tensor:
    """Return 1 − cosine of the tilt of an axis of the object against the vertical, beyond a margin."""
    return (1 - alignment(m, local_up) - margin).clamp(min=0)


def pose_change(m: StepContext, *, excluded: str) -> torch.Tensor:
    """Return the squared deviation (rad²) of joints from their start; those named ``excluded`` are free."""
    keep = constant([float(excluded not in name) for name in m.joint_names], m.joint_position)
    return (((m.joint_position - m.start_joints) ** 2) * keep).sum(dim=1)


def below(m: StepContext, *, height: float) -> torch.Tensor:
    """Return where [B] the object's origin lies lower than a height (m)."""
    return m.object_position[:, 2] < height


def enough_goals(m: StepContext, *, count: int) -> torch.Tensor:
    """Return where [B] so many goals were reached."""
    return m.goals_reached >= count


def fallen(m: StepContext, *, local_up: tuple[float, float, float], min_alignment: float) -> torch.Tensor:
    """Return where [B] an axis of the object is no longer upright."""
    return alignment(m, local_up) < min_alignment


def stagnant(m: StepContext, *, angle: float) -> torch.Tensor:
    """Return where [B] the object turned by less than an angle (rad) during the last ``task.turn_window`` steps."""
    return (m.turned - m.turned_before).abs() < angle
