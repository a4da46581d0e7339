"""The one rule of which simulated whiskers can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.reach import LARGEST_SLIDE, Reach, distances
from brainbench.stimuli.motion.jobs import MILLI, Job
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.whisker import Whisker

LARGEST_BEND = 1.5
"""Angle between two links (rad) that no intact whisker reaches; beyond it a simulation counts as unstable."""
LARGEST_RESIDUAL = 0.05
"""Residual of the contact forces from which a result counts as unstable. Whiskers below it are within a few per cent of
the converged solution (docs/unstable-whiskers.md)."""
LARGEST_CROWDED_SHARE = 0.02
"""Share of the steps with more contacts than are solved together from which a result counts as unstable."""

LARGEST_OVERLAP = 5e-4
"""Overlap (m) with an object from which a whisker counts as inside it. Twice the way of one step beside an object: tips
that flick over edges in long steps overlap by some tenths of a millimetre for a step."""
LARGEST_START_OVERLAP = 2e-5
"""The same at the start, where nothing has moved yet: what one step undoes, far more than rounding."""
LARGEST_STRAIN = 0.01
"""Stretch of the base from which a base force cannot be right. A chain cannot stretch, which beyond this is a worse
error than any preset has, and keratin yields at some 2 %. Whiskers that brush past objects reach .0001
(benchmarks/RESULTS.md)."""
SUSPICIOUS_SHARE = 0.4
"""Share of the largest overlap and residual from which a reliable whisker is suspicious."""
SUSPICIOUS_FORCE = 1.5e-4 / LARGEST_STRAIN
"""Share of the largest base force from which it is suspicious: a stretch of the base of 1.5e-4. In right simulations
whiskers that brush past objects stay below it."""
SUSPICIOUS_PEAK = 2.0
"""Largest over third largest base force of the readings from which it is suspicious: a thin tip that gets deeper than
its radius into an edge in one step is thrown out along the whisker, with up to a thousand times the force."""
FEWEST_READINGS = 20
"""Readings from which a peak is told from a force that grows."""
LARGEST_CHANGE = 0.2
"""Share by which the base force (root mean square over the readings) may change when the step is halved."""
SMALL_FORCE = 1e-9
"""Base force (N) that does not matter: a thousandth of that of a light touch."""
LARGEST_STRUCK_CHANGE = 0.1
"""The same in rigid contacts with a :data:`BLOW`, when the step is cut to a fifth: contacts may cut a step and its half
to the same. Of 555 whiskers it finds 99 of the 105 that err by more than a fifth, and 48 others; nothing that a single
run tells does (benchmarks/whiskers/struck.py of commit 7ff301f7)."""
BLOW = 0.15
"""Speed (m/s) of an object against the base from which it counts as a blow. At .2 to .7 m/s 4 to 11 % of the whiskers
err by more than a fifth with ``balanced``, at .1 m/s 2 %."""
HARD_BLOW = 3.0
"""Speed of a blow beyond which the presets err by 20 to 90 %."""
BLOW_STRIDE = 0.25
"""Way of an object in a step of such a blow up to which it is followed, in radii of the whisker's base. The median
whisker is then within 20 % of the force in far shorter steps, up to 25 m/s."""

HEAD_ON = 0.98
"""Cosine of the angle between an object's way and a straight whisker from which it pushes along it."""

OK, BENT, LOST, STARTED_INSIDE, GOT_INSIDE, AT_BASE, GAVE_WAY = range(7)
"""Ends of an integration: in order; with a joint bent beyond :data:`LARGEST_BEND`; with a value that is no number; in
an object from the start, or later; with an object over the base point, where contact has no lever and is not felt; with
a follicle that gave way."""

_FARTHEST = f"{LARGEST_BEND:g} rad or {LARGEST_SLIDE:.0%} of the length of its whisker"
_FINER = "at {0:.6g} s; choose more links or a smaller time step"
_FAULTS = {
    BENT: f"a joint bent by more than {LARGEST_BEND:g} rad, more than a chain of links can represent, {_FINER}",
    LOST: f"the state stopped being finite, {_FINER}",
    STARTED_INSIDE: "the whisker starts {1:.3g} mm deep in an object; move one of them",
    GOT_INSIDE: "the whisker was {1:.3g} mm deep in an object at {0:.6g} s; choose a smaller time step",
    GAVE_WAY: "the follicle gave way at {0:.6g} s by more than " + _FARTHEST + "; give it stiffer springs",
    AT_BASE: "an object reached the whisker's base point, where nothing is felt, at {0:.6g} s; move one of them",
}
"""Fault in words, given its time (s) and the deepest overlap (mm)."""
_TOO_FAST = (
    "an object moves by {:.3g} mm against the whisker in a step at {:.6g} s, further than the {:.3g} mm up to which "
    "contact is followed; choose a smaller time step (at most 1/{:.0f} of it)"
)
_UNSOLVED = "contact forces missed by {:.0%} (root mean square); choose a smaller time step"
_CROWDED = "more contacts than can be solved together in {} of {} steps"


