"""What every physics engine does: whisker jobs (:mod:`brainbench.stimuli.motion.jobs`) go in, traces come out.

Here too: the results of many sweeps at once, and threads that share jobs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import usable_processors
from brainbench.core.errors import UsageError, check_number, listing
from brainbench.core.progress import Progress as NamedProgress
from brainbench.stimuli.engines.air import check_air
from brainbench.stimuli.engines.error_estimates import with_errors
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle, Trace  # noqa: F401, what a script gives an engine

if TYPE_CHECKING:
    from brainbench.stimuli.objects.solid import Solid
    from brainbench.stimuli.whiskers.array import WhiskerArray


def run_groups(
    groups: Sequence[Sequence[int]],
    run: Callable[[Sequence[int]], Mapping[int, Trace]],
    *,
    threads: int,
    progress: Progress | None = None,
) -> list[Trace]:
    """Run groups of jobs, ``threads`` at a time, and return all traces in the order of the jobs.

    Each job stands in one group; ``progress`` is called as ``progress(done, total)`` when one is finished.
    """
    traces: dict[int, Trace] = {}
    total = sum(map(len, groups))
    # Starting a thread costs as much as simulating 10 ms.
    with ThreadPoolExecutor(max_workers=threads) if len(groups) > 1 else nullcontext() as pool:
        try:
            futures = [pool.submit(run, group) for group in groups] if pool else []
            parts = (future.result() for future in as_completed(futures)) if pool else map(run, groups)
            for index, trace in (pair for part in parts for pair in part.items()):
                traces[index] = trace
                if progress is not None:
                    progress(len(traces), total)
        except BaseException:
            # Without this an interrupt or a failed job would wait for every job that is still queued.
            if pool:
                pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [traces[index] for index in range(total)]


class PassiveSweeps(Protocol):
    """Sweeps as an engine takes them: an array, objects by name, and how each passes."""

    grid: Any
    """Has ``mover``, ``head``, ``frames``, ``start``, ``placing``, the ``count`` of passes of an object, and these by
    ``sweeps(name)`` with ``speed``, ``height``, ``rotation``, ``distance`` and ``size``."""
    array: WhiskerArray
    objects: tuple[str, ...]

    def solid(self, name: str) -> Solid:
        """Return an object."""
        ...


_BY_SWEEP = "wrench", "contact", "unstable", "error", "straight"


@dataclass(frozen=True, eq=False)
class SweepBatch:
    """Wrenches and contacts of some sweeps, in the order in which they were asked for."""

    wrench: NDArray[np.float32]
    """[sweep, frame, whisker, 6] N and N·m, in the axes that the frames of the grid name; NaN where unstable."""
    contact: NDArray[np.float32]
    """[sweep, whisker] fraction of the frames in which the whisker touched the object."""
    unstable: NDArray[np.bool_]
    """[sweep, whisker] True where the simulation failed; these numbers must not be used."""
    reasons: tuple[str, ...]
    """[sweep] why, in words; empty for a sweep that is ok."""
    steps: int
    """Time steps of single whiskers that were computed."""
    steps_in_full: int
    """Time steps that simulating every whisker of every sweep from start to end takes."""
    retried: int = 0
    """Sweeps with a whisker that was simulated again with finer steps, because it could not be trusted at first."""
    unsolved: int = 0
    """Time steps whose contact forces were not solved (:attr:`brainbench.stimuli.motion.jobs.Trace.unsolved`)."""
    error: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), dtype=np.float32))
    """[sweep, whisker] estimated error (:attr:`brainbench.stimuli.motion.jobs.Trace.error`); NaN without one."""
    straight: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    """[sweep, whisker] True where straight links were touched, because the bent rod gave nothing to be trusted."""

    def __post_init__(self) -> None:
        count, _, whiskers, channels = np.shape(self.wrench)
        if not self.error.size:
            object.__setattr__(self, "error", np.full((count, whiskers), np.nan, dtype=np.float32))
        if not self.straight.size:
            object.__setattr__(self, "straight", np.zeros((count, whiskers), dtype=bool))
        if channels != 6 or self.contact.shape != (count, whiskers) or self.unstable.shape != (count, whiskers):
            raise UsageError(
                f"A batch of sweeps has wrenches [n, frame, whisker, 6] and [n, whisker] for contact and unstable; "
                f"received {self.wrench.shape}, {self.contact.shape} and {self.unstable.shape}."
            )
        if [bool(reason) for reason in self.reasons] != np.asarray(self.unstable.any(axis=1)).tolist():
            raise UsageError("Every sweep of a batch has a reason, which is empty exactly when no whisker is unstable.")

    def ordered(self, order: NDArray[np.int_]) -> SweepBatch:
        """Return the batch with its sweeps in another order."""
        arrays = {name: getattr(self, name)[order] for name in _BY_SWEEP}
        return replace(self, **arrays, reasons=tuple(self.reasons[place] for place in order.tolist()))


def describe_unstable(
    names: Sequence[str], unstable: NDArray[np.bool_], reasons: NDArray[np.object_]
) -> tuple[str, ...]:
    """Return the reason of each sweep: that of its first unstable whisker, and how many more there are.

    ``names`` are those of the whiskers; ``unstable`` and ``reasons`` (in words) have shape [sweep, whisker].
    """
    sentences = []
    for bad, words in zip(unstable, reasons, strict=True):
        first = int(np.argmax(bad))
        more = f" (and {bad.sum() - 1} more whiskers)" if bad.sum() > 1 else ""
        sentences.append(f"{names[first]}: {words[first]}{more}" if bad.any() else "")
    return tuple(sentences)


def join_batches(parts: Sequence[SweepBatch]) -> SweepBatch:
    """Return several batches as one."""
    if len(parts) == 1:
        return parts[0]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_SWEEP}
    names = "steps", "steps_in_full", "retried", "unsolved"
    counts: dict[str, Any] = {name: sum(getattr(part, name) for part in parts) for name in names}
    return SweepBatch(**arrays, reasons=tuple(reason for part in parts for reason in part.reasons), **counts)


Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)`` when a job is finished."""


