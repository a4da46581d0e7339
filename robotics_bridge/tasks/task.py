"""A task as data: scene, rewards, endings, randomisation, observations, learning. SI units, radians."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from brainbench.core.errors import UsageError, check_each, check_name
from brainbench.core.limits import Count, Limit, NotNegative, Positive, limited
from brainbench.core.rotations import TURN
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.goals import Goal
from robotics_bridge.tasks.objects import PRIMITIVES, ObjectShape
from robotics_bridge.tasks.settings import (
    CONTACTS,
    AuxiliaryDecoder,
    ContactModel,
    Factors,
    Range,
    Span,
    StudentSettings,
    TeacherSettings,
    check_parameters,
    unit_vector,
)
from robotics_bridge.tasks.terms import TaskScene, TaskState

_Angle = Annotated[float, Limit(least=-math.pi / 2, most=math.pi / 2, unit="rad")]
_Turn = Annotated[float, Limit(least=-TURN, most=TURN, unit="rad")]
_Slide = tuple[Range, NotNegative, NotNegative, NotNegative]
Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position (m) and quaternion (w, x, y, z)."""


@limited(of="{} of a reward")
class Reward:
    """A term of the reward."""

    weight: float
    """Per second."""
    term: Callable[..., Any]
    """A function of :mod:`robotics_bridge.tasks.terms`, or one of your own of the same form."""
    params: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Ending:
    """A condition that ends an episode before its time is up."""

    condition: Callable[..., Any]
    params: Mapping[str, Any] = field(default_factory=dict)


@limited(of="actuators.{}", kw_only=True)
class ActuatorRandomisation:
    """Imperfections of the drives, drawn anew at every reset (thesis, text above table 4.9)."""

    stiffness: Factors = (0.95, 1.05)
    """Factor on the gain of the position error."""
    damping: Factors = (0.95, 1.05)
    """Factor on the gain of the velocity."""
    strength: Factors = (0.95, 1.05)
    """Factor on the torque."""
    position_bias: Annotated[tuple[_Angle, _Angle], Limit(rising=True)] = (-0.01, 0.01)
    """Error of the measured joint position [rad]."""
    deadband: Factors = (0.0, 0.005)
    """Error below which the drive does nothing [rad]."""
    backlash: Factors = (0.0, 0.01)
    """Play of the gears [rad]."""
    kick_ratio: Factors = (0.9, 1.1)
    """Factor on ``kick``."""
    kick: float = 0.0
    """Constant torque in the direction of the error [N·m]; the released settings have 0."""
    torque_noise: NotNegative = 0.1
    """Half width of white noise in every physics step, in units of the joint's effort."""


@limited(of="object_changes.{}", kw_only=True)
class ObjectRandomisation:
    """Differences between objects (thesis, table 4.9)."""

    friction: Factors = (1.0, 1.0)
    """Factor on the object's friction, which decides in all its contacts."""
    mass_offset: Range = (0.0, 0.0)
    """Added to the object's mass [kg]."""
    size: Span = (1.0, 1.0)
    """Factor on all lengths, spread evenly over environments; drawn once."""
    each_reset: bool = True
    """Draw friction and mass anew at every reset, or once."""


@limited(of="push.{}", kw_only=True)
class Push:
    """A random force on the object, for one physics step each time (thesis, table 4.9)."""

    x: Range = (0.0, 0.0)
    """[N]; this and the next two along the world's axes."""
    y: Range = (0.0, 0.0)
    """[N]."""
    z: Range = (0.0, 0.0)
    """[N]."""
    interval: Factors = (2.0, 4.0)
    """Time from one push to the next [s]; a control step at least."""


