"""What every physics engine does: whisker jobs (:mod:`brainbench.stimuli.motion.jobs`) go in, traces come out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from brainbench.core.progress import Progress as NamedProgress
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.sweep_batch import SweepBatch
from brainbench.stimuli.motion.jobs import Job, Trace

if TYPE_CHECKING:
    from brainbench.stimuli.objects.solid import Solid
    from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` when a job is finished."""


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
