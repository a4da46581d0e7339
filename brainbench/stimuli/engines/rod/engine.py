"""The ``rod`` backend: our own whisker solver, one source for processors and NVIDIA GPUs."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device, usable_processors, warp
from brainbench.core.progress import Progress as NamedProgress
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.job_pool import run_groups
from brainbench.stimuli.engines.motion_pieces import KNOT, Cutting
from brainbench.stimuli.engines.planarity import stays_in_plane
from brainbench.stimuli.engines.protocol import Job, Progress, Trace, WhiskerEngine
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.engines.rod.compilation import load_kernels
from brainbench.stimuli.engines.rod.launch import LaunchResult, WhiskerSolver, real_type
from brainbench.stimuli.engines.rod.limits import AHEAD, FINEST, WIDEST
from brainbench.stimuli.engines.rod.packing import (
    GRID,
    PackedJobs,
    PackedMotions,
    Track,
    body_track,
    capacity_for,
    follicle_track,
    still_track,
)
from brainbench.stimuli.engines.rod.shapes import PackedShapes, PackedSurface, TrackedObstacle
from brainbench.stimuli.engines.stepping import is_silent, silent_trace
from brainbench.stimuli.engines.sweep_batch import SweepBatch
from brainbench.stimuli.engines.trust import Try, check_jobs, run_with_retries, step_travel
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.objects.solid import Solid
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

    def prepare_sweeps(self, scenes: SweepScenes, fidelity: Fidelity) -> None:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.prepare_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        device = pick_device(self.device)
        if not device.is_cuda:  # its kernel takes a second
            return
        if device.is_mempool_supported:
            # Shards come and go; what went back to the system at every wait would have to be asked for anew.
            warp().set_mempool_release_threshold(device, 0.8)
        SweepLauncher(scenes, fidelity, self.device).solver.free()

    def pack(self, solid: Solid) -> tuple[float, PackedSurface]:
        """See :func:`brainbench.stimuli.engines.rod.sweeps.pack_object`."""
        from brainbench.stimuli.engines.rod.sweeps import pack_object

        return pack_object(solid)

    def run_sweeps(
        self,
        scenes: SweepScenes,
        indices: Sequence[int],
        fidelity: Fidelity,
        *,
        workers: int | None = None,
        packed: Mapping[str, Any] | None = None,
    ) -> SweepBatch:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        launcher = SweepLauncher(scenes, fidelity, self.device, packed=packed)
        batch = launcher.run(indices, self.retry, workers or 1)
        launcher.solver.free()
        return batch


@dataclass(frozen=True, eq=False)
class _Task:
    """A job that must be simulated."""

    job: Job
    chain: Chain
    base: Track
    bodies: tuple[TrackedObstacle, ...]
    """What is in reach."""
    names: tuple[int, ...]
    """What tells these from other bodies."""
    limit: NDArray[np.float64] | None
    """[cell] longest step from each cell of the motions on (s); None for any."""
    fast: tuple[float, float]
    """When (s) an object first moves further against the whisker in the shortest step than contacts are looked for, inf
    if never, and how far (m)."""
    twists: bool
    """Whether it may leave its plane, and may twist at this fidelity."""


def _simulate(
    jobs: dict[int, Job], retry: int, fidelity: Fidelity, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run jobs that share their readings and their capacity in one launch, and return their traces."""
    tasks: dict[int, _Task] = {}
    traces: dict[int, Trace] = {}
    bodies: dict[Any, tuple[NDArray, Track]] = {}
    spent: dict[int, float] = {}
    for index, job in jobs.items():
        started = time.thread_time()
        task = _task(job, fidelity, bodies)
        if task is None:
            traces[index] = silent_trace(job, fidelity, record_shape, time.thread_time() - started)
        else:
            tasks[index] = task
            spent[index] = time.thread_time() - started
    for twists in (False, True):
        some = {index: task for index, task in tasks.items() if task.twists == twists}
        seconds = np.array([spent[index] for index in some])
        traces |= _simulate_alike(some, seconds, retry, fidelity, device, record_shape) if some else {}
    return traces


