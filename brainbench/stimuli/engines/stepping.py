"""Jobs that need no simulation, jobs in equal time steps, and engines that take these. Letters: n frame, s step."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from brainbench.core.rotations import base_rotation, to_matrices
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import Cutting
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.engines.reach import Reach, reachable, to_obstacle_frame
from brainbench.stimuli.engines.trust import (
    AT_BASE,
    GOT_INSIDE,
    LARGEST_OVERLAP,
    LARGEST_START_OVERLAP,
    STARTED_INSIDE,
    fault,
    passed_unseen,
    without_escape,
)
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.whisker import Chain

LEAST_TAPER = 1e-6
"""Difference of the radii of a link's ends (mm) below which it is a capsule."""
_SIDES = 8


# The collision shape of a tapered link is a slim cone with a margin. A staircase of capsules turns the force of a peg
# that sits on a step dr by up to √(2 dr/R). The cone has the taper as its surface and the margin rounds it, so its
# facets are smaller than dr and do not matter.
def cone_vertices(core: float, length: float, *, narrows: bool) -> NDArray[np.float64]:
    """Return the vertices [9, 3] (mm) of the cone inside a link along x, ``core`` (mm) being the radius of its base.

    It ``narrows`` when the link is thinner at its end than at its start.
    """
    # Eight sides: a facet lies at most 8 % of ``core``, a difference of radii, inside the cone.
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    wide, apex = (0.0, length) if narrows else (length, 0.0)
    ring = np.stack([np.full(_SIDES, wide), core * np.cos(angle), core * np.sin(angle)], axis=1)
    return np.append(ring, [(apex, 0.0, 0.0)], axis=0)


PARTS = 8
"""Parts of a link at whose ends its overlap is measured."""


