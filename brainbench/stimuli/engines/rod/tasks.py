"""What the ``rod`` solver needs of jobs: the chain, the tracks of base and objects, what is in reach, the steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import KNOT, Cutting
from brainbench.stimuli.engines.reach import Reach, reachable, stays_in_plane
from brainbench.stimuli.engines.rod.launch import Approach, Launch, LaunchResult, WhiskerSolver
from brainbench.stimuli.engines.rod.limits import FINEST, WIDEST
from brainbench.stimuli.engines.rod.packing import (
    GRID,
    PackedJobs,
    PackedMotions,
    PackedShapes,
    Track,
    TrackedObstacle,
    body_track,
    follicle_track,
    still_track,
)
from brainbench.stimuli.engines.stepping import is_silent
from brainbench.stimuli.engines.trust import BLOW, BLOW_STRIDE, HARD_BLOW, near_travel, step_travel
from brainbench.stimuli.motion.jobs import MILLI, Job
from brainbench.stimuli.whiskers.whisker import Chain


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
    """Identities of their tracks, surfaces and parts: jobs with the same ones share a scene."""
    limit: NDArray[np.float64] | None
    """[cell] longest step from each cell of the motions on (s); None for any."""
    approach: Approach
    twists: bool
    """Whether it may leave its plane, and may twist at this fidelity."""

    @property
    def kind(self) -> tuple[bool, bool]:
        """Whether it twists, and whether its follicle gives way: tasks of one launch are alike."""
        return self.twists, self.job.whisker.follicle is not None


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
    place = tuple((np.round(base.knots["place"][0] / GRID) * GRID / MILLI).tolist())
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
        np.concatenate([track.times for track in (base, *(bodies[id(obstacle)][1] for obstacle in moving))] + [ends])
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
    steps = np.full(len(seen) - 1, step)
    if limit is not None:
        steps = limit[np.clip(((seen[:-1] - start) / KNOT).astype(int), 0, len(limit) - 1)]
    approach = _approach(job, reach, (position, euler), seen, steps, step)
    twists = fidelity.twist is not False and not stays_in_plane(job, reach, position, euler, seen)
    return JobTask(job, chain, base, near, reach.indices, names, limit, approach, twists)


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
        given = Launch(
            self.jobs,
            self.motions,
            self.shapes,
            first.times,
            (len(self.tasks), 1),
            start=first.start,
            gravity=first.gravity,
            approach=Approach.table([task.approach for task in self.tasks]),
            record_shape=record_shape,
        )
        return solver.launch(given)


def followed(
    speed: NDArray[np.float64], blow: NDArray[np.float64], step: NDArray[np.float64], radius: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ways (m) of objects in a step (s), and up to which way contact is followed.

    ``speed`` (m/s) is that against any point of the whisker, ``blow`` that against its base while the object is near.
    """
    # The shortest step that contacts may ask for finds them; blows are cut to one way by it, whose force is not right.
    stride = np.multiply(BLOW_STRIDE, radius)
    hard = (blow > HARD_BLOW) & (blow * step > stride)
    return np.where(hard, blow * step, speed * step / FINEST), np.where(hard, stride, WIDEST / MILLI)


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
        travel = step_travel(job.whisker, *pose, obstacle, times) if moves else resting
        speed = travel / np.diff(times)
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
