"""Orientations that an object shall take: goals that step on, and goals with a deadline.

A goal is a frozen configuration that proposes orientations; the environment keeps them. Letters: B environment.
"""

from __future__ import annotations

import abc
import math
from typing import TYPE_CHECKING, Annotated

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.rotations import TURN, about, constant, multiply, tilted, twist_of
from robotics_bridge.tasks.settings import Factors, unit_vector

if TYPE_CHECKING:
    import torch

_Part = Annotated[float, Limit(above=0, below=1)]
_Turn = Annotated[float, Limit(least=-TURN, most=TURN, unit="rad")]
_Half = Annotated[float, Limit(least=-math.pi, most=math.pi, unit="rad")]


@limited(of="{} of a goal", kw_only=True)
class Goal(abc.ABC):
    """An orientation to reach; a new one is proposed as soon as it is."""

    threshold: Annotated[float, Limit(above=0, below=math.pi, unit="rad")] = 0.1
    """Angle below which the goal counts as reached [rad]. No two orientations are further apart than π."""
    limit: Count | None = None
    """Goals of a complete episode, for who reads the task; what ends it is an ending (``terms.enough_goals``)."""
    deadline: Factors | None = None
    """Range of the time after which another goal is proposed [s]; None waits for ever."""
    axis: tuple[float, float, float] | None = None
    """World axis of the commanded rotation, made unit length; None for goals about any axis."""
    by_looks: bool = False
    """Orientations in which the object looks the same are the same: of a cylinder, all turns about its own axis. False
    (published) tells them apart."""
    start_threshold: Annotated[float, Limit(below=math.pi, unit="rad")] | None = None
    """Wider threshold with which a teacher begins to learn [rad]; None learns with ``threshold`` from the start.

    While it learns, the threshold is multiplied by ``narrowing`` whenever the share of successful episodes, over as
    many as there are environments, exceeds ``mastered``, down to ``threshold``. Whoever does not learn (evaluations,
    students, ``play``) has ``threshold``.
    """
    mastered: _Part = 0.3
    """Share of successful episodes above which the threshold narrows."""
    narrowing: _Part = 0.9
    """Factor by which it narrows."""

    def __post_init__(self) -> None:
        if self.axis is not None:
            object.__setattr__(self, "axis", unit_vector("axis of a goal", self.axis, 3))
        if self.start_threshold is not None and not self.threshold <= self.start_threshold:
            raise UsageError(
                f"Learning begins with a wider threshold than {self.threshold:g} rad; received start_threshold = "
                f"{self.start_threshold!r}."
            )

    def first(self, quat: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        """Return the goals [B, 4] (w, x, y, z) of new episodes: what follows the object's orientations ``quat``."""
        return self.following(quat, quat, draw)

    @abc.abstractmethod
    def following(self, quat: torch.Tensor, goal: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        """Return the goals [B, 4] that follow the present ones; ``draw`` [B, 2] are uniform numbers in [0, 1)."""


@limited(of="{} of a goal", kw_only=True)
class SteppingRotation(Goal):
    """Each goal lies one step further about a fixed world axis than the last."""

    axis: tuple[float, float, float] | None = (-1.0, 0.0, 0.0)
    step: _Turn = 1.570795
    """Angle from goal to goal [rad]."""
    allowed_off_axis: Annotated[float, Limit(least=0, unit="rad")] = math.pi / 6
    """Tilt against the axis up to which rotation counts [rad]."""
    lying_flat: bool = False
    """Goals are those of an object that begins straight, in which it lies flat on the palm. False (published) keeps the
    random yaw of the start in all of them: from the first goal on it is a tilt at which the object cannot lie."""
    limit: Count | None = 15

    def first(self, quat: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        """Return the goals [B, 4] (w, x, y, z) one step from the start."""
        axis = constant(self.axis or (0.0, 0.0, 1.0), quat)
        return super().first(twist_of(quat, axis.expand_as(quat[..., 1:])) if self.lying_flat else quat, draw)

    def following(self, quat: torch.Tensor, goal: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        """Return the goals [B, 4] (w, x, y, z) one step further."""
        del draw
        # A turn about a world axis multiplies from the left. The step starts from the last goal, not from the object,
        # so that errors of reached goals do not add up.
        turn = about(constant(self.axis or (0.0, 0.0, 1.0), quat), constant(self.step, quat))
        # Not normalised: a product of unit quaternions stays one to rounding over the few goals of an episode.
        return multiply(turn.expand_as(goal), goal)


@limited(of="{} of a goal", kw_only=True)
class TimedRotation(Goal):
    """Each goal is the object's orientation at the time, tilted at random about x and y, to be reached in time."""

    tilt: Annotated[tuple[_Half, _Half], Limit(rising=True)] = (-0.7853975, 0.7853975)
    """Range of both angles [rad]."""
    deadline: Factors | None = (4.0, 6.0)

    def following(self, quat: torch.Tensor, goal: torch.Tensor, draw: torch.Tensor) -> torch.Tensor:
        """Return tilted orientations [B, 4] (w, x, y, z) of the object."""
        del goal
        # Uniform in both angles and about world axes, hence from the left.
        angles = self.tilt[0] + (self.tilt[1] - self.tilt[0]) * draw
        return multiply(tilted(angles[:, 0], angles[:, 1]), quat)
