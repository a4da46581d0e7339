"""Reliability of single units' tuning, and leaving unreliable units out.

A unit's reliability is that of its mean responses over stimuli: the correlation between random halves
of its own trials, averaged over splits, then lengthened by Spearman and Brown's formula. (The published
filter used one number per animal.) Filtering is a choice made on the data that are then scored: it
raises reliability also where there is nothing to find, so report it with the score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.rdms.comparison import features
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.reliability.halves import mean_patterns, split_members
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.sessions import SortedTrials, trial_hashes
from brainbench.metrics.stimulus_labels import labelled_trials

UNIT_GATE = 0.5
"""Smallest reliability of a unit that :func:`reliable_units` keeps (published)."""

_SPLITS = 100
_CHUNK = 20


def unit_reliability(blocks: Sequence[Trials], n_stimuli: int, *, seed: int = 0) -> tuple[Floats, ...]:
    """Return the reliability of every unit's tuning [F], for each session; NaN where it has none.

    Responses are [R, F] or [R, T, F], whose time is averaged. A unit without variation over stimuli, or with fewer than
    two trials of some stimulus in every split, has no reliability. Values can be negative.
    """
    if n_stimuli < 3:
        raise UsageError(f"A unit's tuning needs at least 3 stimuli; received {n_stimuli}.")
    reliabilities = []
    for block in blocks:
        values = np.asarray(block.responses)
        values = finite_mean(values, axis=1) if values.ndim == 3 else values
        responses, codes, _ = labelled_trials(values.astype(np.float64), block.labels, n_stimuli)
        session = SortedTrials.sort(responses, codes, trial_hashes(block, responses, codes))
        total, number = np.zeros(responses.shape[1]), np.zeros(responses.shape[1])
        for start in range(0, _SPLITS, _CHUNK):
            member = split_members(session, n_stimuli, np.arange(start, start + _CHUNK), seed)
            # Split by split, so that memory holds a chunk of splits of one session.
            halves = [mean_patterns(session, w, n_stimuli, variances=False)[0] for w in (member, 1.0 - member)]
            # Pearson's r over stimuli between the halves' mean responses, of all units and splits at once.
            first, second = (features(half.swapaxes(-1, -2), "pearson") for half in halves)
            r = np.einsum("sfk,sfk->sf", first, second)
            finite = np.isfinite(r)
            total += np.where(finite, r, 0.0).sum(axis=0)
            number += finite.sum(axis=0)
        # Splits are averaged before Spearman and Brown's formula, as for RDMs.
        mean = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
        reliabilities.append(spearman_brown(mean))
    return tuple(reliabilities)


def reliable_units(
    blocks: Sequence[Trials],
    n_stimuli: int,
    *,
    least: float | None = UNIT_GATE,
    seed: int = 0,
    whole: Sequence[Trials] | None = None,
) -> tuple[tuple[Trials, ...], str]:
    """Return the sessions with the units whose reliability is at least ``least``, and what was left out in words.

    A session without such a unit is left out; without a ``least`` none is, and the words are empty. ``whole`` are the
    same trials with rates of the whole window, of which bins of unequal length have no plain mean.
    """
    if least is None:
        return tuple(blocks), ""
    values = unit_reliability(blocks if whole is None else whole, n_stimuli, seed=seed)
    reliable = []
    for block, value in zip(blocks, values, strict=True):
        good = value >= least
        if good.any():
            reliable.append(replace(block, responses=np.asarray(block.responses)[..., good]))
    every = sum(len(value) for value in values)
    left = sum(int((~(value >= least)).sum()) for value in values)
    return tuple(reliable), f"{left} of {every} units left out: reliability of their tuning below {least:g}"