# Inside a convex body the distance from its surface is the least over its faces: no search, no limit. All in metres.
def part_depth(part: Part, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how deep [n] points [n, 3] lie in a body; below zero outside, where it is no farther than that."""
    match part:
        case Sphere():
            return part.radius - np.linalg.norm(points - part.centre, axis=1)
        case Box():
            local = (points - part.centre) @ to_matrices(part.quaternion)
            return (np.asarray(part.half_sizes) - np.abs(local)).min(axis=1)
        case Capsule() | Cylinder():
            start, along = np.asarray(part.start), np.subtract(part.end, part.start)
            length = np.linalg.norm(along)
            arc = (points - start) @ (along / length)
            capsule = isinstance(part, Capsule)
            foot = start + np.outer(arc.clip(0, length) if capsule else arc, along / length)
            depth = part.radius - np.linalg.norm(points - foot, axis=1)
            return depth if capsule else np.minimum(depth, np.minimum(arc, length - arc))
        case _:
            planes = ConvexHull(part.vertices).equations
            return -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)


def obstacle_depth(obstacle: Obstacle, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    """Return how deep [n] points [n, 3] (world), at ``times`` [n] (s), lie in the deepest part of an obstacle."""
    local = to_obstacle_frame(obstacle, points, times)
    return np.max([part_depth(part, local) for part in obstacle.parts], axis=0)


def overlap_fault(
    obstacles: Sequence[Obstacle], chain: Chain, position: NDArray, euler: NDArray, times: NDArray
) -> tuple[int, str, float]:
    """Return the first step at which the whisker starts in an object, or one reaches its base point.

    Also returned are what is wrong in words, and the overlap at the start (m). Without a fault the step is the number
    of steps and the words are empty. ``position`` and ``euler`` [n + 1, 3] are the base's at ``times`` [n + 1] (s).
    """
    share = np.linspace(0, 1, PARTS * chain.links + 1)
    arcs = np.interp(share, np.linspace(0, 1, chain.links + 1), chain.nodes)
    rest = np.stack([np.interp(arcs, chain.nodes, axis) for axis in chain.points.T], 1)
    line = rest @ base_rotation(euler[0]).T + position[0]
    first, reason, depth = len(times) - 1, "", 0.0
    for obstacle in obstacles:
        here = obstacle_depth(obstacle, line, np.full(len(line), times[0])) + chain.whisker.radius(arcs)
        depth = max(depth, float(here.max()))
        reached = np.flatnonzero(obstacle_depth(obstacle, position, times)[:-1] > -chain.whisker.base_radius)
        if len(reached) and reached[0] < first:
            first, reason = int(reached[0]), fault(AT_BASE, float(times[reached[0]]), 0.0)
    if depth > LARGEST_START_OVERLAP:
        first, reason = 0, fault(STARTED_INSIDE, float(times[0]), depth)
    return first, reason, depth


def is_silent(job: Job, reach: Reach, position: NDArray[np.float64], euler: NDArray[np.float64]) -> bool:
    """Return True for a whisker that can feel nothing: nothing in reach, a still base, no gravity, air or loads.

    ``position`` and ``euler`` are base points [n, 3] and angles [n, 3] over the whole job.
    """
    moves = np.ptp(position, axis=0).any() or np.ptp(euler, axis=0).any()
    return not (reach or moves or job.loads or np.any(job.gravity) or job.air_flow is not None)


def silent_trace(job: Job, fidelity: Fidelity, record_shape: bool, seconds: float) -> Trace:
    """Return the trace of a whisker that feels nothing: exactly zero, without simulation."""
    count, shape = len(job.times), None
    if record_shape:
        position, euler = job.follicle.pose(job.times[:1])
        rest = fidelity.chain(job.whisker).points @ base_rotation(euler)[0].T + position[0]
        shape = np.repeat(rest[None], count, axis=0)
    return Trace(
        wrench=np.zeros((count, 6)),
        contact=np.zeros(count, dtype=bool),
        contact_arc=np.full(count, np.nan),
        displacement=None if job.whisker.follicle is None else np.zeros((count, 6)),
        error=0.0,
        seconds=seconds,
        link_positions=shape,
        contact_wrench=np.zeros((count, 6)) if record_shape else None,
    )


@dataclass(frozen=True, eq=False)
class FrameSteps:
    """Steps around each frame; values in between are interpolated linearly."""

    good: NDArray[np.bool_]
    """[n] True where both steps can be trusted; the others take step 0."""
    before: NDArray[np.int_]
    """[n]"""
    after: NDArray[np.int_]
    """[n]"""
    share: NDArray[np.float64]
    """[n, 1] weight of ``after``."""

    @property
    def nearest(self) -> NDArray[np.int_]:
        """[n] nearer of the two steps."""
        return np.where(self.share[:, 0] < 0.5, self.before, self.after)

    def interpolate(self, values: Callable[[NDArray[np.int_]], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return values [n, …] at the frames from those that ``values`` gives for steps [n]."""
        before, after = values(self.before), values(self.after)
        share = self.share.reshape(-1, *[1] * (before.ndim - 1))
        return (1 - share) * before + share * after


@dataclass(frozen=True, eq=False)
class SteppedJob:
    """A job cut into equal time steps."""

    job: Job
    fidelity: Fidelity
    record_shape: bool
    started: float = field(default_factory=time.thread_time)
    """Processor time at which the work on it began [s]."""

    @cached_property
    def chain(self) -> Chain:
        """The whisker as a chain of links."""
        return self.fidelity.chain(self.job.whisker)

    @cached_property
    def step(self) -> float:
        """Time step [s]: that of the fidelity, or a shorter one that the fastest motion of the job asks for."""
        step, job = self.fidelity.step_of(self.chain), self.job
        cutting = Cutting(job.start, float(job.times[-1]), step, step)
        pieces = [cutting.follicle(job.follicle, job.whisker.arc_length)]
        moving = (obstacle for obstacle in job.obstacles if obstacle.motion is not None)
        pieces += [cutting.obstacle(obstacle, np.zeros(3)) for obstacle in moving]
        return min(float(some.longest_steps(step, self.fidelity.steps_per_period).min()) for some in pieces)

    @cached_property
    def where(self) -> NDArray[np.float64]:
        """[n] frames in steps; whole where they fall on one."""
        # Rounding must not put a frame between two steps when it falls on one.
        where = (self.job.times - self.job.start) / self.step
        return np.where(np.abs(where - np.round(where)) < 1e-6, np.round(where), where)

    @cached_property
    def times(self) -> NDArray[np.float64]:
        """[s + 1] beginnings of the steps, and the end of the last (s)."""
        return np.asarray(self.job.start + self.step * np.arange(int(np.ceil(self.where[-1])) + 2), dtype=np.float64)

    @cached_property
    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Base points [s + 1, 3] (m) and angles [s + 1, 3] (rad)."""
        position, euler = self.job.follicle.pose(self.times)
        return np.asarray(position, dtype=float), np.asarray(euler, dtype=float)

    @cached_property
    def reach(self) -> Reach:
        """Obstacles that the whisker could ever touch, in convex parts."""
        return reachable(self.job.whisker, self.pose[0], self.job.obstacles, self.times)

    @cached_property
    def overlap(self) -> tuple[int, str, float]:
        """First step at which the whisker starts in an object or one reaches its base, why, and overlap at first."""
        return overlap_fault(self.reach.obstacles, self.chain, *self.pose, self.times)

    def end(self, failed: int, reason: str) -> tuple[int, str]:
        """Return the first step that cannot be trusted and why, given what the integration found."""
        missed = passed_unseen(self.job, self.reach, *self.pose, self.times)
        return min(self.overlap[:2], missed, (failed, reason), key=lambda fault: fault[0])

    def frames(self, failed: int) -> FrameSteps:
        """Return the steps around each frame when those from ``failed`` on cannot be trusted."""
        before, after = np.floor(self.where).astype(int), np.ceil(self.where).astype(int)
        good = after < failed
        before, after = np.where(good, before, 0), np.where(good, after, 0)
        return FrameSteps(good, before, after, np.where(good, self.where - before, 0.0)[:, None])

    def trace(
        self,
        frames: FrameSteps,
        wrench: NDArray[np.float64],
        contact: NDArray[np.bool_],
        arc: NDArray[np.float64],
        shape: NDArray[np.float64],
        *,
        penetration: float,
        reason: str,
        steps: int,
        displacement: NDArray[np.float64] | None = None,
        doubt: str = "",
    ) -> Trace:
        """Return the trace of values at the frames, NaN where not trusted.

        ``shape`` is in m, ``displacement`` in m and rad; ``steps`` are those that can be trusted; ``doubt`` is a fault
        without a time.
        """
        good, penetration = frames.good, max(penetration, self.overlap[2])
        if not reason and penetration > 2 * LARGEST_OVERLAP:
            # The contacts of these engines are soft, and when it was deepest they do not tell.
            doubt = fault(GOT_INSIDE, self.job.start, penetration)
        if not reason and doubt:
            good, reason = good & False, doubt
        ended = self.job.times[~frames.good]
        reason = without_escape(reason, self.job, float(ended[0]) if len(ended) else np.inf)
        return Trace(
            wrench=np.where(good[:, None], wrench, np.nan),
            contact=contact & good,
            contact_arc=np.where(good, arc, np.nan),
            penetration=penetration,
            status="unstable" if reason else "ok",
            reason=reason,
            steps=steps,
            seconds=time.thread_time() - self.started,
            displacement=None if displacement is None else np.where(good[:, None], displacement, np.nan),
            link_positions=np.where(good[:, None, None], shape, np.nan) if self.record_shape else None,
        )


@dataclass(frozen=True, eq=False)
class PrescribedMotion:
    """Prescribed positions and velocities of some joints and the accelerations that produce them."""

    position: NDArray[np.float64]
    """[n, coordinates] as MuJoCo's qpos, before step n."""
    velocity: NDArray[np.float64]
    """[n, degrees of freedom] as MuJoCo's qvel, before step n."""
    acceleration: NDArray[np.float64]
    """[n, degrees of freedom] over step n."""


def drive_scalars(path: NDArray[np.float64], step: float) -> PrescribedMotion:
    """Drive hinges or slides along ``path`` [n + 1, joints] sampled at every step (ms)."""
    return driven(path[:-1], np.diff(path, axis=0) / step, step)


def driven(position: NDArray, after: NDArray, step: float) -> PrescribedMotion:
    """Build a drive from positions before and velocities after each step."""
    acceleration = np.empty_like(after)
    # Second difference of the path. Force B a on the armature B makes the integrator's own velocities those of the
    # path.
    acceleration[1:] = np.diff(after, axis=0) / step
    # The acceleration at the start is unknown before the first sample: continue the next one.
    acceleration[0] = acceleration[1] if len(after) > 1 else 0.0
    return PrescribedMotion(position, after - step * acceleration, acceleration)


class SteppedEngine(WhiskerEngine, ABC):
    """An engine that takes every job by itself, in equal time steps."""

    @abstractmethod
    def simulate(self, stepped: SteppedJob) -> Trace:
        """Simulate one job that is not silent; return what :meth:`SteppedJob.trace` does."""

    def simulate_group(self, jobs: Sequence[Job], fidelity: Fidelity, *, record_shape: bool) -> list[Trace]:
        """Simulate jobs one after the other, but for those that are silent."""
        traces = []
        for stepped in (SteppedJob(job, fidelity, record_shape) for job in jobs):
            silent = is_silent(stepped.job, stepped.reach, *stepped.pose)
            spent = time.thread_time() - stepped.started
            traces.append(
                silent_trace(stepped.job, fidelity, record_shape, spent) if silent else self.simulate(stepped)
            )
        return traces
