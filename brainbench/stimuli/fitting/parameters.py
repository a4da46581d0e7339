"""Named parameters of jobs (of whiskers, of the motion of bases, of objects), and those that a fit can estimate.

Of the latter: how each changes a trial, its unit, its bounds, its scale and what is published.

A fit works on one dimensionless coordinate u a parameter: the logarithm of its value over the start value where it is
positive by nature, else its difference from the start value over :attr:`Parameter.scale`. u is 0 at the start.
Priors are normal laws, of logarithms for positive parameters.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.core.errors import UsageError, check_each, check_number, unknown_name
from brainbench.core.limits import Count, Limit, Positive, limited
from brainbench.stimuli.engines.fidelity import MOST_LINKS
from brainbench.stimuli.motion.jobs import Follicle, Job
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.whisker import Whisker


@dataclass(frozen=True, eq=False)
class MovedFollicle:
    """A follicle with shifts of its pose: constant ones, or a cubic spline through knots."""

    follicle: Follicle
    offsets: NDArray[np.float64]
    """[6] or [knot, 6] of x, y, z (m), θ, φ, ζ (rad)."""
    knots: NDArray[np.float64] | None = None
    """[knot] times (s); before the first and after the last their values hold."""

    @property
    def finest(self) -> float | None:
        """Shortest period (s) of the motion, as the follicle's own says; None when it says nothing."""
        nominal = getattr(self.follicle, "finest", None)
        if self.knots is None or nominal is None:
            return nominal
        return min(nominal, 2 * float(np.diff(self.knots).min()))

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and angles [n, 3] (rad)."""
        position, euler = self.follicle.pose(times)
        shift = self.offsets
        if self.knots is not None:
            from scipy.interpolate import CubicSpline

            spline = CubicSpline(self.knots, self.offsets, bc_type="clamped")
            shift = spline(np.clip(times, self.knots[0], self.knots[-1]))
        return np.asarray(position) + shift[..., :3], np.asarray(euler) + shift[..., 3:]


def move_obstacle(
    obstacle: Obstacle, shift: Sequence[float], turn: Sequence[float] = (0.0, 0.0, 0.0), *, start: float = 0.0
) -> Obstacle:
    """Return an obstacle turned about its middle at ``start`` (s) and shifted, in world axes.

    Args:
        shift: displacement [3] (m).
        turn: rotation vector [3] (rad).
    """
    from scipy.spatial.transform import Rotation

    rotation, way = Rotation.from_rotvec(turn).as_matrix(), np.asarray(shift, dtype=float)
    middle = obstacle.bounds.mean(axis=0)
    if obstacle.motion is not None:
        return replace(obstacle, motion=_MovedMotion(obstacle.motion, rotation, way, middle, start))
    return obstacle.moved(rotation, middle - rotation @ middle + way)


class _MovedMotion:
    """A motion of an object, turned about where its middle is at the start and shifted."""

    def __init__(self, motion: Any, turn: NDArray, shift: NDArray, middle: NDArray, start: float) -> None:
        self.motion, self.turn, self.shift = motion, turn, shift
        place, quaternion = motion(np.array([start]))
        self.middle = np.asarray(place)[0] + rotations.to_matrices(np.asarray(quaternion, dtype=float))[0] @ middle
        if hasattr(motion, "finest"):
            self.finest = motion.finest

    def __call__(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        place, quaternion = self.motion(times)
        if np.array_equal(self.turn, np.eye(3)):
            return np.asarray(place) + self.shift, quaternion
        turns = self.turn @ rotations.to_matrices(np.asarray(quaternion, dtype=float))
        moved = (np.asarray(place) - self.middle) @ self.turn.T + self.middle + self.shift
        return moved, rotations.from_matrices(turns)


WHISKER = (
    "young_modulus", "density", "damping_ratio", "base_radius", "tip_radius", "curvature", "friction", "arc_length",
    "poisson_ratio",
)  # fmt: skip
"""Parameters of the whisker: its fields. ``density`` is that at the base; the tip's keeps its proportion."""
BASE = ("x", "y", "z", "theta", "phi", "zeta")
"""Shifts of the base [m] and of its Euler angles [rad], as ``base.x``; at a knot in time as ``base.theta[2]``."""
OBJECT = ("x", "y", "z", "rx", "ry", "rz", "friction")
"""Shift [m] and turn [rad] of an object about its middle at the start, in world axes, as ``object.x``; of further
objects as ``object1.rz``, of all together as ``objects.x``."""
_ANGLE = 0.1  # scale of an angle (rad)
_SHARE = 0.05  # scale of a shift as a share of the arc length
_BASE_NAME = re.compile(r"base\.(\w+)(?:\[(\d+)\])?")
_OBJECT_NAME = re.compile(r"object(\d*|s)\.(\w+)")


