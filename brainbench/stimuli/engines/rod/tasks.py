"""What the ``rod`` solver needs of jobs: the chain, the tracks of base and objects, what is in reach, the steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import KNOT, Cutting
from brainbench.stimuli.engines.planarity import stays_in_plane
from brainbench.stimuli.engines.protocol import Job
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.engines.rod.launch import LaunchResult, WhiskerSolver
from brainbench.stimuli.engines.rod.limits import FINEST, WIDEST
from brainbench.stimuli.engines.rod.packing import (
    GRID,
    PackedJobs,
    PackedMotions,
    Track,
    body_track,
    follicle_track,
    still_track,
)
from brainbench.stimuli.engines.rod.shapes import PackedShapes, TrackedObstacle
from brainbench.stimuli.engines.stepping import is_silent
from brainbench.stimuli.engines.trust import step_travel
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.whiskers.chain import Chain


@dataclass(frozen=True, eq=False)
class JobTask:
    """A job that must be simulated, and what that needs."""

    job: Job
    chain: Chain
    base: Track
    bodies: tuple[TrackedObstacle, ...]
    """What is in reach."""
    indices: tuple[int, ...]
    """Which obstacles of the job these are."""
    names: tuple[int, ...]
    """What tells them from other bodies."""
    limit: NDArray[np.float64] | None
    """[cell] longest step from each cell of the motions on (s); None for any."""
    fast: tuple[float, float]
    """When (s) an object first moves further against the whisker in the shortest step than contacts are looked for, inf
    if never, and how far (m)."""
    twists: bool
    """Whether it may leave its plane, and may twist at this fidelity."""


def make_task(
    job: Job, fidelity: Fidelity, bodies: dict[Any, tuple[NDArray, Track]], *, silent: bool = False
) -> JobTask | None:
    """Return what a job needs of its scene, None when it feels nothing, unless ``silent`` jobs are wanted too.

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
    if not silent and is_silent(job, reach, position, euler):
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
    return JobTask(job, chain, base, near, reach.indices, names, limit, fast, twists)


@dataclass(frozen=True, eq=False)
class PackedTasks:
    """Tasks of one launch: those of one time and gravity, of which all or none twist."""

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
        fast = np.array([task.fast for task in self.tasks])
        return solver.launch(
            self.jobs,
            self.motions,
            self.shapes,
            first.times,
            (len(self.tasks), 1),
            start=first.start,
            gravity=first.gravity,
            fast_at=fast[:, :1],
            travel=fast[:, 1:],
            record_shape=record_shape,
        )


def _too_fast(
    job: Job, reach: Reach, pose: tuple[NDArray, NDArray], times: NDArray, shortest: NDArray
) -> tuple[float, float]:
    """Return :attr:`JobTask.fast` from the base's ``pose`` at ``times`` [n] (s) and the shortest steps [n − 1] (s)."""
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
