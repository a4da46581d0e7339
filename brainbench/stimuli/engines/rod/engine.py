"""The ``rod`` backend: our own whisker solver, one source for processors and NVIDIA GPUs.

A job becomes a task of the solver: the chain, the tracks of base and objects, what is in reach, the steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import pick_device, warp
from brainbench.core.progress import Progress as NamedProgress
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.error_estimates import MORE, MOST
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import KNOT, LOOKS, Cutting
from brainbench.stimuli.engines.protocol import PassiveSweeps, SweepBatch, WhiskerEngine
from brainbench.stimuli.engines.reach import Reach, reachable, stays_in_plane
from brainbench.stimuli.engines.rod.launch import (
    Approach,
    Launch,
    LaunchResult,
    Try,
    WhiskerSolver,
    followed,
    load_kernels,
    real_type,
    run_with_retries,
)
from brainbench.stimuli.engines.rod.packing import (
    GRID,
    PackedJobs,
    PackedMotions,
    PackedShapes,
    PackedSurface,
    Track,
    TrackedObstacle,
    body_track,
    capacity_for,
    follicle_track,
    still_track,
)
from brainbench.stimuli.engines.stepping import is_silent, silent_trace
from brainbench.stimuli.engines.trust import BLOW, near_travel, step_travel, without_escape
from brainbench.stimuli.motion.jobs import MILLI, Job, Trace
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.whiskers.whisker import Chain


@dataclass(frozen=True, eq=False)
class JobTask:
    """A job that must be simulated, and what that needs."""

    job: Job
    base: Track
    bodies: tuple[TrackedObstacle, ...]
    """What is in reach."""
    indices: tuple[int, ...]
    """Which obstacles of the job these are."""
    names: tuple[int, ...]
    """Identities of their tracks, surfaces and parts: jobs with the same ones share a scene."""
    twists: bool
    """Whether it may leave its plane, and may twist at this fidelity."""
    chain: Chain
    fidelity: Fidelity
    """With what contacts touch, by what is within reach: nothing else changes a force."""
    limit: NDArray[np.float64] | None = None
    """[cell] longest step from each cell of the motions on (s); None for any."""
    approach: Approach = field(default_factory=Approach)

    @property
    def kind(self) -> tuple[bool, ...]:
        """Whether it twists, feels air, has a follicle that gives way, bends in space, touches as the bent rod does.

        Tasks of a launch are alike.
        """
        whisker, smooth = self.job.whisker, self.fidelity.contact_line == "rod"
        return self.twists, self.job.air_flow is not None, whisker.follicle is not None, bool(whisker.bends), smooth

    def at(self, fidelity: Fidelity) -> JobTask:
        """Return the task with the links and steps of a fidelity."""
        chain = fidelity.chain(self.job.whisker)
        step, per_period = fidelity.step_of(chain), fidelity.steps_per_period if fidelity.solver == "dynamic" else None
        tracks = self.base, *(body.track for body in self.bodies)
        pieces = [track.pieces for track in tracks if track.pieces is not None and track.pieces.needed.max() > 1]
        limits = [some.longest_steps(step, per_period) for some in pieces]
        limit = np.min(limits, axis=0) if limits else None
        return replace(self, chain=chain, fidelity=fidelity.touching(self.bodies), limit=limit)


def make_task(job: Job, fidelity: Fidelity, bodies: dict[Any, Any], *, silent: bool = False) -> JobTask | None:
    """Return what a job needs of its scene, None when it feels nothing, unless ``silent`` jobs are wanted too.

    ``bodies`` keeps tasks of jobs, tracks of bases, and anchor and track of obstacles that move, by their ids and how
    they are looked at, and those of what stands still by its place.
    """
    start, stop = job.start, float(job.times[-1])
    chain = fidelity.chain(job.whisker)
    step = fidelity.step_of(chain)
    # Finer simulations of a whisker look at its motions in the same steps and cells.
    cells = max(1, math.ceil(fidelity.time_step / KNOT - 1e-9))
    cutting = Cutting(start, stop, min(step, KNOT / LOOKS), KNOT * cells)
    met = id(job), cutting, fidelity.twist is not False
    if met in bodies:
        return bodies[met].at(fidelity)
    mount = id(job.follicle), job.whisker.arc_length, cutting
    if mount not in bodies:
        bodies[mount] = follicle_track(job.follicle, job.whisker.arc_length, cutting)
    base = bodies[mount]

    # All that stands still is one body, near the base of the whisker and of its neighbours.
    place = tuple((np.round(base.knots["place"][0] / GRID) * GRID / MILLI).tolist())
    if place not in bodies:
        bodies[place] = np.array(place), still_track(np.array(place))
    keys = [place if obstacle.motion is None else (id(obstacle), cutting) for obstacle in job.obstacles]
    for key, obstacle in zip(keys, job.obstacles, strict=True):
        if key not in bodies:
            anchor = obstacle.bounds.mean(axis=0)
            bodies[key] = anchor, body_track(obstacle, anchor, cutting)
    # What moves is looked at wherever its motion, or that of the base, has a knot.
    tracks = base, *(bodies[key][1] for key in keys)
    seen = np.unique(np.concatenate([[start, stop], *(track.times for track in tracks)]))
    position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(seen))
    reach = reachable(job.whisker, position, job.obstacles, seen, surfaces=True)
    if not silent and is_silent(job, reach, position, euler):
        return None
    near = tuple(
        TrackedObstacle(each, *bodies[keys[i]]) for i, each in zip(reach.indices, reach.obstacles, strict=True)
    )
    names = tuple(
        id(part)
        for body in near
        for part in (body.track, body.obstacle.friction, body.obstacle.surface, *body.obstacle.parts)
    )
    twists = fidelity.twist is not False and not stays_in_plane(job, reach, position, euler, seen)
    task = JobTask(job, base, near, reach.indices, names, twists, chain, fidelity).at(fidelity)
    cells = ((seen[:-1] - start) / KNOT).astype(int)
    steps = np.full(len(cells), step) if task.limit is None else task.limit[cells.clip(0, len(task.limit) - 1)]
    # Finer simulations have this too: none begins where an object is too fast.
    bodies[met] = replace(task, approach=_approach(job, reach, (position, euler), seen, steps, step))
    return bodies[met]


@dataclass(frozen=True, eq=False)
class PackedTasks:
    """Tasks of one launch: those of one time, gravity and air flow, of which all or none twist."""

    tasks: Sequence[JobTask]
    chains: list[Chain]
    jobs: PackedJobs
    motions: PackedMotions
    shapes: PackedShapes

    @classmethod
    def of(
        cls, tasks: Sequence[JobTask], finer: NDArray[np.integer] | None = None, *, shared: bool = True
    ) -> PackedTasks:
        """Pack tasks whose steps ``finer`` [task] divides (1 when None).

        Unless ``shared``, each has shapes and tracks of its own even where these are the same.
        """
        motions, shapes = PackedMotions(), PackedShapes()
        chains: dict[Any, Chain] = {}
        scenes: dict[Any, int] = {}
        places = []
        for task in tasks:
            chains.setdefault(task.job.whisker, task.chain)
            if not shared or task.names not in scenes:
                scenes[task.names] = shapes.add_scene(task.bodies, motions)
            places.append((list(chains).index(task.job.whisker), scenes[task.names], motions.add(task.base)))
        whisker, scene, base = np.array(places, dtype=np.int32).T
        row = np.arange(len(tasks), dtype=np.int32)
        divisors = np.ones_like(row) if finer is None else finer
        loads, limits = [task.job.loads for task in tasks], [task.limit for task in tasks]
        jobs = PackedJobs(whisker, scene, base, row, np.zeros_like(row), divisors, loads, limits)
        return cls(tasks, list(chains.values()), jobs, motions, shapes)

    def launch(self, solver: WhiskerSolver, *, record_shape: bool) -> LaunchResult:
        """Simulate the tasks in a solver of :attr:`chains`; a row of results each."""
        first = self.tasks[0].job
        given = Launch(
            self.jobs,
            self.motions,
            self.shapes,
            first.times,
            (len(self.tasks), 1),
            start=first.start,
            gravity=first.gravity,
            air_flow=first.air_flow,
            approach=Approach.table([task.approach for task in self.tasks]),
            record_shape=record_shape,
        )
        return solver.launch(given)


def _approach(
    job: Job, reach: Reach, pose: tuple[NDArray, NDArray], times: NDArray, steps: NDArray, step: float
) -> Approach:
    """Return how the objects within reach come, from the base's ``pose`` at ``times`` [n] (s).

    ``steps`` [n − 1] (s) are the longest there, ``step`` is the longest of the whisker.
    """
    still = next((obstacle for obstacle in reach.obstacles if obstacle.motion is None), None)
    # Against all that stands still, such as the parts of one object, the whisker moves alike.
    resting, struck = None if still is None else step_travel(job.whisker, *pose, still, times), False
    for obstacle in reach.obstacles:
        moves = resting is None or obstacle.motion is not None
        speed = (step_travel(job.whisker, *pose, obstacle, times) if moves else resting) / np.diff(times)
        blow = np.zeros_like(speed)
        if speed.max(initial=0.0) > BLOW:
            # Without the turns of the base, which are those of whisking. Steps that a brief motion shortens follow it.
            blow = near_travel(job.whisker, pose[0], np.zeros_like(pose[1]), obstacle, times) / np.diff(times)
            struck |= bool((blow > BLOW).any())
            blow[steps < step] = 0.0
        way, farthest = followed(speed, blow, steps, job.whisker.base_radius)
        if (way > farthest).any():
            first = int(np.argmax(way > farthest))
            return Approach(float(way[first]), float(farthest[first]), float(times[first]), struck)
    return Approach(struck=struck)


SLICE = 65_536
"""Whiskers of one launch on a GPU: bounds the memory of a run."""
GROUP_STEPS = 10_000
"""Steps of the whiskers of one launch on a processor, some .1 s: how long an interrupt may have to wait for them."""


@dataclass(frozen=True)
class RodEngine(WhiskerEngine):
    """Runs whisker jobs in our own solver."""

    device: str = "auto"
    """``cpu`` or ``cuda``; ``auto``: ``cpu``, or ``cuda`` where Warp cannot compile for processors."""
    retry: int = 5

    name = "rod"
    package = "warp-lang"
    devices = ("cpu", "cuda")
    solvers = ("dynamic", "quasistatic")
    twists = True
    yields = True
    flows = True
    smooth = True
    coils = True
    surfaces = True
    batches = True

    def prepare(self, lengths: Iterable[float], fidelity: Fidelity, *, progress: NamedProgress | None = None) -> None:
        """Load the kernels for these arc lengths [m]; all that this machine has not compiled yet at once."""
        device = pick_device(self.device)
        if device.is_cuda:  # which kernels are needed depends on what there is to touch
            return
        counts = {fidelity.link_count(length) for length in lengths}
        if self.errors:  # whiskers in contact are simulated with more links too
            counts |= {min(math.ceil(MORE * count), MOST) for count in counts}
        sizes = sorted(set(map(capacity_for, counts)))

        def load(capacity: int) -> None:
            """Load the kernels for so many links, and tell the progress where they have to be compiled."""
            what = f"compiling the whisker solver for {capacity} links (once; it is kept)"
            tell = progress or (lambda done, total, what: None)
            real = real_type(fidelity)
            load_kernels(
                device,
                real,
                capacity,
                hinges=2 + (fidelity.twist is not False),
                features=("smooth",) if fidelity.contact_line == "rod" else (),
                compiling=lambda begins: tell(0 if begins else 1, 1, what),
            )

        with ThreadPoolExecutor(max_workers=max(1, len(sizes))) as pool:
            list(pool.map(load, sizes))

    def threads(self, workers: int | None) -> int:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.threads`; one on a GPU."""
        return 1 if pick_device(self.device).is_cuda else super().threads(workers)

    def groups(self, jobs: Sequence[Job], fidelity: Fidelity, threads: int) -> list[list[int]]:
        """Return jobs with the same readings and capacity together, on a processor a few of them.

        These share setting up, which costs a processor more than a short simulation. All threads get several groups,
        and none of more than :data:`GROUP_STEPS`.
        """
        groups: dict[Any, list[int]] = {}
        for index, job in enumerate(jobs):
            links = fidelity.link_count(job.whisker.arc_length)
            key = (capacity_for(links), job.times.tobytes(), job.start, tuple(job.gravity), job.air_flow)
            groups.setdefault(key, []).append(index)
        parts, cuda = [], pick_device(self.device).is_cuda
        for some in groups.values():
            size = SLICE
            if not cuda:
                job = jobs[some[0]]
                shortest = min(fidelity.step_of(fidelity.chain(jobs[index].whisker)) for index in some)
                most = GROUP_STEPS * shortest / (float(job.times[-1]) - job.start + shortest)
                size = max(1, min(len(some) // (3 * threads), int(most)))
            parts += [some[first : first + size] for first in range(0, len(some), size)]
        return parts

    def simulate_group(self, jobs: Sequence[Job], fidelity: Fidelity, *, record_shape: bool) -> list[Trace]:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.simulate_group`: a launch for each kind."""
        traces: dict[int, Trace] = {}
        tasks: dict[Any, dict[int, JobTask]] = {}
        seconds = np.zeros(len(jobs))
        for index, job in enumerate(jobs):
            started = time.thread_time()
            task = make_task(job, fidelity, self.motions)
            seconds[index] = time.thread_time() - started
            if task is None:
                traces[index] = silent_trace(job, fidelity, record_shape, seconds[index])
            else:
                tasks.setdefault(task.kind, {})[index] = task
        for _, alike in sorted(tasks.items()):
            traces |= _simulate(alike, seconds[list(alike)], self.retry, pick_device(self.device), record_shape)
        return [traces[index] for index in range(len(jobs))]

    def prepare_sweeps(self, scenes: PassiveSweeps, fidelity: Fidelity) -> None:
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.prepare_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        device = pick_device(self.device)
        if not device.is_cuda:  # its kernel takes a second
            return
        if device.is_mempool_supported:
            # Shards come and go; what went back to the system at every wait would have to be asked for anew.
            warp().set_mempool_release_threshold(device, 0.8)
        SweepLauncher(scenes, fidelity, self.device).free()

    def pack(self, solid: Solid) -> tuple[float, PackedSurface]:
        """See :func:`brainbench.stimuli.engines.rod.sweeps.pack_object`."""
        from brainbench.stimuli.engines.rod.sweeps import pack_object

        return pack_object(solid)

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
        """See :meth:`brainbench.stimuli.engines.protocol.WhiskerEngine.run_sweeps`."""
        from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

        launcher = SweepLauncher(scenes, fidelity, self.device, packed=packed)
        batch = launcher.run(indices, self.retry, workers or 1, estimated)
        launcher.free()
        return batch


def _simulate(
    tasks: dict[int, JobTask], seconds: NDArray, retry: int, device: Any, record_shape: bool
) -> dict[int, Trace]:
    """Run tasks of one kind in one launch; ``seconds`` [task] is the processor time of each so far."""
    given = list(tasks.values())
    fidelity = given[0].fidelity

    def launch(tries: Sequence[Try]) -> list[LaunchResult]:
        """Return the result of each try, all from one launch, and count its processor time to its tasks."""
        parts = [np.arange(len(given)) if which is None else np.flatnonzero(which[:, 0]) for which, _ in tries]
        rows, counts = np.concatenate(parts), [len(part) for part in parts]
        finer = np.repeat([divisor for _, divisor in tries], counts)
        started = time.thread_time()
        packed = PackedTasks.of([given[row] for row in rows], finer)
        # Compiling is done once; it is no cost of a whisker.
        paused = time.thread_time()
        make = _solver_of if device.is_cpu else _solver_of.__wrapped__
        solver = make(tuple(packed.chains), fidelity, str(device), packed.shapes.needs, *given[0].kind[:2])
        started += time.thread_time() - paused
        result = packed.launch(solver, record_shape=record_shape)
        np.add.at(seconds, rows, (time.thread_time() - started) / len(rows))
        return result.split(counts)

    result = run_with_retries(launch, retry)
    traces = (trace_of(result, row, task.job, fidelity, seconds[row]) for row, task in enumerate(given))
    return dict(zip(tasks, traces, strict=True))


@lru_cache(maxsize=256)
def _solver_of(chains: tuple[Chain, ...], fidelity: Fidelity, device: str, needs: int, *kind: bool) -> WhiskerSolver:
    """Return a solver; on a processor, where setting up costs as much as simulating 20 ms, callers share it."""
    return WhiskerSolver(chains, fidelity, pick_device(device), needs, twists=kind[0], flows=kind[1])


def trace_of(result: LaunchResult, row: int, job: Job, fidelity: Fidelity, seconds: float) -> Trace:
    """Return the trace of a job, NaN from where it cannot be trusted."""
    # Readings at the very moment of failure are not trusted either.
    good = job.times < result.verdict.until[row, 0] - 1e-9
    arc = result.contact[row, :, 0].astype(float)
    touching = (arc >= 0) & good
    reason = without_escape(str(result.verdict.reasons[row, 0]), job, float(result.verdict.until[row, 0]))
    shape, felt = result.points, result.contact_wrench
    displacement = None
    if result.displacement is not None:
        displacement = np.where(good[:, None], result.displacement[row, :, 0].astype(float), np.nan)
    if shape is not None:
        position, euler = (np.asarray(values, dtype=float) for values in job.follicle.pose(job.times))
        if displacement is not None:
            position = position + np.einsum("nij,nj->ni", base_rotation(euler), displacement[:, :3])
        nodes = position[:, None] + shape[row, :, : fidelity.link_count(job.whisker.arc_length) + 1]
        shape = np.where(good[:, None, None], nodes, np.nan)
    return Trace(
        wrench=np.where(good[:, None], result.wrench[row, :, 0].astype(float), np.nan),
        contact=touching,
        contact_arc=np.where(touching, arc, np.nan),
        penetration=float(result.depth[row, 0]),
        status="unstable" if reason else "ok",
        reason=reason,
        steps=int(result.steps[row, 0]),
        divisor=int(result.divisor[row, 0]),
        unsolved=int(result.counts["unsolved"][row, 0]),
        displacement=displacement,
        seconds=seconds,
        link_positions=shape,
        contact_wrench=None if felt is None else np.where(good[:, None], felt[row], np.nan),
    )