@dataclass(frozen=True, eq=False)
class RunFacts:
    """Facts of simulated whiskers on which :func:`judge` rests: arrays of one shape, times in s."""

    status: NDArray[np.int32]
    """:data:`OK`, :data:`BENT`, :data:`LOST`, :data:`STARTED_INSIDE`, :data:`GOT_INSIDE`, :data:`AT_BASE` or
    :data:`GAVE_WAY`."""
    failed: NDArray[np.floating]
    """Time at which that happened."""
    strength: NDArray[np.floating]
    """First base force (N) beyond ``strongest``, at ``strong_at``; anything without."""
    strong_at: NDArray[np.floating]
    """Its time; inf when every base force is plausible."""
    strongest: NDArray[np.floating]
    """Base force (N) that the whisker bears (:func:`strongest_force`)."""
    travel: NDArray[np.floating]
    """Way (m) of an object against the whisker in a step, at ``fast_at``; anything without."""
    farthest: NDArray[np.floating]
    """Way (m) up to which its contact is followed."""
    fast_at: NDArray[np.floating]
    """First time at which it moves further; inf if never."""
    struck: NDArray[np.bool_]
    """True where an object within reach comes at more than :data:`BLOW`."""
    residual: NDArray[np.floating]
    """As :func:`residual` gives it."""
    crowded: NDArray[np.int32]
    """Steps for some of whose contacts there was no room."""
    steps: NDArray[np.int32]
    """Steps computed."""
    depth: NDArray[np.floating]
    """Deepest overlap with an object (m)."""
    peak: NDArray[np.floating]
    """Largest base force (N)."""
    third: NDArray[np.floating]
    """Third largest base force (N) of the readings; the largest below :data:`FEWEST_READINGS`."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """Reliability of simulated whiskers: arrays of one shape."""

    until: NDArray[np.float64]
    """Time (s) from which the numbers must not be used: inf for a reliable whisker, −inf where none may be used."""
    retryable: NDArray[np.bool_]
    """True where finer steps may give a result that can be trusted."""
    reasons: NDArray[np.object_]
    """Fault of each whisker in words; empty for a reliable one."""
    allowed: NDArray[np.float64]
    """Share by which the base force of a reliable whisker may change with shorter steps; inf without doubts."""

    @property
    def suspicious(self) -> NDArray[np.bool_]:
        """True where a reliable whisker is simulated again with shorter steps, to see whether its force stays."""
        return self.allowed < np.inf

    @property
    def struck(self) -> NDArray[np.bool_]:
        """True for suspicious whiskers that meet a :data:`BLOW`."""
        return self.allowed == LARGEST_STRUCK_CHANGE

    @property
    def unstable(self) -> NDArray[np.bool_]:
        """True where not all numbers can be trusted."""
        return self.until < np.inf


def residual(miss: NDArray[np.floating], load: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return what the last iterations still changed in the contact forces, as a share of the forces (root mean square).

    ``miss`` and ``load`` are sums over the steps: of the squared change in the last iteration, and of the squared
    forces.
    """
    return np.sqrt(miss.astype(float) / np.maximum(load, 1e-30))


def judge(facts: RunFacts) -> Verdict:
    """Return which whiskers can be trusted; of several things wrong, what happens first is told.

    Shorter steps mend chains that fold, that get inside an object, and contacts that are not solved; not a force that
    only stretching the whisker could relieve, an object that is too fast for the search for contacts, nor one that the
    whisker starts in or that passes through its base.
    """
    until = np.where(facts.status == OK, np.inf, facts.failed)
    retryable = (facts.status == BENT) | (facts.status == LOST) | (facts.status == GOT_INSIDE)
    reasons = np.full(facts.status.shape, "", dtype=object)

    def _blame(which: NDArray[np.bool_], words: Callable[[tuple[int, ...]], str]) -> None:
        for index in zip(*np.nonzero(which), strict=True):
            reasons[index] = words(index)

    for status in _FAULTS.keys() & set(facts.status.ravel().tolist()):
        _blame(facts.status == status, lambda i, status=status: fault(status, facts.failed[i], facts.depth[i]))
    # Faults with a time: the earliest counts, and what comes before it may be used.
    strong = facts.strong_at < until
    until = np.where(strong, facts.strong_at, until)
    _blame(strong, lambda i: f"at {facts.strong_at[i]:.6g} s {too_strong(facts.strength[i], facts.strongest[i])}")
    fast = facts.fast_at < until
    until = np.where(fast, facts.fast_at, until)
    # Both rest on sums over all steps and have no time, so nothing of the whisker may be used. NaN fails the comparison
    # and counts as unsolved.
    unsolved = (until == np.inf) & ~(facts.residual <= LARGEST_RESIDUAL)
    crowded = (until == np.inf) & ~unsolved & (facts.crowded > LARGEST_CROWDED_SHARE * facts.steps)
    way, most = facts.travel * MILLI, facts.farthest * MILLI
    _blame(fast, lambda i: _TOO_FAST.format(way[i], facts.fast_at[i], most[i], np.ceil(way[i] / most[i])))
    _blame(unsolved, lambda i: _UNSOLVED.format(min(facts.residual[i], 10.0)))
    _blame(crowded, lambda i: _CROWDED.format(facts.crowded[i], facts.steps[i]))
    bad = unsolved | crowded
    until = np.where(bad, -np.inf, until)
    doubtful = (
        (facts.peak > SUSPICIOUS_FORCE * facts.strongest)
        | (facts.peak > SUSPICIOUS_PEAK * facts.third)
        | (facts.depth > SUSPICIOUS_SHARE * LARGEST_OVERLAP)
        | (facts.residual > SUSPICIOUS_SHARE * LARGEST_RESIDUAL)
        | facts.struck
    )
    allowed = np.where(facts.struck, LARGEST_STRUCK_CHANGE, LARGEST_CHANGE)
    allowed = np.where((until == np.inf) & doubtful, allowed, np.inf)
    return Verdict(until, (retryable & ~fast) | bad, reasons, allowed)


