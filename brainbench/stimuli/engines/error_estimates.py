"""The law of the room: every force carries its error, estimated from finer simulations of the same whisker.

A whisker is simulated with half the step (and contact forces solved to :data:`TOLERANCE`), and with half as many links
again. What each changes says how far the limit is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.engines.fidelity import Fidelity, steps_to_ring
from brainbench.stimuli.engines.trust import SMALL_FORCE, start_jump
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.whiskers.whisker import Whisker

HALF_STEP, MORE_LINKS = 2.0, 3.0
"""Error over what half the step changes, and over what half as many links again change. Errors that fall with the first
power of the step and of the links have exactly these."""
BESIDE_TOUCH = 1.7
"""What these are multiplied by at readings beside the begin or end of a contact. Forces jump there, at a time that is
off by a step: their error (root mean square) falls with the root, and 1/(1 − 1/√2) stands in place of 2."""
MORE = 1.5  # links of the second finer simulation, over those that were asked for
MOST = 60  # most links of finer simulations, which every engine can take
TOLERANCE = 1e-6
"""Relative error to which the run in half steps solves contact forces, so that their error is seen too."""
LARGEST_ERROR = 0.1  # estimated error beyond which a whisker has a remark where the fidelity promises none
SLOW = 3.0  # periods of the first mode in the finest motion of a base from which a whisker follows it without ringing
CALM = 1.5
"""Error of such a whisker, which touches nothing, times the square of its links: .023, .012 and .004 for the presets,
measured .014 to .018, .007 to .008 and .003 to .004 (mouse and rat, 5 and 20 Hz)."""
ROUNDS = 5  # times that whiskers are simulated again, with more links or shorter steps, to keep a promised error
MARGIN = 0.8  # share of a promised error from which a whisker is simulated again, since estimates have errors too
FINEST_STEP = 2e-6  # step (s) below which none is halved to keep a promise: single precision ends there
RULE = 3  # counts up when the same forces get other errors, so that no data set is made by two rules

Run = Callable[[Sequence[Job], Fidelity], Sequence[Trace]]  # simulates jobs


def with_errors(run: Run, jobs: Sequence[Job], fidelity: Fidelity, once: Run) -> list[Trace]:
    """Return the traces of jobs with their estimated errors.

    ``run`` simulates each as often as it takes to be trusted, and finer ones ``once``: changes are what they are for.
    Where the fidelity promises an ``error``, whiskers beyond it are simulated again with what errs most made finer, one
    by one.
    """
    traces = list(run(jobs, fidelity))
    settings, seconds = [fidelity] * len(traces), [trace.seconds for trace in traces]
    runs: dict[tuple[int, Fidelity], Trace] = {}

    def _simulate(chosen: Mapping[int, Fidelity]) -> None:
        for setting in dict.fromkeys(chosen.values()):
            missing = [index for index in chosen if chosen[index] == setting and (index, setting) not in runs]
            for index, trace in zip(missing, once([jobs[i] for i in missing], setting) if missing else (), strict=True):
                runs[index, setting] = trace
                seconds[index] += trace.seconds

    pending: dict[int, Fidelity] = {}
    for index, (job, trace) in enumerate(zip(jobs, traces, strict=True)):
        if trace.status == "ok":
            # Where nothing came near enough to take a step, there is no error.
            error = calm_error(job, trace, fidelity) if trace.steps else 0.0
            traces[index] = replace(trace, error=error)
            if not error <= (fidelity.error or math.inf):
                # Finer runs begin with the steps that counted.
                pending[index] = divided_step(fidelity, trace.divisor, job.whisker, job.spacing)
                runs[index, pending[index]] = trace
    for place in range(ROUNDS if fidelity.error is not None else 1):
        _simulate(pending)
        pending = {index: chosen for index, chosen in pending.items() if runs[index, chosen].status == "ok"}
        changed = [
            {i: halved_step(chosen, jobs[i].whisker, jobs[i].spacing) for i, chosen in pending.items()},
            {i: more_links(chosen, jobs[i].whisker) for i, chosen in pending.items()},
        ]
        for some in changed:
            _simulate(some)
        finer: dict[int, Fidelity] = {}
        for index, chosen in pending.items():
            job, trace = jobs[index], runs[index, chosen]
            half, longer = (runs[index, some[index]] for some in changed)
            by_step = HALF_STEP * _change(job, trace, half, lateness(chosen, job.whisker, job.spacing))
            by_links = MORE_LINKS * _change(job, trace, longer)
            steps = trace.steps + (traces[index].steps if place else 0)
            settings[index], error, best = chosen, math.hypot(by_step, by_links), traces[index]
            if place:  # by what a later run changes it, it may be wrong
                best = replace(best, error=max(best.error, _change(job, best, trace)))
            # Where none is good enough the best stays: more links in the same steps can make a blow worse.
            if not (place and (fidelity.error or 0) < best.error < error):
                best = replace(trace, error=error)
            traces[index] = replace(best, steps=steps)
            following = _finer(chosen, job, by_step, by_links)
            if error > MARGIN * (fidelity.error or math.inf) and following != chosen:
                finer[index] = following
        runs = {(index, setting): trace for (index, setting), trace in runs.items() if finer.get(index) == setting}
        pending = finer
    promise, tried = fidelity.error or LARGEST_ERROR, fidelity.error is not None
    remarks = [remark_on(trace.error, promise, tried=tried) if trace.status == "ok" else "" for trace in traces]
    ratios = [setting.damping_of(job) for setting, job in zip(settings, jobs, strict=True)]
    return [
        replace(trace, damping=ratio, remark=remark, seconds=spent)
        for trace, ratio, remark, spent in zip(traces, ratios, remarks, seconds, strict=True)
    ]


def calm_error(job: Job, trace: Trace, fidelity: Fidelity) -> float:
    """Return the error of a whisker that touches nothing and follows a slow base; NaN of any other.

    Its forces are those of carrying its mass along, which only the number of links changes.
    """
    driven = job.loads or any(job.gravity) or job.air_flow is not None or job.whisker.bends
    if trace.contact.any() or driven or fidelity.solver == "quasistatic":
        return math.nan
    chain = fidelity.chain(job.whisker)
    slow = (getattr(job.follicle, "finest", None) or 0.0) >= SLOW * 2 * math.pi / chain.first_frequency
    return CALM / chain.links**2 if slow else math.nan


def changes(
    values: NDArray[np.floating],
    finer: NDArray[np.floating],
    contact: NDArray[np.bool_],
    lengths: NDArray[np.floating],
    shift: NDArray[np.floating] | float = 0.0,
) -> NDArray[np.float64]:
    """Return the share [n] by which finer simulations change base force or moment, whichever is larger.

    The blow that undoes an overlap at the start is the larger the shorter the step; it is no error. What changes where
    contact begins or ends counts :data:`BESIDE_TOUCH` times, and is at least what a ``shift`` [n] of that instant
    (:func:`lateness`) does. Other arguments are those of :func:`difference`.
    """
    calm = ~start_jump(values[:, :, None, :3], finer[:, :, None, :3])[:, :, 0]
    between = (contact[:, 1:, None] != contact[:, :-1, None], _sizes(finer[:, 1:] - finer[:, :-1]))
    padded = (np.pad(part, ((0, 0), (1, 1), (0, 0))) for part in between)
    beside, course = (np.maximum(part[:, 1:], part[:, :-1]) for part in padded)
    gaps = _sizes(values - finer)
    gaps = np.where(beside, BESIDE_TOUCH * np.maximum(gaps, np.reshape(shift, (-1, 1, 1)) * course), gaps)
    counted = finer.astype(float)
    counted[:, :, ::3] += gaps
    return difference(counted, finer, contact, lengths, calm).max(axis=1)


def lateness(fidelity: Fidelity, whisker: Whisker, spacing: float) -> float:
    """Return by what share of the time between two readings (``spacing``, s) half the step may move a touch.

    The wave that runs through a whisker from a touch is shorter than a long step. No such step shows it, and half the
    step changes a reading in it by much less than its error.
    """
    return min(fidelity.step_of(fidelity.chain(whisker)) / spacing, 1.0) / 2


def _sizes(wrenches: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the sizes [n, t, 2] of forces and moments [n, t, 6]."""
    return np.linalg.norm(wrenches.reshape(*wrenches.shape[:2], 2, 3), axis=-1)