class JobParameters:
    """Jobs as a function of named parameters, for :class:`brainbench.stimuli.fitting.gradients.GradientRun`.

    A parameter of the whisker, base or object is that of all jobs at once, as of one whisker in several trials.
    """

    def __init__(self, jobs: Sequence[Job], names: Sequence[str], *, knots: Sequence[float] | None = None) -> None:
        """Name the parameters of jobs.

        Args:
            jobs: at the nominal values.
            names: of :data:`WHISKER`, :data:`BASE` and :data:`OBJECT`.
            knots: times (s) of the knots of parameters such as ``base.theta[2]``.
        """
        self.jobs, self.names = tuple(jobs), tuple(names)
        self.knots = None if knots is None else np.array(knots, dtype=float)
        if self.knots is not None:
            whole = len(self.knots) >= 2 and np.isfinite(self.knots).all()
            if not whole or (np.diff(self.knots) <= 0).any():
                raise UsageError("knots are at least two increasing times in seconds.")
        if not self.jobs or not self.names or len(set(self.names)) < len(self.names):
            raise UsageError("Give at least one job and one parameter, and every parameter once.")
        length = min(job.whisker.arc_length for job in self.jobs)
        self.values = np.array([self._nominal(name) for name in self.names])
        """[p] nominal values; shifts and turns are 0."""
        self.scales = np.array(
            [self._scale(name, value, length) for name, value in zip(self.names, self.values, strict=True)]
        )
        """[p] sizes of small changes."""
        self._kept: dict[Any, Any] = {}

    def build(self, values: NDArray[np.float64]) -> list[Job]:
        """Return the jobs at some values [p]."""
        given = dict(zip(self.names, map(float, values), strict=True))
        return [self._job(job, given) for job in self.jobs]

    def _nominal(self, name: str) -> float:
        if name in WHISKER:
            values = {whisker_value(job.whisker, name) for job in self.jobs}
            if len(values) > 1:
                raise UsageError(f"The whiskers of the jobs differ in {name!r}; fit them one by one.")
            return values.pop()
        kind, index, what = self._parse(name)
        if kind != "object" or what != "friction":
            return 0.0
        chosen = slice(None) if index < 0 else slice(index, index + 1)
        values = {one.friction_beside(job.whisker.friction) for job in self.jobs for one in job.obstacles[chosen]}
        if len(values) != 1:
            raise UsageError(f"{name!r} names no object, or several whose frictions differ; name one.")
        return values.pop()

    def _scale(self, name: str, value: float, length: float) -> float:
        if name in ("curvature", "friction") or name.endswith(".friction"):
            return max(abs(value), 1.0 if name == "curvature" else 0.1)
        if name in WHISKER:
            return abs(value) or 0.1
        what = self._parse(name)[2]
        return _SHARE * length if what in ("x", "y", "z") else _ANGLE

    def _parse(self, name: str) -> tuple[str, int, str]:
        """Return what a name is of, its knot (−1 for none) or object (−1 for all), and the coordinate."""
        if match := _BASE_NAME.fullmatch(name):
            what, knot = match.groups()
            if what in BASE:
                if knot is None:
                    return "base", -1, what
                if self.knots is None or int(knot) >= len(self.knots):
                    count = 0 if self.knots is None else len(self.knots)
                    raise UsageError(f"{name!r} names knot {knot}, and there are {count}; give their times as knots.")
                return "base", int(knot), what
        if match := _OBJECT_NAME.fullmatch(name):
            which, what = match.groups()
            if what in OBJECT and which == "s":
                return "object", -1, what
            if what in OBJECT:
                count = min(len(job.obstacles) for job in self.jobs)
                if int(which or 0) >= count:
                    raise UsageError(f"{name!r} names object {which or 0}, and the jobs have {count}; count from 0.")
                return "object", int(which or 0), what
        names = (*WHISKER, *(f"base.{what}" for what in BASE), *(f"object.{what}" for what in OBJECT))
        raise unknown_name("parameter", name, names)

    def _job(self, job: Job, given: dict[str, float]) -> Job:
        """Return a job at given values; what these do not change is the same object as at other values."""
        material = {name: value for name, value in given.items() if name in WHISKER}
        constant: dict[str, float] = {}
        at_knots: dict[tuple[int, str], float] = {}
        moves: dict[int, dict[str, float]] = {}
        for name, value in given.items():
            if name in WHISKER:
                continue
            kind, index, what = self._parse(name)
            if kind == "object":
                for number in range(len(job.obstacles)) if index < 0 else (index,):
                    moves.setdefault(number, {})[what] = value
            elif index < 0:
                constant[what] = value
            else:
                at_knots[index, what] = value
        whisker = self._keep(("whisker", job.whisker), material, lambda: with_values(job.whisker, material))
        follicle, obstacles = job.follicle, list(job.obstacles)
        if constant or at_knots:
            both = constant | at_knots
            follicle = self._keep(("base", id(follicle)), both, lambda: self._moved_base(job, constant, at_knots))
        for index, move in moves.items():
            key = ("object", id(obstacles[index]), job.start)
            obstacles[index] = self._keep(key, move, lambda o=obstacles[index], m=move: _moved(o, m, job.start))
        return replace(job, whisker=whisker, follicle=follicle, obstacles=tuple(obstacles))

    def _keep(self, what: Any, given: Mapping[Any, float], make: Callable[[], Any]) -> Any:
        """Return what was made of these values at first."""
        store = self._kept.setdefault(what, {})
        key = tuple(given.items())
        if key not in store:
            if len(store) > 4 * len(self.names):
                store.clear()
            store[key] = make()
        return store[key]

    def _moved_base(
        self, job: Job, constant: Mapping[str, float], at_knots: Mapping[tuple[int, str], float]
    ) -> MovedFollicle:
        follicle: Follicle = job.follicle
        if at_knots:
            assert self.knots is not None
            offsets = np.zeros((len(self.knots), 6))
            for (knot, what), value in at_knots.items():
                offsets[knot, BASE.index(what)] = value
            follicle = MovedFollicle(follicle, offsets, self.knots)
        return MovedFollicle(follicle, np.array([constant.get(what, 0.0) for what in BASE]))


