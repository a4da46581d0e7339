"""Input and output of every physics engine: one whisker on a prescribed follicle among obstacles.

Whiskers never touch one another, so the unit of simulation is one whisker. Letters: n output frame.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.progress import Progress as NamedProgress
from brainbench.core.reading.ranges import check_fields, check_number
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.sweep_batch import SweepBatch
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.whisker import Whisker

if TYPE_CHECKING:
    from brainbench.stimuli.objects.solid import Solid
    from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` when a job is finished."""


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


@dataclass(frozen=True)
class StillFollicle:
    """A base that stands still."""

    finest: ClassVar[float] = math.inf
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Base point [m, world]."""
    euler: tuple[float, float, float] = (math.pi / 2, 0.0, -math.pi / 2)
    """(θ, φ, ζ) [rad]; the default lays the base frame on the world frame."""

    def __post_init__(self) -> None:
        check_fields(self, "position", items=3, of="The {} (m) of a base that stands still")
        check_fields(self, "euler", items=3, of="The angles {} (rad) of a base that stands still")

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the same pose at every time."""
        count = len(times)
        return np.tile(np.array(self.position, float), (count, 1)), np.tile(np.array(self.euler, float), (count, 1))


@dataclass(frozen=True)
class Load:
    """A point force on the whisker, as in a bench test; constant in world axes while it acts."""

    arc: float
    """Arc length of the point it acts on [m]; the point moves with the whisker."""
    force: tuple[float, float, float]
    """Force on the whisker [N, world]."""
    stop: float = math.inf
    """When the force vanishes [s]; it acts from the start of the job."""


@dataclass(frozen=True, eq=False)
class Job:
    """One whisker to simulate from ``start``, at rest relative to its base and unbent, to the last frame."""

    whisker: Whisker
    follicle: Follicle
    obstacles: tuple[Obstacle, ...]
    times: NDArray[np.float64]
    """Output frame times [n] (s), increasing; values are instantaneous, not averaged."""
    start: float = 0.0
    """When the simulation begins [s]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Gravitational acceleration [m/s², world]; off by default: a whisker weighs micrograms."""
    loads: tuple[Load, ...] = ()
    """Point forces on the whisker, beside the contacts."""

    def __post_init__(self) -> None:
        times = np.array(self.times, dtype=float)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
            raise UsageError("The frame times of a job must be one increasing list of finite seconds.")
        check_fields(self, "start", of="{} of a job (s)")
        check_fields(self, "gravity", items=3, of="{} of a job (m/s²)")
        if times[0] < self.start:
            raise UsageError(f"The first frame ({times[0]:g} s) lies before the start of the job ({self.start:g} s).")
        for load in self.loads:
            check_number("arc of a load on this whisker (m)", load.arc, above=0, most=self.whisker.arc_length)
            check_fields(load, "force", items=3, of="{} of a load (N)")
            if math.isnan(load.stop):
                raise UsageError("stop of a load (s) must be a number, inf for a load that stays; received nan.")
        times.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "obstacles", tuple(self.obstacles))
        object.__setattr__(self, "loads", tuple(self.loads))


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
    steps: int = 0
    """Time steps computed; 0 when the whisker was proven silent and not simulated."""
    unsolved: int = 0
    """Steps whose contact forces were not solved to :attr:`Fidelity.contact_tolerance`, or to 1e-4 where that is None;
    of engines that tell (``rod`` does)."""
    seconds: float = 0.0
    """Processor time of this whisker [s]."""
    link_positions: NDArray[np.float64] | None = None
    """[n, links + 1, 3] joints and tip (m, world) when the shape was asked for."""
    contact_wrench: NDArray[np.float64] | None = None
    """[n, 6] force (N) and moment about the base point (N·m, world axes) of all contacts on the whisker, when the shape
    was asked for and the engine tells (``rod`` does)."""


