"""The ``rod`` backend: our own whisker solver, one source for processors and NVIDIA GPUs."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device, usable_processors
from brainbench.core.progress import Progress as NamedProgress
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.job_pool import run_groups
from brainbench.stimuli.engines.planarity import stays_in_plane
from brainbench.stimuli.engines.protocol import Job, Progress, Trace, WhiskerEngine
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.launch import LaunchResult, WhiskerSolver, real_type
from brainbench.stimuli.engines.rod.limits import WIDEST
from brainbench.stimuli.engines.rod.packing import KNOT, PackedJobs, PackedMotions, capacity_for, follicle_knots
from brainbench.stimuli.engines.rod.shapes import PackedShapes
from brainbench.stimuli.engines.stepping import is_silent, silent_trace
from brainbench.stimuli.engines.sweep_batch import SweepBatch
from brainbench.stimuli.engines.trust import check_jobs, run_with_retries, step_travel
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
from brainbench.stimuli.whiskers.chain import Chain

SLICE = 65_536
"""Whiskers of one launch on a GPU: bounds the memory of a run."""


@dataclass(frozen=True)
class RodEngine(WhiskerEngine):
    """Runs whisker jobs in our own solver.

    Raises:
        UsageError: the device is unknown, or ``cuda`` is asked for where there is none.
        MissingDependencyError: warp-lang is not installed.
    """

    device: str = "auto"
    """``cpu`` or ``cuda``; ``auto``: ``cpu``, or ``cuda`` where Warp cannot compile for processors."""
    retry: int = 5

    name = "rod"
    package = "warp-lang"
    devices = ("cpu", "cuda")
    solvers = ("dynamic", "quasistatic")
    twists = True
    surfaces = True
    retries = True
    batches = True

    def prepare(self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None) -> None:
        """Load the kernels for these arc lengths [m]; all that this machine has not compiled yet at once."""
        device = pick_device(self.device)
        if device.is_cuda:  # which kernels are needed depends on what there is to touch
            return
        sizes = sorted({capacity_for(fidelity.link_count(length)) for length in lengths})

        def load(capacity: int) -> None:
            what = f"compiling the whisker solver for {capacity} links (once; it is kept)"
            tell = progress or (lambda done, total, what: None)
            real = real_type(fidelity)
            hinges = 2 + (fidelity.twist is not False)
            load_kernels(
                device, real, capacity, hinges=hinges, compiling=lambda begins: tell(0 if begins else 1, 1, what)
            )

        with ThreadPoolExecutor(max_workers=max(1, len(sizes))) as pool:
            list(pool.map(load, sizes))

    def run(
        self,
        jobs: Sequence[Job],
        fidelity: Fidelity,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        record_shape: bool = False,
    ) -> list[Trace]:
        """Simulate every job; see :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run`.

        On a GPU ``workers`` means nothing.
        """
        check_jobs(self, jobs, fidelity, workers)
        device = pick_device(self.device)
        groups: dict[Any, list[int]] = {}
        for index, job in enumerate(jobs):
            links = fidelity.link_count(job.whisker.arc_length)
            key = (capacity_for(links), job.times.tobytes(), job.start, tuple(job.gravity))
            groups.setdefault(key, []).append(index)
        size = SLICE if device.is_cuda else 1

        def run(group: Sequence[int]) -> dict[int, Trace]:
            return _simulate({i: jobs[i] for i in group}, self.retry, fidelity, device, record_shape)

        slices = [some[i : i + size] for some in groups.values() for i in range(0, len(some), size)]
        threads = 1 if device.is_cuda else workers or usable_processors()
        return run_groups(slices, run, threads=threads, progress=progress)

    def run_sweeps(
        self, scenes: SweepScenes, indices: Sequence[int], fidelity: Fidelity, *, workers: int | None = None
    ) -> SweepBatch:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        return SweepLauncher(scenes, fidelity, self.device).run(indices, self.retry, workers or 1)


@dataclass(frozen=True, eq=False)
class _Task:
    """A job that must be simulated."""

    job: Job
    reach: Reach
    times: NDArray[np.float64]
    """[n] s at which base and obstacles were looked at."""
    pose: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Base point [n, 3] (m) and angles [n, 3] (rad) at these times."""
    twists: bool
    """Whether it may leave its plane, and may twist at this fidelity."""


def _simulate(
    jobs: dict[int, Job], retry: int, fidelity: Fidelity, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run jobs that share their readings and their capacity in one launch, and return their traces."""
    first = next(iter(jobs.values()))
    stop = first.times[-1]
    # Base and obstacles are looked at about once per knot of their motion to find what is in reach.
    seen = np.linspace(first.start, stop, max(2, math.ceil((stop - first.start) / KNOT)))
    tasks: dict[int, _Task] = {}
    traces: dict[int, Trace] = {}
    for index, job in jobs.items():
        started = time.thread_time()
        position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(seen))
        reach = reachable(job.whisker, position, job.obstacles, seen, surfaces=True)
        if is_silent(job, reach, position, euler):
            traces[index] = silent_trace(job, fidelity, record_shape, time.thread_time() - started)
        else:
            twists = fidelity.twist is not False and not stays_in_plane(job, reach, position, euler, seen)
            tasks[index] = _Task(job, reach, seen, (position, euler), twists)
    for twists in (False, True):
        some = {index: task for index, task in tasks.items() if task.twists == twists}
        traces |= _simulate_alike(some, retry, fidelity, device, record_shape) if some else {}
    return traces


def _simulate_alike(
    tasks: dict[int, _Task], retry: int, fidelity: Fidelity, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run tasks of which all or none twist in one launch."""
    given, seconds = list(tasks.values()), np.zeros(len(tasks))

    def launch(which: NDArray[np.bool_] | None, finer: int) -> LaunchResult:
        rows = np.arange(len(given)) if which is None else np.flatnonzero(which[:, 0])
        result, spent = _launch([given[row] for row in rows], fidelity, device, record_shape, finer)
        seconds[rows] += spent / len(rows)
        return result

    result = run_with_retries(launch, retry)
    found = (_trace(result, row, task.job, fidelity, seconds[row]) for row, task in enumerate(given))
    return dict(zip(tasks, found, strict=True))


def _launch(
    tasks: Sequence[_Task], fidelity: Fidelity, device: Any, record_shape: bool, finer: int
) -> tuple[LaunchResult, float]:
    """Simulate tasks and return their results, a row each, with the processor time (s) that it took."""
    started = time.thread_time()
    first = tasks[0].job
    start, stop = first.start, float(first.times[-1])
    motions, shapes = PackedMotions(), PackedShapes()
    chains: dict[Any, Chain] = {}
    scenes: dict[Any, int] = {}
    places = []
    for task in tasks:
        job, obstacles = task.job, task.reach.obstacles
        if job.whisker not in chains:
            chains[job.whisker] = fidelity.chain(job.whisker)
        alike = tuple((id(item.motion), item.friction, *map(id, (item.surface, *item.parts))) for item in obstacles)
        if alike not in scenes:
            scenes[alike] = shapes.add_scene(obstacles, motions, start, stop)
        knots, spacing = follicle_knots(job.follicle, start, stop)
        base = motions.add(knots, start * MILLI, spacing)
        places.append((list(chains).index(job.whisker), scenes[alike], base))
    whisker, scene, base = np.array(places, dtype=np.int32).T
    count = len(tasks)
    row = np.arange(count, dtype=np.int32)
    packed = PackedJobs(whisker, scene, base, row, np.zeros_like(row), [task.job.loads for task in tasks])
    # Compiling is done once; it is no cost of a whisker.
    paused = time.thread_time()
    solver = WhiskerSolver(list(chains.values()), fidelity, device, shapes.needs, twists=tasks[0].twists)
    started += time.thread_time() - paused
    shortest = solver.shortest[whisker].tolist()
    fast = np.array([_too_fast(task, step) for task, step in zip(tasks, shortest, strict=True)])
    result = solver.launch(
        packed,
        motions,
        shapes,
        first.times,
        (count, 1),
        start=start,
        gravity=first.gravity,
        finer=finer,
        fast_at=fast[:, :1],
        travel=fast[:, 1:],
        record_shape=record_shape,
    )
    return result, time.thread_time() - started


def _too_fast(task: _Task, shortest: float) -> tuple[float, float]:
    """Return when (s) an object first moves further against the whisker in the shortest step (s) than contacts are
    looked for, inf if never, and how far (m).
    """
    spans = np.diff(task.times)
    share = np.divide(shortest, spans, out=np.zeros_like(spans), where=spans > 0)
    for obstacle in task.reach.obstacles:
        # Ways between knots, scaled to the shortest step that a retry may take.
        travel = step_travel(task.job.whisker, *task.pose, obstacle, task.times) * share
        if (travel > WIDEST / MILLI).any():
            first = int(np.argmax(travel > WIDEST / MILLI))
            return float(task.times[first]), float(travel[first])
    return math.inf, 0.0


def _trace(result: LaunchResult, row: int, job: Job, fidelity: Fidelity, seconds: float) -> Trace:
    """Return the trace of a job, NaN from where it cannot be trusted."""
    # Readings at the very moment of failure are not trusted either.
    good = job.times < result.verdict.until[row, 0] - 1e-9
    arc = result.contact[row, :, 0].astype(float)
    touching = (arc >= 0) & good
    reason = str(result.verdict.reasons[row, 0])
    shape, felt = result.points, result.contact_wrench
    nodes = fidelity.link_count(job.whisker.arc_length) + 1
    return Trace(
        wrench=np.where(good[:, None], result.wrench[row, :, 0].astype(float), np.nan),
        contact=touching,
        contact_arc=np.where(touching, arc, np.nan),
        penetration=float(result.depth[row, 0]),
        status="unstable" if reason else "ok",
        reason=reason,
        steps=int(result.steps[row, 0]),
        seconds=seconds,
        link_positions=None if shape is None else np.where(good[:, None, None], shape[row, :, :nodes], np.nan),
        contact_wrench=None if felt is None else np.where(good[:, None], felt[row], np.nan),
    )