def whisker_value(whisker: Whisker, name: str) -> float:
    """Return the value of a parameter of :data:`WHISKER`."""
    return whisker.densities[0] if name == "density" else float(getattr(whisker, name))


def with_values(whisker: Whisker, given: Mapping[str, float]) -> Whisker:
    """Return a whisker with other values of parameters of :data:`WHISKER`; tables along it keep their shape."""
    changes: dict[str, Any] = dict(given)
    stretch = given.get("arc_length", whisker.arc_length) / whisker.arc_length
    for table, ends in (("radii", ("base_radius", "tip_radius")), ("moduli", ("young_modulus", "young_modulus"))):
        if (rows := np.array(getattr(whisker, table))).size and not given.keys().isdisjoint({"arc_length", *ends}):
            low, high = (given[name] / getattr(whisker, name) if name in given else 1.0 for name in ends)
            factors = low + (high - low) * rows[:, 0] / whisker.arc_length
            changes[table] = tuple(zip(stretch * rows[:, 0], factors * rows[:, 1], strict=True))
    if "density" in given and isinstance(whisker.density, tuple):
        low, high = whisker.densities
        changes["density"] = (given["density"], given["density"] * high / low)
    return replace(whisker, **changes) if changes else whisker


def _moved(obstacle: Obstacle, move: Mapping[str, float], start: float) -> Obstacle:
    shift, turn = ([move.get(name, 0.0) for name in names] for names in (OBJECT[:3], OBJECT[3:6]))
    return replace(move_obstacle(obstacle, shift, turn, start=start), friction=move.get("friction", obstacle.friction))