@dataclass(frozen=True)
class WhiskerEngine:
    """A physics engine that runs whisker jobs; its fields say what it can do."""

    device: str = "cpu"
    """Device it runs on, one of :attr:`devices`."""
    retry: int = 1
    """Divisor of the time step for whiskers that cannot be trusted, which are then simulated again, and those left once
    more with steps divided by twice this; 1 leaves them ``unstable``. Of the engines ``rod`` uses it."""

    errors: bool = False
    """Whether :meth:`run` estimates the error of every whisker (:mod:`.error_estimates`), as stimulus sets have it; two
    further simulations of those in contact."""

    motions: dict[Any, Any] = field(default_factory=dict, repr=False, compare=False)
    """What it made of the motions of some jobs, which it may simulate several times."""

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
    yields: ClassVar[bool] = False
    """True when follicles can give way (:class:`brainbench.stimuli.whiskers.whisker.FollicleSprings`)."""
    flows: ClassVar[bool] = False
    """True when whiskers feel moving air (:mod:`brainbench.stimuli.engines.air`)."""
    coils: ClassVar[bool] = False
    """True when rest shapes may have ``bends`` (:class:`brainbench.stimuli.whiskers.whisker.Whisker`)."""
    smooth: ClassVar[bool] = False
    """True when contacts may touch the centre line of the rod (:attr:`Fidelity.contact_line`)."""
    surfaces: ClassVar[bool] = False
    """True when it collides the exact surface of obstacles that have one; others collide convex parts."""
    batches: ClassVar[bool] = False
    """True when :meth:`run_sweeps` simulates many passive sweeps at once, without a scene for each."""

    def prepare(self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None) -> None:
        """Do, in a thread before :meth:`run`, what the first run would wait for, such as compiling; most need nothing.

        ``lengths`` are the arc lengths of the whiskers [m]; ``progress`` is called as ``progress(done, total, what)``.
        """

    def session(self) -> AbstractContextManager[None]:
        """Return what surrounds a run; without the engine's package it is a :class:`MissingDependencyError`."""
        return nullcontext()

    def groups(self, jobs: Sequence[Job], fidelity: Fidelity, threads: int) -> list[list[int]]:
        """Return the jobs that are simulated together, by their index; ``threads`` groups are at a time."""
        return [[index] for index in range(len(jobs))]

    def threads(self, workers: int | None) -> int:
        """Return how many groups are simulated at a time, given the ``workers`` of a run."""
        return workers or usable_processors()

    def simulate_group(self, jobs: Sequence[Job], fidelity: Fidelity, *, record_shape: bool) -> list[Trace]:
        """Simulate the jobs of one group, each as often as it takes to be trusted; for :meth:`run`."""
        raise NotImplementedError(f"The engine {self.name!r} has a run of its own.")

    def check(self, jobs: Sequence[Job], fidelity: Fidelity, workers: int | None = None) -> None:
        """Refuse jobs, solvers and workers that the engine cannot run; warn of steps that damp too much."""
        if workers is not None:
            check_number("workers", workers, least=1, whole=True)
        if fidelity.solver not in self.solvers:
            raise UsageError(
                f"The backend {self.name!r} has no solver {fidelity.solver!r}, only {listing(self.solvers)}; use the "
                "backend 'rod' for it."
            )
        if fidelity.twist and not self.twists:
            raise UsageError(
                f"Whiskers of the backend {self.name!r} bend but do not twist; leave twist out, or use the backend"
                " 'rod'."
            )
        for able, used, words in (
            (self.yields, any(job.whisker.follicle for job in jobs), "have rigid follicles; leave follicle out"),
            (self.coils, any(job.whisker.bends for job in jobs), "rest as parabolas; leave bends out"),
            (self.smooth, fidelity.contact_line == "rod", "touch with straight links; leave contact_line out"),
            (self.flows, any(job.air_flow is not None for job in jobs), "feel no air; leave air_flow out"),
        ):
            if used and not able:
                raise UsageError(f"Whiskers of the backend {self.name!r} {words}, or use the backend 'rod'.")
        check_air(jobs)
        for obstacle in {id(item): item for job in jobs for item in job.obstacles}.values():
            if obstacle.surface is not None and not obstacle.parts and not self.surfaces:
                raise UsageError(
                    f"The backend {self.name!r} collides convex bodies only, and an object here is a concave surface"
                    f" of {len(obstacle.surface.faces)} triangles; give the object collision = 'decomposition' (convex"
                    " pieces, whose deviation is stated) or use the backend 'rod', which touches the surface itself."
                )
        fidelity.warn_overdamped(jobs)

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
            workers: native threads; all usable processors when None. On a GPU they mean nothing.
            record_shape: fill :attr:`Trace.link_positions`.
        """

        def _run(group: Sequence[int]) -> dict[int, Trace]:
            some, engine = [jobs[index] for index in group], replace(self, motions={})
            simulate, once = (
                partial(each.simulate_group, record_shape=record_shape) for each in (engine, replace(engine, retry=1))
            )
            traces = with_errors(simulate, some, fidelity, once) if self.errors else simulate(some, fidelity)
            return dict(zip(group, traces, strict=True))

        with self.session():
            self.check(jobs, fidelity, workers)
            threads = self.threads(workers)
            return run_groups(self.groups(jobs, fidelity, threads), _run, threads=threads, progress=progress)

    def prepare_sweeps(self, scenes: PassiveSweeps, fidelity: Fidelity) -> None:
        """Do, in a thread, what the first :meth:`run_sweeps` would wait for, such as compiling; no object is loaded."""

    def pack(self, solid: Solid) -> Any:
        """Return what :meth:`run_sweeps` makes of an object first, so that other processes can; None for nothing."""
        return None

    def run_sweeps(
        self,
        scenes: PassiveSweeps,
        indices: Sequence[int],
        fidelity: Fidelity,
        *,
        workers: int | None = None,
        packed: Mapping[str, Any] | None = None,
        estimated: NDArray[np.bool_] | None = None,
    ) -> SweepBatch:
        """Simulate sweeps whose object moves; of engines that take :attr:`batches` alone.

        Results do not depend on which sweeps come together, nor on their order; ordered by object they are fastest.
        ``workers`` are threads on the CPU, one when None; ``packed`` is what :meth:`pack` made of objects, by name.
        ``estimated`` [sweep] says whose whiskers get an error.
        """
        raise NotImplementedError(f"The engine {self.name!r} takes sweeps as single scenes.")