def _simulate_alike(
    tasks: dict[int, _Task], seconds: NDArray, retry: int, fidelity: Fidelity, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run tasks of which all or none twist in one launch; ``seconds`` [task] is the processor time of each so far."""
    given = list(tasks.values())

    def launch(tries: Sequence[Try]) -> list[LaunchResult]:
        parts = [np.arange(len(given)) if which is None else np.flatnonzero(which[:, 0]) for which, _ in tries]
        rows, counts = np.concatenate(parts), [len(part) for part in parts]
        finer = np.repeat([divisor for _, divisor in tries], counts)
        result, spent = _launch([given[row] for row in rows], fidelity, device, record_shape, finer)
        np.add.at(seconds, rows, spent / len(rows))
        return result.split(counts)

    result = run_with_retries(launch, retry, ahead=AHEAD[device.is_cuda])
    found = (_trace(result, row, task.job, fidelity, seconds[row]) for row, task in enumerate(given))
    return dict(zip(tasks, found, strict=True))


def _task(job: Job, fidelity: Fidelity, bodies: dict[Any, tuple[NDArray, Track]]) -> _Task | None:
    """Return what a job needs of its scene, None when it feels nothing.

    ``bodies`` keeps anchor and track of obstacles that move by their id, of what stands still by its place.
    """
    start, stop = job.start, float(job.times[-1])
    chain = fidelity.chain(job.whisker)
    step = fidelity.step_of(chain)
    cutting = Cutting(start, stop, step, fidelity.time_step)
    base = follicle_track(job.follicle, job.whisker.arc_length, cutting)

    # All that stands still is one body, near the base of the whisker and of its neighbours.
    place = tuple((np.round(base.knots[0, :3] / GRID) * GRID / MILLI).tolist())
    if place not in bodies:
        bodies[place] = np.array(place), still_track(np.array(place))
    moving = [obstacle for obstacle in job.obstacles if obstacle.motion is not None]
    for obstacle in moving:
        if id(obstacle) not in bodies:
            anchor = obstacle.bounds.mean(axis=0)
            bodies[id(obstacle)] = anchor, body_track(obstacle, anchor, cutting)
    # What moves is looked at wherever its motion, or that of the base, has a knot.
    ends = np.array([start, stop])
    seen = np.unique(
        np.concatenate([track.times for track in (base, *(bodies[id(item)][1] for item in moving))] + [ends])
    )
    position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(seen))
    reach = reachable(job.whisker, position, job.obstacles, seen, surfaces=True)
    if is_silent(job, reach, position, euler):
        return None
    near = tuple(
        TrackedObstacle(obstacle, *bodies[place if obstacle.motion is None else id(job.obstacles[which])])
        for which, obstacle in zip(reach.indices, reach.obstacles, strict=True)
    )
    names = tuple(
        id(part)
        for body in near
        for part in (body.track, body.obstacle.friction, body.obstacle.surface, *body.obstacle.parts)
    )
    per_period = fidelity.steps_per_period if fidelity.solver == "dynamic" else None
    pieces = [track.pieces for track in (base, *(body.track for body in near)) if track.pieces is not None]
    limits = [some.longest_steps(step, per_period) for some in pieces if some.needed.max() > 1]
    limit = np.min(limits, axis=0) if limits else None
    shortest = np.full(len(seen) - 1, step)
    if limit is not None:
        shortest = limit[np.clip(((seen[:-1] - start) / KNOT).astype(int), 0, len(limit) - 1)]
    fast = _too_fast(job, reach, (position, euler), seen, shortest / FINEST)
    twists = fidelity.twist is not False and not stays_in_plane(job, reach, position, euler, seen)
    return _Task(job, chain, base, near, names, limit, fast, twists)


def _launch(
    tasks: Sequence[_Task], fidelity: Fidelity, device: Any, record_shape: bool, finer: NDArray[np.integer]
) -> tuple[LaunchResult, float]:
    """Simulate tasks and return their results, a row each, with the processor time (s) that it took.

    ``finer`` [task] divides their steps.
    """
    started = time.thread_time()
    first = tasks[0].job
    motions, shapes = PackedMotions(), PackedShapes()
    chains: dict[Any, Chain] = {}
    scenes: dict[Any, int] = {}
    places = []
    for task in tasks:
        chains.setdefault(task.job.whisker, task.chain)
        if task.names not in scenes:
            scenes[task.names] = shapes.add_scene(task.bodies, motions)
        places.append((list(chains).index(task.job.whisker), scenes[task.names], motions.add(task.base)))
    whisker, scene, base = np.array(places, dtype=np.int32).T
    count = len(tasks)
    row = np.arange(count, dtype=np.int32)
    loads, limits = [task.job.loads for task in tasks], [task.limit for task in tasks]
    packed = PackedJobs(whisker, scene, base, row, np.zeros_like(row), finer, loads, limits)
    # Compiling is done once; it is no cost of a whisker.
    paused = time.thread_time()
    solver = WhiskerSolver(list(chains.values()), fidelity, device, shapes.needs, twists=tasks[0].twists)
    started += time.thread_time() - paused
    fast = np.array([task.fast for task in tasks])
    result = solver.launch(
        packed,
        motions,
        shapes,
        first.times,
        (count, 1),
        start=first.start,
        gravity=first.gravity,
        fast_at=fast[:, :1],
        travel=fast[:, 1:],
        record_shape=record_shape,
    )
    return result, time.thread_time() - started


def _too_fast(
    job: Job, reach: Reach, pose: tuple[NDArray, NDArray], times: NDArray, shortest: NDArray
) -> tuple[float, float]:
    """Return :attr:`_Task.fast` from the base's ``pose`` at ``times`` [n] (s) and the shortest steps [n − 1] (s)."""
    share = shortest / np.diff(times)
    still = [obstacle for obstacle in reach.obstacles if obstacle.motion is None]
    # Against all that stands still the whisker moves alike.
    for obstacle in [*still[:1], *(obstacle for obstacle in reach.obstacles if obstacle.motion is not None)]:
        # Ways between knots, scaled to the shortest step that a retry may take.
        travel = step_travel(job.whisker, *pose, obstacle, times) * share
        if (travel > WIDEST / MILLI).any():
            first = int(np.argmax(travel > WIDEST / MILLI))
            return float(times[first]), float(travel[first])
    return math.inf, 0.0


def _trace(result: LaunchResult, row: int, job: Job, fidelity: Fidelity, seconds: float) -> Trace:
    """Return the trace of a job, NaN from where it cannot be trusted."""
    # Readings at the very moment of failure are not trusted either.
    good = job.times < result.verdict.until[row, 0] - 1e-9
    arc = result.contact[row, :, 0].astype(float)
    touching = (arc >= 0) & good
    reason = str(result.verdict.reasons[row, 0])
    shape, felt = result.points, result.contact_wrench
    base = np.asarray(job.follicle.pose(job.times)[0], dtype=float)[:, None]
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
        link_positions=None if shape is None else np.where(good[:, None, None], base + shape[row, :, :nodes], np.nan),
        contact_wrench=None if felt is None else np.where(good[:, None], felt[row], np.nan),
    )