def difference(
    values: NDArray[np.floating],
    reference: NDArray[np.floating],
    contact: NDArray[np.bool_],
    lengths: NDArray[np.floating],
    counted: NDArray[np.bool_] | bool = True,
) -> NDArray[np.float64]:
    """Return the relative difference of base forces and moments [n, 2], root mean square over the readings in contact.

    The larger of that and the same over all readings counts, so that what rings after a contact does too. Forces below
    :data:`SMALL_FORCE`, and their moments at the whisker's tip (at ``lengths`` [n], m), do not matter. Wrenches are
    [n, t, 6]; ``contact`` and ``counted``, readings that matter at all, are [n, t].
    """
    floor = SMALL_FORCE * np.stack([np.ones(len(values)), lengths], axis=1)
    parts = [part.reshape(*part.shape[:2], 2, 3).astype(float) for part in (values - reference, reference)]
    shares = np.zeros((len(values), 2))
    for readings in (contact & counted, np.ones_like(contact) & counted):
        count = np.maximum(readings.sum(axis=1), 1)[:, None]
        gap, whole = (np.sqrt(np.einsum("ntpd,ntpd,nt->np", part, part, readings) / count) for part in parts)
        shares = np.maximum(shares, gap / np.maximum(whole, floor))
    return shares


def divided_step(fidelity: Fidelity, divisor: int, whisker: Whisker, spacing: float) -> Fidelity:
    """Return a fidelity with a part of the step that it and readings (``spacing``, s) leave."""
    period = fidelity.steps_per_period
    if divisor == 1:
        return fidelity
    return replace(
        fidelity,
        time_step=max(min(fidelity.time_step, spacing) / divisor, 1e-7),
        steps_per_period=period and min(divisor * max(period, steps_to_ring(whisker.damping_ratio)), 1e4),
    )