@limited
class FitOptions:
    """How a fit simulates, weighs and judges; a value outside its range is a :class:`UsageError`."""

    priors: Literal["none", "published"] = "none"
    """Prior of the parameters: none, or published (means and spreads of measured whiskers)."""
    intervals: Literal["laplace", "profile"] = "laplace"
    """Confidence intervals: laplace (curvature of the likelihood at the best fit), or profile (takes longer)."""
    level: float = 0.95
    """Coverage of the confidence intervals."""
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = "linear"
    """Loss of a residual: linear (least squares), or soft_l1, huber or cauchy, which outliers pull less."""
    most_iterations: Count = 50
    """Iterations after which a fit counts as not converged."""
    links: Annotated[int, Limit(least=2, most=MOST_LINKS)] = 20
    """Links of each simulated whisker."""
    steps_per_period: Annotated[float, Limit(least=4)] = 400.0
    """Time steps in one period of the whisker's first mode at the start of the fit. Few steps damp higher modes, which
    biases stiffness and taper by more than the noise of a good sensor."""
    time_step: Annotated[float, Limit(above=0, unit="s")] = 1e-4
    """Longest time step (s)."""
    solver: Literal["dynamic", "quasistatic"] = "dynamic"
    """quasistatic leaves out inertia and damping, for slow contact."""
    twist: bool = True
    """Whether whiskers may twist."""

    def __post_init__(self) -> None:
        if self.intervals == "profile" and self.loss != "linear":
            raise UsageError(
                f"Profile intervals follow the squares of the residuals, and the loss {self.loss!r} is another; "
                "use intervals = 'laplace', or the loss 'linear'."
            )
        check_number("confidence level", self.level, above=0, below=1)


@dataclass(frozen=True)
class Condition:
    """Everything about a trial that a fit may change: values of :data:`PARAMETERS`, as ``condition["base_x"]``."""

    whisker: Whisker
    others: Mapping[str, float] = field(default_factory=dict)
    """Values of parameters that are not the whisker's; displacements that are not named are 0."""

    def __getitem__(self, name: str) -> float:
        """Return the value of a parameter; of a deflection that no trial has NaN."""
        if name in WHISKER:
            return whisker_value(self.whisker, name)
        return self.others.get(name, math.nan if name == "deflection" else 0.0)

    def changed(self, values: Mapping[str, float]) -> Condition:
        """Return a condition with other values of some parameters."""
        material = {name: value for name, value in values.items() if name in WHISKER}
        return Condition(
            with_values(self.whisker, material), {**self.others, **{k: values[k] for k in values if k not in material}}
        )

    def job(self, job: Job) -> Job:
        """Return the job of a trial under this condition, but for what holds its whisker aside."""
        job = replace(job, whisker=self.whisker)
        moves = {PARAMETERS[name].of_job: value for name, value in self.others.items() if value}
        moves.pop("", None)
        return JobParameters([job], tuple(moves)).build(np.array([*moves.values()]))[0] if moves else job


