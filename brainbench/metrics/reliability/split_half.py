"""Split-half reliability of an animal's RDM, from its trials.

An animal is a sequence of sessions (:class:`Trials`) with different units. Units of all sessions
are joined after averaging trials, so an RDM spans them all.

Rules for what cannot be split:
a session that lacks two trials of some stimulus (four for ``crossnobis``, whose halves need two) is
left out, of the RDM too, so that the RDM and its reliability describe the same data; a unit with fewer
recorded trials of some stimulus is left out of its session. What was left out is told in words.
Without any session left the animal is undefined.

``mahalanobis`` and ``crossnobis`` divide by the noise of each session, see
:mod:`brainbench.metrics.rdms.whitening`; ``crossnobis`` takes every trial as its own fold, so unequal
numbers of trials leave it unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from brainbench.core.errors import DataError, UsageError, unknown_name
from brainbench.core.records import Interval
from brainbench.core.trials import Trials
from brainbench.metrics.inference.resampling import resample
from brainbench.metrics.rdms.comparison import check_comparison, compare
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.rdms.whitening import whitened
from brainbench.metrics.reliability.halves import Session, distances, half_rdms, pattern_rdms
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.trial_hashes import Hashes, content_hashes, key_hashes
from brainbench.metrics.stimulus_labels import check_finite, listed, response_matrix, stimulus_codes, stimulus_means

SPLITS = 1000
"""Random split halves per animal."""

SUBJECT_METHODS = ("correlation", "sqeuclidean", "mahalanobis", "crossnobis", "poisson")
"""RDM methods of an animal."""

DRAW_SPLITS = 20
"""Split halves in each bootstrap draw; more change its interval by less than the draws themselves do."""

_CHUNK_BYTES = 1 << 24
_HALVES_BYTES = 1 << 26
_DRAWS_BYTES = 1 << 28


@dataclass(frozen=True)
class SplitHalf:
    """RDMs of random halves of an animal's trials, and how well they agree."""

    rdm: Floats
    """[P] RDM of all trials."""
    r: Floats
    """[S] comparison of the two halves' RDMs, raw."""
    halves: Floats
    """[S′, 2, P] RDMs of the halves of the first S′ ≤ S splits (as many as fit in 64 MiB)."""
    reliability: float
    """Spearman-Brown reliability of the mean of ``r`` (averaged before, not after, the formula)."""
    spread: Interval | None
    """Percentiles of single splits' Spearman-Brown values: how much one split would have misled, not a
    confidence interval of the reliability."""
    units: int
    trials: int
    problem: str | None = None
    """Why no reliability exists."""
    notes: tuple[str, ...] = ()
    """What was left out."""
    draws: Floats = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """[D, P] RDMs of bootstrap draws of sessions and trials."""
    draws_r: Floats = field(default_factory=lambda: np.empty(0), repr=False)
    """[D] mean split-half comparison within each draw; NaN where none exists."""


