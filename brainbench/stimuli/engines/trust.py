"""What the engines share: units, the shape of a link, and when a simulation is doubtful."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import UsageError, listing
from brainbench.stimuli.engines.reach import distances
from brainbench.stimuli.whiskers.chain import build_chain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.engines.protocol import Job, WhiskerEngine
    from brainbench.stimuli.engines.reach import Reach
    from brainbench.stimuli.objects.obstacle import Obstacle
    from brainbench.stimuli.whiskers.whisker import Whisker

logger = logging.getLogger(__name__)

MILLI = 1e3
"""Millimetres in a metre, milliseconds in a second, millinewtons in a newton."""
MICRO = 1e6
"""Milligrams in a kilogram, µN·m in a newton metre."""
CONE_SIDES = 8
"""Sides of the cone inside a tapered link."""
LEAST_TAPER = 1e-6
"""Difference of the radii of a link's ends (mm) below which it is a capsule."""
LARGEST_BEND = 1.5
"""Angle between two links (rad) that no intact whisker reaches; beyond it a simulation counts as unstable."""


def strongest_force(whisker: Whisker) -> float:
    """Force (N) that would stretch the base of the whisker to twice its length: far beyond what keratin bears.

    A chain cannot stretch, so a contact that can only be relieved along it has any force; it counts as unstable.
    """
    return whisker.young_modulus * np.pi * whisker.base_radius**2


def too_strong(force: float, whisker: Whisker) -> str:
    """Say in words that a base force (N) cannot be right."""
    return (
        f"the base force reached {force:.3g} N, and {strongest_force(whisker):.3g} N stretch the whisker to twice its "
        "length: an overlap could not be resolved; choose a smaller time step or slower motion"
    )


def step_travel(
    whisker: Whisker, position: NDArray, euler: NDArray, obstacle: Obstacle, times: NDArray
) -> NDArray[np.float64]:
    """Farthest [n] (m) that a point of the unbent whisker can move against an obstacle in each step.

    Args:
        whisker: carried by its base at ``position`` [n + 1, 3] (m) with angles ``euler`` [n + 1, 3] (rad).
        obstacle: may move too.
        times: [n + 1] (s).
    """
    turn = np.abs(np.diff(euler, axis=0)).sum(axis=1) * whisker.arc_length
    own = np.linalg.norm(np.diff(position, axis=0), axis=1) + turn
    if obstacle.motion is None:
        return own
    places, quaternions = (np.asarray(values, dtype=float) for values in obstacle.motion(times))
    size = float(np.linalg.norm(_bounds(obstacle), axis=1).max())
    chord = np.linalg.norm(np.diff(quaternions, axis=0), axis=1)
    return own + np.linalg.norm(np.diff(places, axis=0), axis=1) + 2 * chord * size


def passed_unseen(job: Job, reach: Reach, position: NDArray, euler: NDArray, times: NDArray) -> tuple[int, str]:
    """Find the first step in which whisker and obstacle can pass through one another without ever overlapping.

    Contact is looked for at the end of each step only. Returns the step (the number of steps when there is none)
    and what is wrong in words. Arguments as for :func:`step_travel`.
    """
    first, reason = len(times) - 1, ""
    for obstacle in reach.obstacles:
        bounds = _bounds(obstacle)
        thickness = float((bounds[1] - bounds[0]).min()) + 2 * job.whisker.base_radius
        travel = step_travel(job.whisker, position, euler, obstacle, times)
        passing = travel > thickness
        if not passing.any():
            continue
        near = distances(obstacle, bounds, position, times)[:-1] <= job.whisker.arc_length + travel
        found = np.flatnonzero(passing & near)
        if len(found) and found[0] < first:
            first = int(found[0])
            reason = (
                f"an object moves by {travel[first] * MILLI:.3g} mm against the whisker in one step at "
                f"{times[first]:.6g} s and is only {thickness * MILLI:.3g} mm thick, so it may pass without being "
                "touched; choose a smaller time step"
            )
    return first, reason


def _bounds(obstacle: Obstacle) -> NDArray[np.float64]:
    """Lowest and highest corner [2, 3] (m) of what is touched, in the frame of the obstacle."""
    bodies = obstacle.parts if obstacle.surface is None else (obstacle.surface,)
    corners = np.stack([body.bounds() for body in bodies])
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])


def check_jobs(engine: WhiskerEngine, jobs: Sequence[Job], fidelity: Fidelity, workers: int | None) -> None:
    """Refuse what an engine cannot run, and say aloud what damps whiskers more than they are.

    Raises:
        UsageError: the engine lacks the solver or collides convex bodies only, or there are no workers.
    """
    if workers is not None and workers < 1:
        raise UsageError(f"workers must be at least 1; received {workers}.")
    if fidelity.solver not in engine.solvers:
        raise UsageError(
            f"The backend {engine.name!r} has no solver {fidelity.solver!r}, only {listing(engine.solvers)}; use the "
            "backend 'rod' for it."
        )
    if not engine.surfaces:
        require_parts(jobs, engine.name)
    warn_overdamped(jobs, fidelity)


def require_parts(jobs: Sequence[Job], backend: str) -> None:
    """Refuse obstacles that only engines which collide surfaces can touch.

    Raises:
        UsageError: an obstacle has a surface and no convex parts.
    """
    for obstacle in {id(item): item for job in jobs for item in job.obstacles}.values():
        if obstacle.surface is not None and not obstacle.parts:
            raise UsageError(
                f"The backend {backend!r} collides convex bodies only, and an object here is a concave surface of"
                f" {len(obstacle.surface.faces)} triangles; give the object collision = 'decomposition' (convex pieces,"
                " whose deviation is stated) or use the backend 'rod', which touches the surface itself."
            )


def warn_overdamped(jobs: Sequence[Job], fidelity: Fidelity) -> None:
    """Say when the time step alone damps a whisker at least twice as much as it should be damped."""
    if fidelity.solver == "quasistatic":
        return
    worst, wanted = 0.0, 0.0
    for whisker in {job.whisker for job in jobs}:
        chain = build_chain(whisker, 8)
        ratio = chain.achieved_damping_ratio(fidelity.step(float(chain.frequencies()[0]) / (2 * np.pi)))
        if ratio > 2 * whisker.damping_ratio and ratio > worst:
            worst, wanted = ratio, whisker.damping_ratio
    if worst:
        logger.warning(
            "The time step of %g s damps the first mode of at least one whisker with ratio %.2f instead of %.2f; "
            "its ringing is lost, slow bending is not; choose a smaller step to keep it.",
            fidelity.time_step,
            worst,
            wanted,
        )