def fault(status: int, time: float, depth: float) -> str:
    """Return in words why an integration ended (one of the constants above but ``OK``), with its overlap (m)."""
    return _FAULTS[status].format(time, depth * MILLI)


def halved(verdict: Verdict, change: NDArray[np.floating], which: NDArray[np.bool_]) -> Verdict:
    """Return the verdict of whiskers of which some (``which``) were simulated again with shorter steps.

    ``change`` is that of the base force (:func:`force_change`); NaN where the finer run is not reliable.
    """
    # NaN fails the comparison and counts as changed.
    changed, reasons = which & ~(change <= verdict.allowed), verdict.reasons.copy()
    for index in zip(*np.nonzero(changed), strict=True):
        by = f"by {change[index]:.0%}" if np.isfinite(change[index]) else "beyond what can be trusted"
        reasons[index] = (
            f"the base force changes {by} (root mean square) with half the step; choose a smaller time step"
        )
    until = np.where(changed, -np.inf, verdict.until)
    return Verdict(until, verdict.retryable | changed, reasons, np.where(which, np.inf, verdict.allowed))


def force_change(force: NDArray[np.floating], half: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the difference [row, column] of two forces [row, reading, column, 3] over the larger (rms).

    Readings of :func:`start_jump` do not count, and forces below :data:`SMALL_FORCE` do not change by any share.
    """
    counts = ~start_jump(force, half)
    least = SMALL_FORCE**2 * counts.sum(axis=1)
    square = [np.einsum("rtcd,rtcd,rtc->rc", x, x, counts, dtype=float) for x in (half - force, force, half)]
    return np.sqrt(square[0] / np.maximum(np.maximum(square[1], square[2]), least))


def start_jump(force: NDArray[np.floating], half: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which readings [row, reading, column] hold the jump of a whisker that overlaps an object at the start.

    The first step undoes the overlap with a blow that is the larger the shorter the step, and rings off. It is told by
    the force: largest at the first reading, and within a third of the readings below 1.5 times what comes in the last
    half. Arguments are two forces [row, reading, column, 3] of one whisker.
    """
    sizes = np.linalg.norm(np.stack([force, half]).astype(float), axis=-1)
    count = sizes.shape[2]
    falls = (sizes[:, :, 0] >= sizes.max(axis=2)).all(axis=0)
    if not falls.any():
        return np.zeros(sizes.shape[1:], dtype=bool)
    above = (sizes > 1.5 * sizes[:, :, count // 2 :].max(axis=(0, 2))[None, :, None]).any(axis=0)
    # Readings up to the last that is above.
    jump = np.logical_or.accumulate(above[:, ::-1], axis=1)[:, ::-1]
    return jump & (falls & (jump.sum(axis=1) <= count // 3))[:, None]


def strongest_force(whisker: Whisker) -> float:
    """Return the force (N) that would stretch a whisker's base by :data:`LARGEST_STRAIN`, E A times that.

    A chain cannot stretch, so a contact that can only be relieved along it has any force; it counts as unstable.
    """
    return LARGEST_STRAIN * whisker.young_modulus * np.pi * whisker.base_radius**2


def too_strong(force: float, strongest: float) -> str:
    """Return in words that a base force (N) cannot be right, beyond the ``strongest`` (N) that the whisker bears."""
    return (
        f"the base force reached {force:.3g} N, and {strongest:.3g} N stretch the whisker by {LARGEST_STRAIN:.0%}: an "
        "overlap could not be resolved; choose a smaller time step or slower motion"
    )


def state_fault(hinges: NDArray[np.float64], wrench: NDArray[np.float64], whisker: Whisker) -> str:
    """Return in words what is impossible in hinge angles [2N] (rad) or base wrench [6] (N first); empty for nothing."""
    bend, strength, strongest = np.abs(hinges).max(), np.abs(wrench[:3]).max(), strongest_force(whisker)
    if not (np.isfinite(bend) and np.isfinite(wrench).all()):
        return "the state stopped being finite; choose a smaller time step"
    if bend >= LARGEST_BEND:
        joint = int(np.abs(hinges).argmax()) // 2
        return f"joint {joint} bent by {bend:.2f} rad, more than a chain of links can represent"
    return too_strong(strength, strongest) if strength > strongest else ""


def step_travel(
    whisker: Whisker, position: NDArray, euler: NDArray, obstacle: Obstacle, times: NDArray
) -> NDArray[np.float64]:
    """Return how far [n] (m) a point of the unbent whisker can at most move against an obstacle in each step.

    ``position`` and ``euler`` [n + 1, 3] (m, rad) are those of the base that carries it, at ``times`` [n + 1] (s).
    """
    # A rotation is no larger than its three turns together, and no point is further from the base than the arc length.
    turn = np.abs(np.diff(euler, axis=0)).sum(axis=1) * whisker.arc_length
    travel = np.linalg.norm(np.diff(position, axis=0), axis=1) + turn
    if obstacle.motion is None:
        return travel
    places, quaternions = (np.asarray(values, dtype=float) for values in obstacle.motion(times))
    size = float(np.linalg.norm(obstacle.bounds, axis=1).max())
    # Quaternions of rotations θ apart differ by 2 sin(θ/4); a point at distance R moves by 2 R sin(θ/2) at most, no
    # more than 2 R times that.
    chord = np.linalg.norm(np.diff(quaternions, axis=0), axis=1)
    return travel + np.linalg.norm(np.diff(places, axis=0), axis=1) + 2 * chord * size


def without_escape(reason: str, job: Job, time: float) -> str:
    """Return the words of a fault at a time (s), which name a straight whisker that an object pushes along itself.

    Such a whisker cannot give way, and no step is short enough for it.
    """
    if not reason or not job.whisker.straight or not np.isfinite(time):
        return reason
    times = np.array([time - 1e-4, time])
    position, euler = job.follicle.pose(times)
    along = base_rotation(euler)[:, :, 0]
    tip = position + job.whisker.arc_length * along
    for obstacle in job.obstacles:
        places = np.zeros((2, 3)) if obstacle.motion is None else np.asarray(obstacle.motion(times)[0], dtype=float)
        way = np.diff(places - tip, axis=0)[0]
        near = distances(obstacle, obstacle.bounds, tip, times)[1] <= job.whisker.base_radius
        if near and -way @ along[1] > HEAD_ON * np.linalg.norm(way):
            return (
                f"{reason.partition(';')[0]}; it pushes along the straight whisker, which cannot give way: no shorter "
                "step helps; give the whisker its curvature, or meet it from the side"
            )
    return reason


def near_travel(
    whisker: Whisker, position: NDArray, euler: NDArray, obstacle: Obstacle, times: NDArray
) -> NDArray[np.float64]:
    """Return :func:`step_travel` [step] (m), 0 in steps in which the obstacle is out of the whisker's reach."""
    travel = step_travel(whisker, position, euler, obstacle, times)
    # Within its length of the base, and what both move in the step.
    near = distances(obstacle, obstacle.bounds, position, times)[:-1] <= whisker.arc_length + travel
    return np.where(near, travel, 0.0)


def passed_unseen(job: Job, reach: Reach, position: NDArray, euler: NDArray, times: NDArray) -> tuple[int, str]:
    """Return the first step in which whisker and obstacle can pass through one another unseen, and what is wrong.

    Contact is looked for at the end of each step only, and behind its middle an object that moves on lets go. Without
    such a step it is their number. Arguments as for :func:`step_travel`.
    """
    first, reason = len(times) - 1, ""
    for obstacle in reach.obstacles:
        half = float(np.diff(obstacle.bounds, axis=0).min()) / 2 + job.whisker.base_radius
        travel = near_travel(job.whisker, position, euler, obstacle, times)
        steps = np.flatnonzero(travel > half)
        if len(steps) and steps[0] < first:
            first = int(steps[0])
            reason = (
                f"an object moves by {travel[first] * MILLI:.3g} mm against the whisker in one step at "
                f"{times[first]:.6g} s, more than half of its {2 * half * MILLI:.3g} mm, so it may pass without being "
                "felt; choose a smaller time step"
            )
    return first, reason