@lru_cache(1024)
def halved_step(fidelity: Fidelity, whisker: Whisker, spacing: float) -> Fidelity:
    """Return a fidelity with half of these steps, of those too that an object near cuts, and solved contact forces."""
    return replace(
        divided_step(fidelity, 2, whisker, spacing),
        contact_travel=fidelity.contact_travel / 2,
        contact_tolerance=fidelity.contact_tolerance or TOLERANCE,
    )


@lru_cache(1024)
def more_links(fidelity: Fidelity, whisker: Whisker) -> Fidelity:
    """Return a fidelity with half as many links again, or with a third fewer where there can be no more."""
    count = fidelity.link_count(whisker.arc_length)
    changed = math.ceil(MORE * count)
    return replace(fidelity, links=changed if changed <= MOST else round(count / MORE), links_per_mm=None)


def _change(job: Job, trace: Trace, finer: Trace, shift: float = 0.0) -> float:
    """Return the share by which a finer run changes a trace; infinite where it cannot be trusted."""
    if finer.status != "ok":
        return math.inf
    contact, length = (trace.contact | finer.contact)[None], np.array([job.whisker.arc_length])
    return float(changes(trace.wrench[None], finer.wrench[None], contact, length, shift)[0])


def _finer(fidelity: Fidelity, job: Job, by_step: float, by_links: float) -> Fidelity:
    """Return a fidelity that is finer in what errs most, and in both where they err alike."""
    if by_step >= by_links / 2 and fidelity.time_step > FINEST_STEP:
        fidelity = halved_step(fidelity, job.whisker, job.spacing)
    if by_links >= by_step / 2 and MORE * fidelity.link_count(job.whisker.arc_length) <= MOST:
        fidelity = more_links(fidelity, job.whisker)
    return fidelity


def remark_on(error: float, promise: float = LARGEST_ERROR, *, tried: bool = False) -> str:
    """Return in words that an estimated error is beyond what is promised; empty where it is not.

    Where finer settings were ``tried``, as ``auto`` does, they are no advice.
    """
    if not error > promise:
        return ""
    words = f"an error of {error:.0%}" if np.isfinite(error) else "an error that cannot be told"
    advice = "auto has no finer setting that helps" if tried else "choose a finer fidelity, or auto=ERROR"
    return f"half the step and more links estimate {words} (root mean square), above {promise:.0%}; {advice}"
