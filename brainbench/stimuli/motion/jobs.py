"""Input and output of every physics engine: one whisker on a prescribed follicle among obstacles, and its forces.

Whiskers never touch one another, so the unit of simulation is one whisker. Letters: n output frame.
Inside engines calculate in mm, ms and mg, so in mN and µN·m, which keep every number near one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_number
from brainbench.core.limits import Limit, limited
from brainbench.core.rotations import Length, Point
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.whisker import Whisker

MILLI = 1e3  # millimetres in a metre, milliseconds in a second, millinewtons in a newton
MICRO = 1e6  # milligrams in a kilogram, µN·m in a newton metre
_Radians = Annotated[float, Limit(unit="rad")]
_Newtons = Annotated[float, Limit(unit="N")]
_PerSquareSecond = Annotated[float, Limit(unit="m/s²")]
Acceleration = tuple[_PerSquareSecond, _PerSquareSecond, _PerSquareSecond]
_PerSecond = Annotated[float, Limit(unit="m/s")]
Velocity = tuple[_PerSecond, _PerSecond, _PerSecond]


class Follicle(Protocol):
    """Prescribed motion of one whisker base."""

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m, world) and Euler angles [n, 3] (θ, φ, ζ; rad) at ``times`` [n] (s).

        The rotation Rz(θ − π/2) · Ry(−φ) · Rx(ζ + π/2) maps the whisker's base frame to the world. The
        motion must be continuous (jumps of velocity are felt by the whisker as impacts) and defined from the job's
        start to 10 ms behind its last frame. It may have an attribute ``finest``
        (:mod:`brainbench.stimuli.engines.motion_pieces`).
        """
        ...


@limited(of="The {} of a base that stands still")
class StillFollicle:
    """A base that stands still."""

    finest: ClassVar[float] = math.inf
    position: Point = (0.0, 0.0, 0.0)
    """Base point [m, world]."""
    euler: tuple[_Radians, _Radians, _Radians] = (math.pi / 2, 0.0, -math.pi / 2)
    """(θ, φ, ζ) [rad]; the default lays the base frame on the world frame."""

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and angles [n, 3] (rad) that are the same at every time."""
        count = len(times)
        return np.tile(np.array(self.position, float), (count, 1)), np.tile(np.array(self.euler, float), (count, 1))


@limited(of="{} of a load")
class Load:
    """A point force on the whisker, as in a bench test; constant in world axes while it acts."""

    arc: Length
    """Arc length of the point it acts on [m]; the point moves with the whisker."""
    force: tuple[_Newtons, _Newtons, _Newtons]
    """Force on the whisker [N, world]."""
    stop: Annotated[float, Limit(unit="s", infinite=True)] = math.inf
    """When the force vanishes [s]; it acts from the start of the job."""


@limited(of="{} of a job", eq=False)
class Job:
    """One whisker to simulate from ``start``, at rest relative to its base and unbent, to the last frame."""

    whisker: Whisker
    follicle: Follicle
    obstacles: tuple[Obstacle, ...]
    times: NDArray[np.float64]
    """Output frame times [n] (s), increasing; values are instantaneous, not averaged."""
    start: Annotated[float, Limit(unit="s")] = 0.0
    """When the simulation begins [s]."""
    gravity: Acceleration = (0.0, 0.0, 0.0)
    """Gravitational acceleration [m/s², world]; off by default: a whisker weighs micrograms."""
    loads: tuple[Load, ...] = ()
    """Point forces on the whisker, beside the contacts."""
    air_flow: Velocity | None = None
    """Velocity of the air [m/s, world], whose drag the whisker feels (:mod:`brainbench.stimuli.engines.air`); no air
    when None, air at rest when zero."""

    def __post_init__(self) -> None:
        times = np.array(self.times, dtype=float)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
            raise UsageError("The frame times of a job must be one increasing list of finite seconds.")
        if times[0] < self.start:
            raise UsageError(f"The first frame ({times[0]:g} s) lies before the start of the job ({self.start:g} s).")
        for load in self.loads:
            check_number("arc of a load on this whisker (m)", load.arc, most=self.whisker.arc_length)
        times.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "obstacles", tuple(self.obstacles))
        object.__setattr__(self, "loads", tuple(self.loads))

    @cached_property
    def spacing(self) -> float:
        """Time between two frames, as a rule [s]; inf for a single one at the start."""
        gaps = np.sort(np.diff(self.times, prepend=self.start))
        return float(gaps[(len(gaps) - 1) // 2] + gaps[len(gaps) // 2]) / 2 or math.inf


@dataclass(frozen=True, eq=False)
class Trace:
    """Motion and forces of one simulated whisker at the frame times of its job."""

    wrench: NDArray[np.float64]
    """[n, 6] force (N) and moment (N·m): action of the whisker on its base, about the base point, world axes."""
    contact: NDArray[np.bool_]
    """[n] True where the whisker touches an obstacle."""
    contact_arc: NDArray[np.float64]
    """[n] arc length (m) of the force-weighted contact point; NaN without contact."""
    penetration: float = 0.0
    """Deepest overlap of whisker and obstacle over the whole run (m); large values mean a poor contact."""
    status: Literal["ok", "unstable"] = "ok"
    """``unstable``: the numbers from ``reason`` on must not be used; they are NaN."""
    reason: str = ""
    remark: str = ""
    """Says of an ``ok`` whisker that its estimated error is beyond what the fidelity promises, and the number."""
    error: float = math.nan
    """Estimated error of base force or moment, the larger, as a share of it, root mean square over the readings in
    contact; 0 for a whisker that feels nothing, NaN where it is not estimated."""
    damping: float = math.nan
    """Damping ratio of the first mode that the time step leaves; at least the whisker's own."""
    steps: int = 0
    """Time steps computed; 0 when the whisker was proven silent and not simulated."""
    divisor: int = 1
    """What divided its time steps; more than 1 where the first simulation could not be trusted."""
    unsolved: int = 0
    """Steps whose contact forces were not solved to the tolerance of the fidelity, or to 1e-4 where that is None;
    of engines that count them (``rod`` does)."""
    seconds: float = 0.0
    """Processor time of this whisker [s]."""
    displacement: NDArray[np.float64] | None = None
    """[n, 6] how far the follicle has given way along its own axes: slide (m) and rotation vector (rad), those of the
    whisker's base frame where nothing gives way; None for a rigid one."""
    link_positions: NDArray[np.float64] | None = None
    """[n, links + 1, 3] joints and tip (m, world) when the shape was asked for."""
    contact_wrench: NDArray[np.float64] | None = None
    """[n, 6] force (N) and moment about the base point (N·m, world axes) of all contacts on the whisker, when the shape
    was asked for and the engine tells (``rod`` does)."""