@limited(of="placement.{}", kw_only=True)
class Placement:
    """Start of the object: its lowest point at a height, with random position and yaw."""

    height: float = 0.5
    """Height of the object's lowest point [m]."""
    x: Range = (0.0, 0.0)
    y: Range = (0.0, 0.0)
    """Coordinates of its origin [m]."""
    yaw: Annotated[tuple[_Turn, _Turn], Limit(rising=True)] = (0.0, 0.0)
    """About the vertical [rad]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation at yaw 0 (w, x, y, z); made unit length."""
    sites: tuple[tuple[float, float, float], ...] = ()
    """Places of several objects, taken in random order [m]; x, y and height are added."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "quaternion", unit_vector("placement.quaternion", self.quaternion, 4))


@limited(of="solver.{}", kw_only=True)
class Solver:
    """Exactness of the physics (as in the released settings)."""

    timestep: Positive = 0.005
    """Time step of physics [s]."""
    decimation: Count = 5
    """Physics steps in a control step."""
    iterations: Count = 50
    """Iterations of the constraint solver, at most."""
    line_search: Count = 50
    """Iterations of its line search, at most."""
    tolerance: Positive = 1e-5
    """Improvement below which it stops (as MuJoCo's ``opt.tolerance``)."""


@limited(of="noise.{}", kw_only=True)
class ObservationNoise:
    """Gaussian noise of the measured proprioception (released settings)."""

    position: NotNegative = 0.005
    """[rad]."""
    velocity: NotNegative = 0.005
    """On the velocity as observed, after its factor of 0.2."""


@limited(of="success.{}", kw_only=True)
class Success:
    """Success of an episode."""

    metric: str
    """``goals`` reached (none without a goal), rotation ``turned`` (rad) about the task's ``turn_axis``, or what its
    ``task_state`` counts: seconds of ``contact`` with the target."""
    threshold: float = 1.0
    """Smallest value of the metric that is a success."""


@limited(of="{} of a task", kw_only=True)
class Task:
    """Everything that makes a task. Change one with ``dataclasses.replace``."""

    name: str
    text: str
    """One line for people."""
    rewards: Mapping[str, Reward]
    endings: Mapping[str, Ending] = field(default_factory=dict)
    success: Success = Success(metric="goals")
    episode: Positive = 10.0
    """Longest duration [s]."""
    # --- scene ---
    objects: Annotated[tuple[ObjectShape, ...], Limit(shortest=1)] = PRIMITIVES
    """Shapes of the object, spread over environments in turn."""
    copies: Count = 1
    """Objects in the scene; more than one are equal but for what ``task_state`` makes of them."""
    density: Annotated[float, Limit(least=1, unit="kg/m³")] = 200.0
    """Density of objects [kg/m³]; the value that the published engine takes by default."""
    friction: NotNegative = 1.0
    """Friction of objects, before randomisation."""
    placement: Placement = Placement()
    hand_poses: Mapping[str, Pose] = field(default_factory=dict)
    """Hand → pose of its palm; of other hands, the palm is turned up below the object."""
    joints: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Hand → joint → position at rest [rad]; 0 where absent."""
    moves: tuple[str, ...] = ()
    """Beginnings of the names of fingers that the policy moves; empty: all. The others are held."""
    furniture: Callable[[Any], None] | None = None
    """Adds fixed things to the ``mujoco.MjSpec`` of the scene."""
    carriage: Mapping[str, _Slide] = field(default_factory=dict)
    """Slides that carry the palm: world axis (x, y, z) → range [m], stiffness [N/m], damping [N·s/m], effort [N]."""
    carriage_speed: Positive = 0.5
    """How fast targets of the slides move at most, where ``rated_speed`` holds [m/s]."""
    starts: Literal["grasps"] | None = None
    """``grasps``: start from sampled grasps instead of the placement."""
    solver: Solver = Solver()
    contacts: ContactModel = CONTACTS["published"]
    """Firmness of contacts; names of :data:`~robotics_bridge.tasks.settings.CONTACTS` on the command line."""
    taxel_twist: NotNegative | None = None
    """Torsional friction of the force taxels [N·m·s], by the published law, where it is 2; None: taxels that hold what
    they touch and add up to the engine's contact forces."""
    # --- control ---
    action_ratio: NotNegative = 0.5
    """Part of a joint's range by which an action of 1 moves its target away from rest."""
    action_limit: Positive | None = None
    """Largest action, either way, that counts and is observed as the last one; None (published) for none.

    What moves no joint further changes no motion, but policies that read their own last action can otherwise run away
    from themselves.
    """
    rated_speed: bool = False
    """Whether targets move no faster than the rated speed of the joints, as those of a deployed policy do
    (:class:`~robotics_bridge.deploy.safety.SafetyLimits`)."""
    # --- randomness ---
    actuators: ActuatorRandomisation | None = ActuatorRandomisation()
    object_changes: ObjectRandomisation = ObjectRandomisation()
    push: Push | None = None
    noise: ObservationNoise = ObservationNoise()
    # --- what is to be reached ---
    goal: Goal | None = None
    turn_axis: tuple[float, float, float] | None = None
    """Axis of the object whose rotation is counted (its own frame); made unit length."""
    turn_window: Count = 60
    """Steps over which stagnation is judged."""
    task_state: Callable[[TaskScene], TaskState] | None = None
    """Makes the part of the task that keeps a state of its own (hot_ball's thermometers)."""
    # --- learning ---
    command: tuple[Literal["on", "orientation"], ...] = ("on",)
    """Contents of the group ``command``, which a hand is told: ``on`` (1: do it), ``orientation`` of the goal."""
    goal_terms: tuple[Literal["orientation", "difference", "angle"], ...] = ()
    """Contents of the group ``goal``: ``orientation``, ``difference``, ``angle``."""
    distances_in: str = "priv_obj_props"
    """Group that holds the distances from finger tips to the object."""
    auxiliary: tuple[str, ...] = ()
    """Further groups for decoders: ``aux_obj_size``, ``aux_goal_dist``, ``aux_obj_tilt``, ``aux_rotation_progress``."""
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Observation set (actor, critic, rnd_state, student) → groups."""
    decoders: tuple[AuxiliaryDecoder, ...] = ()
    teacher: TeacherSettings = field(default_factory=TeacherSettings)
    student: StudentSettings = field(default_factory=StudentSettings)

    def __post_init__(self) -> None:
        of = f"of task {self.name!r}"
        least = 2 * self.solver.timestep / self.contacts.substeps
        if self.contacts.time_constant < least:
            raise UsageError(
                f"contacts.time_constant {of} is at least two physics steps ({least:g} s); received "
                f"{self.contacts.time_constant:g}: take more contacts.substeps."
            )
        for name, reward in self.rewards.items():
            check_parameters(f"reward {name!r} {of}", reward.term, reward.params)
            if reward.term is terms.ended:
                check_each(f"ending in reward {name!r} {of}", reward.params["names"], self.endings)
        for name, ending in self.endings.items():
            check_parameters(f"ending {name!r} {of}", ending.condition, ending.params)
        if self.task_state is None:
            check_name(f"success.metric {of} without task_state", self.success.metric, ("goals", "turned"))
        if self.success.metric == "turned" and self.turn_axis is None:
            raise UsageError(f"success.metric {of} is 'turned', which counts turns about turn_axis; name that axis.")
        if self.copies > len(self.placement.sites) > 0:
            raise UsageError(f"placement.sites {of} has {len(self.placement.sites)} places for {self.copies} objects.")
        check_name(f"distances_in {of}", self.distances_in, GROUPS)
        check_each("observation group", (*self.auxiliary, *itertools.chain(*self.groups.values())), GROUPS)
        self._check_places(of)

    def _check_places(self, of: str) -> None:
        poses = {}
        for hand, (place, quaternion) in self.hand_poses.items():
            poses[hand] = (tuple(place), unit_vector(f"The quaternion of {hand!r} in hand_poses {of}", quaternion, 4))
        object.__setattr__(self, "hand_poses", poses)
        if self.turn_axis is not None:
            object.__setattr__(self, "turn_axis", unit_vector(f"turn_axis {of}", self.turn_axis, 3))
        check_each(f"axis of the carriage {of}", self.carriage, ("x", "y", "z"))

    @property
    def step_dt(self) -> float:
        """Duration of a control step (s)."""
        return self.solver.timestep * self.solver.decimation

    @property
    def turns(self) -> bool:
        """True where rotation about an axis is counted."""
        return self.turn_axis is not None or (self.goal is not None and self.goal.axis is not None)

    @property
    def max_episode_length(self) -> int:
        """Control steps after which an episode is cut off."""
        return math.ceil(self.episode / self.step_dt)


ACTION_LIMIT = 2.0
"""Bound of actions of the tasks on which we train: an action of 1 is half a joint's range, so 2 reaches every target
from every rest position."""
TASK_VERSION = 3  # raised when a change of the tasks leaves earlier policies in a world that they were not trained in
GROUPS = (
    "proprio", "tactile", "link_pose", "command", "goal", "priv_proprio", "priv_obj_state", "priv_obj_props",
    "priv_thermal", "thermal", "aux_obj_size", "aux_goal_dist", "aux_obj_tilt", "aux_rotation_progress",
)  # fmt: skip
"""Observation groups (table 4.7 and the decoders' targets)."""
MEASURED = ("proprio", "tactile", "link_pose", "command", "thermal")
"""Groups that a hand measures or is told; the others are known to the simulation alone."""


def check_measured(names: Iterable[str], reader: str) -> None:
    """Check that a policy reads what a hand has; ``reader`` names it in errors."""
    for name in names:
        check_name("observation group", name, GROUPS)
        if name not in MEASURED:
            raise UsageError(
                f"{reader} cannot read {name!r}, which only the simulation knows; a hand has {', '.join(MEASURED)}."
            )