@dataclass(frozen=True)
class WhiskerEngine(ABC):
    """A physics engine that runs whisker jobs; its fields say what it can do."""

    device: str = "cpu"
    """Device it runs on, one of :attr:`devices`."""
    retry: int = 1
    """Divisor of the time step for whiskers that cannot be trusted, which are then simulated again, and those left once
    more with steps divided by twice this; 1 leaves them ``unstable``. Of the engines ``rod`` uses it."""

    name: ClassVar[str]
    """Name under which :func:`brainbench.stimuli.engines.get_engine` finds it."""
    package: ClassVar[str] = ""
    """Distribution whose version belongs to its results; empty for none."""
    revision: ClassVar[str] = ""
    """Changes where this engine alone gives other numbers than before; :data:`PHYSICS_VERSION` counts for all."""
    devices: ClassVar[tuple[str, ...]] = ("cpu",)
    """Kinds of devices it runs on."""
    solvers: ClassVar[tuple[str, ...]] = ("dynamic",)
    """Values of :attr:`Fidelity.solver` it knows."""
    twists: ClassVar[bool] = False
    """True when whiskers can twist about their axis; in other engines they only bend."""
    surfaces: ClassVar[bool] = False
    """True when it collides the exact surface of obstacles that have one; others collide convex parts."""
    batches: ClassVar[bool] = False
    """True when :meth:`run_sweeps` simulates many passive sweeps at once, without a scene for each."""

    def prepare(  # noqa: B027 — engines that have nothing to prepare keep this one
        self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None
    ) -> None:
        """Do, in a thread before :meth:`run`, what the first run would wait for, such as compiling; most need nothing.

        ``lengths`` are the arc lengths of the whiskers [m]; ``progress`` is called as ``progress(done, total, what)``.
        """

    @abstractmethod
    def run(
        self,
        jobs: Sequence[Job],
        fidelity: Fidelity,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        record_shape: bool = False,
    ) -> list[Trace]:
        """Simulate every job and return their traces in the same order.

        A job whose whisker reaches no obstacle while its base stands still, without gravity and loads, is not
        simulated: its wrench is exactly zero. Obstacles out of reach are left out.

        Args:
            jobs, fidelity: whiskers to simulate, independent of one another, and the knobs of accuracy.
            progress: called as ``progress(done, total)`` when a job is finished.
            workers: native threads; all usable processors when None.
            record_shape: fill :attr:`Trace.link_positions`.
        """

    def prepare_sweeps(  # noqa: B027 — as for prepare
        self, scenes: SweepScenes, fidelity: Fidelity
    ) -> None:
        """Do, in a thread, what the first :meth:`run_sweeps` would wait for, such as compiling; no object is loaded."""

    def pack(self, solid: Solid) -> Any:
        """Return what :meth:`run_sweeps` makes of an object first, so that other processes can; None for nothing."""
        return None

    def run_sweeps(
        self,
        scenes: SweepScenes,
        indices: Sequence[int],
        fidelity: Fidelity,
        *,
        workers: int | None = None,
        packed: Mapping[str, Any] | None = None,
    ) -> SweepBatch:
        """Simulate sweeps whose object moves; of engines that take :attr:`batches` alone.

        Results do not depend on which sweeps come together, nor on their order; ordered by object they are fastest.
        ``workers`` are threads on the CPU, one when None; ``packed`` is what :meth:`pack` made of objects, by name.
        """
        raise NotImplementedError(f"The engine {self.name!r} takes sweeps as single scenes.")


def base_rotation(euler: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrices [..., 3, 3] from base frame to world of Euler angles [..., 3] (θ, φ, ζ; rad)."""
    theta, phi, zeta = np.moveaxis(np.asarray(euler, dtype=float), -1, 0)
    return _about("z", theta - np.pi / 2) @ _about("y", -phi) @ _about("x", zeta + np.pi / 2)


def _about(axis: str, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotation matrices [..., 3, 3] about one coordinate axis."""
    # The cyclic order of the axes gives all three rotations the right-handed sign.
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., [0, 1, 2], [0, 1, 2]] = 1.0
    matrix[..., first, first] = matrix[..., second, second] = np.cos(angle)
    matrix[..., second, first] = np.sin(angle)
    matrix[..., first, second] = -np.sin(angle)
    return matrix