@dataclass(frozen=True)
class Parameter:
    """One parameter that a fit can estimate."""

    name: str
    unit: str
    kind: Literal["log", "linear"]
    """``log``: positive, fitted as the logarithm of its ratio to the start value."""
    low: float
    """Lower bound: a ratio to the start value for ``log``, else in multiples of the scale around the start value."""
    high: float
    what: str
    """What it is, in words."""
    scale: float = 1.0
    """Length of one unit of u: a value for ``linear`` (for ``length`` and ``curvature`` scaled by the whisker)."""
    of_length: int = 0
    """Power of the arc length that ``scale`` is multiplied by."""
    of_job: str = ""
    """Displacement of :class:`brainbench.stimuli.fitting.gradients.JobParameters` that it is."""
    real: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest value of real whiskers, a little wider than what was published."""

    def unit_of(self, whisker: Whisker) -> float:
        """Return what one unit of u is worth, in the parameter's unit; of ``log`` parameters 1."""
        return self.scale * whisker.arc_length**self.of_length

    def value(self, start: float, u: float, whisker: Whisker) -> float:
        """Return the value at coordinate u of a fit that began at ``start``."""
        return start * math.exp(u) if self.kind == "log" else start + u * self.unit_of(whisker)

    def coordinate(self, start: float, value: float, whisker: Whisker) -> float:
        """Return the coordinate u of a value."""
        return math.log(value / start) if self.kind == "log" else (value - start) / self.unit_of(whisker)


def _positive(name: str, unit: str, what: str, low: float = 0.1, high: float = 10.0, **others: Any) -> Parameter:
    return Parameter(name, unit, "log", low, high, what, **others)


def _shift(name: str, what: str, of_job: str) -> Parameter:
    return Parameter(name, "m", "linear", -4.0, 4.0, what, 0.05, 1, of_job)


PARAMETERS: Mapping[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        _positive("young_modulus", "Pa", "Young's modulus", real=(1e9, 1e10)),
        _positive(
            "density", "kg/m³", "density at the base; the ratio of tip to base is kept", 0.2, 5.0, real=(800.0, 2000.0)
        ),
        _positive("damping_ratio", "", "damping ratio of the first mode", real=(0.01, 1.0)),
        _positive("base_radius", "m", "radius at the base", 0.2, 5.0),
        _positive("tip_radius", "m", "radius at the tip, which sets the taper", 0.05, 20.0),
        _positive("arc_length", "m", "length along the whisker", 0.5, 2.0),
        Parameter("curvature", "1/m", "linear", -30.0, 30.0, "coefficient A of the rest shape y = A x²", 0.1, -1),
        Parameter("friction", "", "linear", -10.0, 10.0, "Coulomb coefficient of the whisker", 0.3),
        # θ turns about the z axis last, so that its change is a turn about z of the whole base.
        Parameter("base_angle", "rad", "linear", -10.0, 10.0, "turn of the base about z", 0.05, of_job="base.theta"),
        *(_shift(f"base_{axis}", f"displacement of the base along {axis}", f"base.{axis}") for axis in "xyz"),
        *(_shift(f"object_{axis}", f"displacement of the objects along {axis}", f"objects.{axis}") for axis in "xyz"),
        _positive("deflection", "m", "deflection of the plucked point before its release", 0.05, 20.0),
    )
}
"""Parameters by name."""