def split_half(
    blocks: Sequence[Trials],
    n_stimuli: int,
    *,
    stimuli: Sequence[str] | None = None,
    method: str = "correlation",
    comparison: str = "pearson",
    splits: int = SPLITS,
    seed: int = 0,
    noise: str = "diag",
    draws: int = 0,
    draw_splits: int = DRAW_SPLITS,
) -> SplitHalf:
    """Split each stimulus' trials of each session into random halves and compare the halves' RDMs.

    With an odd number of trials the larger half is drawn too. Random numbers are hashes of (seed,
    split, trial key).

    Args:
        blocks: Sessions of one animal.
        n_stimuli: K.
        stimuli: Names of the stimuli, for messages.
        method: RDM method, one of :data:`SUBJECT_METHODS`.
        comparison: Comparison between the halves' RDMs, see :func:`brainbench.metrics.rdms.comparison`.
        splits: Number S of random splits.
        seed: Seed of the splits and draws.
        noise: Noise covariance for ``mahalanobis`` and ``crossnobis``: ``diag``, ``none`` or another of
            :func:`brainbench.metrics.noise_precision`. ``diag``, ``none`` and ``full`` leave crossnobis
            unbiased; shrinkage leaves a bias of up to .01 per unit (docs/statistics.md).
        draws: Number D of bootstrap draws (sessions, then trials within them); fewer where their RDMs
            would not fit in 256 MiB.
        draw_splits: Split halves within each draw.

    Raises:
        UsageError: unknown method, bad shapes or labels, repeated trial keys, no positive ``splits``.
        DataError: infinite responses, or negative ones for ``poisson``.
    """
    if method not in SUBJECT_METHODS:
        raise unknown_name(
            "RDM method of an animal",
            method,
            SUBJECT_METHODS,
        )
    check_comparison(comparison)
    if min(splits, draw_splits) < 1 or draws < 0 or n_stimuli < 2:
        raise UsageError(
            "Split halves need splits ≥ 1, draw_splits ≥ 1, draws ≥ 0 and 2 or more stimuli; received "
            f"{splits}, {draw_splits}, {draws} and {n_stimuli}."
        )
    names = [str(name) for name in (range(n_stimuli) if stimuli is None else stimuli)]
    if len(names) != n_stimuli:
        raise UsageError(f"There are {n_stimuli} stimuli but {len(names)} names.")
    sessions, problem, notes = usable_sessions(blocks, n_stimuli, names, least=4 if method == "crossnobis" else 2)
    if method in ("mahalanobis", "crossnobis") and problem is None:
        sessions, problem, notes = _without_noise(sessions, n_stimuli, noise, notes)
    pairs = n_stimuli * (n_stimuli - 1) // 2
    units = sum(session.responses.shape[1] for session in sessions)
    trials = sum(len(session.codes) for session in sessions)
    if problem is not None:
        empty = np.full(pairs, np.nan)
        return SplitHalf(empty, np.empty(0), np.empty((0, 2, pairs)), math.nan, None, units, trials, problem, notes)
    if method == "poisson" and any((session.responses < 0).any() for session in sessions):
        raise DataError("method='poisson' needs rates or counts, which are never negative; some responses are.")
    means = [stimulus_means(session.responses, session.codes, n_stimuli) for session in sessions]
    # Trials without noise covariance left make squared distances Mahalanobis distances.
    method = "sqeuclidean" if method == "mahalanobis" else method
    if method != "poisson":
        sessions = _shifted(sessions, means, by_unit=method != "correlation")
    if method == "crossnobis":
        full = pattern_rdms(sessions, [np.ones((1, len(session.codes))) for session in sessions], n_stimuli, method)[0]
    else:
        full = distances(np.concatenate(means, axis=1), method)
    kept = max(1, min(splits, _HALVES_BYTES // (16 * pairs)))
    halves = np.empty((kept, 2, pairs))
    r = np.empty(splits)
    step = max(1, _CHUNK_BYTES // (8 * pairs))
    for start in range(0, splits, step):
        index = np.arange(start, min(start + step, splits))
        first, second = half_rdms(sessions, n_stimuli, method, index, seed)
        r[index] = compare(first, second, method=comparison)
        stored = index[index < kept]
        halves[stored, 0], halves[stored, 1] = first[: len(stored)], second[: len(stored)]
    finite = r[np.isfinite(r)]
    if not np.isfinite(full).all() or not finite.size:
        problem = "its RDM is undefined: " + (
            "the mean responses to a stimulus are constant across units"
            if np.isnan(full).any()
            else "all pairs are equal"
        )
        return SplitHalf(full, r, halves, math.nan, None, units, trials, problem, notes)
    low, high = np.percentile(spearman_brown(finite), [2.5, 97.5]) if (finite > -1).all() else (math.nan, math.nan)
    spread = Interval(float(low), float(high), 0.95, "percentiles over random splits; not a confidence interval")
    value = float(spearman_brown(finite.mean()))
    number = min(draws, _DRAWS_BYTES // (8 * pairs))
    drawn = _draws(sessions, n_stimuli, method, comparison, number, draw_splits, seed)
    return SplitHalf(full, r, halves, value, spread, units, trials, None, notes, *drawn)


def _draws(
    sessions: list[Session], count: int, method: str, comparison: str, number: int, splits: int, seed: int
) -> tuple[Floats, Floats]:
    """Return the RDMs [D, P] of bootstrap draws, and each draw's mean split-half comparison [D]."""
    if not number:
        return np.empty((0, count * (count - 1) // 2)), np.empty(0)
    rdms, r = resample(sessions, count, method, comparison, draws=number, splits=splits, seed=seed)
    present = np.isfinite(r)
    total = np.where(present, r, 0.0).sum(axis=1)
    return rdms, np.divide(total, present.sum(axis=1), out=np.full(number, np.nan), where=present.any(axis=1))


def usable_sessions(
    blocks: Sequence[Trials], count: int, names: list[str], *, least: int
) -> tuple[list[Session], str | None, tuple[str, ...]]:
    """Check the sessions, leave out what cannot be split and say what.

    Returns:
        Sessions that can be split; why none can, or None; notes for people.

    Raises:
        UsageError: trials and labels differ in number, or a label is none of the stimuli.
    """
    sessions: list[Session] = []
    lacking: list[str] = []
    total = np.zeros(count, dtype=np.int64)
    dropped = 0
    for block in blocks:
        responses = response_matrix(block.responses, "trials").astype(np.float64)
        codes, _ = stimulus_codes(block.labels, count)
        if len(codes) != len(responses):
            raise UsageError(f"There are {len(responses)} trials but {len(codes)} labels; give one label per trial.")
        check_finite(responses)
        recorded = np.isfinite(responses).any(axis=1)
        hashes = trial_hashes(block, responses, codes)[recorded]
        responses, codes = responses[recorded], codes[recorded]
        # A trial without any recorded unit is no trial, whatever its label.
        trials = np.bincount(codes, minlength=count)
        total += trials
        if trials.min() < least:
            few = [f"{names[k]} ({trials[k]})" for k in np.flatnonzero(trials < least)]
            lacking.append(
                f"fewer than {least} trials of {', '.join(few[:4])}" + (" and others" if len(few) > 4 else "")
            )
            continue
        member = np.zeros((count, len(codes)))
        member[codes, np.arange(len(codes))] = 1.0
        splittable = (member @ np.isfinite(responses) >= least).all(axis=0)
        dropped += int((~splittable).sum())
        if splittable.any():
            sessions.append(Session(responses[:, splittable], codes, hashes))
        else:
            lacking.append(f"no unit recorded in {least} trials of every stimulus")
    notes = [f"{len(lacking)} of {len(blocks)} sessions left out: {'; '.join(sorted(set(lacking)))}"] if lacking else []
    if dropped:
        notes.append(f"{dropped} units or bins left out: recorded in fewer than {least} trials of some stimulus")
    problem = None
    if (total == 0).any():
        problem = f"no trials of {listed(names, total == 0)}"
    elif not sessions:
        problem = f"no session can be split into halves: {'; '.join(sorted(set(lacking)))}"
    return sessions, problem, tuple(notes)


def _without_noise(
    sessions: list[Session], count: int, noise: str, notes: tuple[str, ...]
) -> tuple[list[Session], str | None, tuple[str, ...]]:
    """Whiten every session, leave out what has no noise covariance and say what."""
    found = [whitened(session, count, noise) for session in sessions]
    kept = [session for session, _ in found if session is not None]
    notes += tuple(dict.fromkeys(told for session, told in found if told and session is not None))
    lost = sorted({told for session, told in found if session is None})
    if not kept:
        return sessions, f"no session has a noise covariance: {'; '.join(lost)}", notes
    if lost:
        notes += (f"{len(found) - len(kept)} sessions left out: {'; '.join(lost)}",)
    return kept, None, notes


def trial_hashes(block: Trials, responses: Floats, codes: Ints) -> Hashes:
    """Return one hash per trial, of its key or of its content.

    Raises:
        UsageError: keys are not one per trial, or repeat.
    """
    if block.keys is None:
        return content_hashes(responses, codes)
    if len(block.keys) != len(codes):
        raise UsageError(f"There are {len(codes)} trials but {len(block.keys)} keys; give one key per trial or none.")
    if len(set(map(str, block.keys))) < len(codes):
        raise UsageError("Trial keys repeat within a session; each trial needs its own key.")
    return key_hashes(block.keys)


def _shifted(sessions: list[Session], means: list[Floats], *, by_unit: bool) -> list[Session]:
    """Take away what distances do not feel but half means would lose digits to.

    Correlation distance does not feel one number taken from all units, squared distance not even one
    per unit.
    """
    if by_unit:
        shifts = [np.nanmean(mean, axis=0) for mean in means]
    else:
        shifts = [np.nanmean(np.concatenate([mean.ravel() for mean in means]))] * len(sessions)
    return [
        Session(s.responses - shift, s.codes, s.hashes, s.inflation) for s, shift in zip(sessions, shifts, strict=True)
    ]
