"""Named parameters of jobs: material and shape of the whisker, motion of its base, place and turn of objects."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.core.errors import UsageError, unknown_name
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