@dataclass(frozen=True)
class FreeParameters:
    """The parameters of one fit, with their start values and bounds."""

    names: tuple[str, ...]
    start: Condition
    """Condition whose values the fit starts from."""
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Bounds of single parameters, in their units; others as in :data:`PARAMETERS`."""

    def __post_init__(self) -> None:
        check_each("parameter of a fit", self.names, PARAMETERS)
        check_each("fitted parameter with bounds", self.bounds, self.names)
        if not self.names or len(set(self.names)) < len(self.names):
            raise UsageError(f"A fit needs at least one parameter, each once; received {list(self.names)}.")
        for name in self.names:
            value = self.start[name]
            if math.isnan(value):
                raise UsageError(f"{name!r} is a parameter of a ring-down, and no trial here is one; leave it out.")
            if PARAMETERS[name].kind == "log" and not value > 0:
                raise UsageError(f"The fit of {name!r} starts at {value:g}; give a positive start value.")

    def __len__(self) -> int:
        return len(self.names)

    def values(self, u: Any) -> tuple[float, ...]:
        """Return the values at coordinates u [p]."""
        whisker = self.start.whisker
        return tuple(
            PARAMETERS[name].value(self.start[name], float(value), whisker)
            for name, value in zip(self.names, u, strict=True)
        )

    def condition(self, u: Any) -> Condition:
        """Return the condition at coordinates u [p]."""
        return self.start.changed(dict(zip(self.names, self.values(u), strict=True)))

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds of u [p]; a start value outside its bounds is a :class:`UsageError`."""
        low, high = np.array([self._limits(name) for name in self.names]).T
        return low, high

    def _limits(self, name: str) -> tuple[float, float]:
        parameter, start = PARAMETERS[name], self.start[name]
        low, high = parameter.low, parameter.high
        if parameter.kind == "log":
            low, high = math.log(low), math.log(high)
        if name == "friction":
            low = parameter.coordinate(start, 0.0, self.start.whisker)
        if name in self.bounds:
            ends = self.bounds[name]
            if not ends[0] < start < ends[1]:
                raise UsageError(
                    f"The start value of {name!r}, {start:g}, does not lie between its bounds {ends[0]:g} and "
                    f"{ends[1]:g}; change one of them."
                )
            # A logarithm has no bound at 0.
            low, high = (
                parameter.coordinate(start, end, self.start.whisker) if end > 0 or parameter.kind == "linear" else -12.0
                for end in ends
            )
        return low, high


@limited(of="The {} of a prior")
class Prior:
    """What is known of a parameter before a fit."""

    mean: float
    """Mean, in the parameter's unit; of the logarithm for positive parameters (then the median)."""
    spread: Positive
    """Standard deviation; relative for positive parameters."""
    source: str

    def row(self, name: str, start: float, whisker: Whisker) -> tuple[float, float]:
        """Return the mean and the standard deviation of the coordinate u of a fit that began at ``start``."""
        parameter = PARAMETERS[name]
        if parameter.kind == "log":
            check_number(f"The mean of the prior of {name!r}", self.mean, above=0)
        spread = self.spread if parameter.kind == "log" else self.spread / parameter.unit_of(whisker)
        return parameter.coordinate(start, self.mean, whisker), spread


PUBLISHED: Mapping[str, Prior] = {
    "young_modulus": Prior(
        # Standard deviation of the logarithm of a log-normal law with this mean and standard deviation.
        3.34e9,
        math.sqrt(math.log1p((1.48 / 3.34) ** 2)),
        "Quist et al. (2011), J. Biomech. 44, 2775-2781: 3.34 ± 1.48 GPa",
    ),
    "density": Prior(
        1260.0,
        0.15,
        "Yang, Belli & Hartmann (2019), J. Neurophysiol. 121, 1879-1895: 1260 (base) to 1690 kg/m³ (tip); "
        "the spread is half of that range",
    ),
    "damping_ratio": Prior(
        math.sqrt(0.11 * 0.17),
        math.log(0.17 / 0.11) / 2,
        "isolated whiskers ring with .11 to .17, taken as ± 1 "
        "standard deviation; a whisker in its follicle may be damped more",
    ),
    "friction": Prior(
        0.48, 0.15, "rat whisker on stainless steel, IEEE Trans. Haptics (2017), PMC5753595: .48; the spread is ours"
    ),
}
"""Priors by parameter; others have none."""
