"""Sessions of an animal that can be split into halves: their trials sorted, what cannot be split left out.

Rules for what cannot be split: a session that lacks two trials of some stimulus (four for ``crossnobis``, whose halves
need two) is left out, of the RDM too, so that the RDM and its reliability describe the same data; a unit with fewer
recorded trials of some stimulus is left out of its session. What was left out is told in words. Without any session
left the animal is undefined.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.trials import Trials
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.trial_hashes import Hashes, content_hashes, key_hashes
from brainbench.metrics.stimulus_labels import check_finite, labelled_trials, listed, stimulus_means

_SLICE_ELEMENTS = 1 << 20


@dataclass(frozen=True)
class SortedTrials(Trials):
    """Trials [R, U] of one session sorted by stimulus, each with the hash from which its random numbers come.

    Its responses are a copy of its own, which whitening and shifting change in place.
    """

    hashes: Hashes = field(default_factory=lambda: np.empty(0, dtype=np.uint64), repr=False)
    """[R]"""
    inflation: float = 1.0
    """Noise variance of means, in units of the noise that the trials were divided by."""

    @classmethod
    def sort(
        cls, responses: Floats, labels: Ints, hashes: Hashes, *, rows: Ints | None = None, units: Any = slice(None)
    ) -> SortedTrials:
        """Sort trials by stimulus and hash, so that the order in which they came is forgotten.

        ``rows`` [R] are the trials of ``responses`` [R′, U′] that are taken (all by default) and ``units`` an index or
        mask of its units; ``labels`` and ``hashes`` [R] are those of the trials taken.
        """
        # Sorted by content, sums are formed in one order, so results do not change with the order of trials.
        order = np.lexsort((hashes, labels))
        taken = np.empty((len(order), responses[:1, units].shape[1]))
        # Row by row, so that nothing but the result is large.
        for place, row in enumerate(order if rows is None else rows[order]):
            taken[place] = responses[row, units]
        return cls(taken, labels[order], hashes=hashes[order])

    @cached_property
    def complete(self) -> bool:
        """True when no response is missing."""
        return bool(np.isfinite(self.responses).all())

    @cached_property
    def factor(self) -> Floats:
        """[R, ≤ R] patterns with the same inner products as the trials' responses, and no more columns than trials."""
        if self.responses.shape[1] <= len(self.labels):
            return self.responses
        # Rᵀ of responsesᵀ = Q R keeps the inner products of trials, and work then grows with trials, not with units.
        # Slices of units are taken up one after another (Golub & Van Loan 2013, section 5.1), so that QR copies little.
        triangle = np.empty((0, len(self.labels)))
        for units in self.slices():
            triangle = np.linalg.qr(np.concatenate([triangle, self.responses[:, units].T]), mode="r")
        return np.asarray(triangle).T

    def slices(self) -> Iterator[slice]:
        """Yield the units in slices of some MiB, in which temporary arrays are small."""
        step = max(8 * len(self.labels), _SLICE_ELEMENTS // max(1, len(self.labels)))
        yield from (slice(start, start + step) for start in range(0, self.responses.shape[1], step))

    def group(self, stimulus: int) -> slice:
        """Return the rows of a stimulus."""
        first, last = np.searchsorted(self.labels, [stimulus, stimulus + 1])
        return slice(int(first), int(last))


def usable_sessions(
    blocks: Sequence[Trials], count: int, names: list[str], *, least: int
) -> tuple[list[SortedTrials], str | None, tuple[str, ...]]:
    """Check the sessions, leave out what cannot be split and say what.

    Returns sessions that can be split; why none can, or None; notes for people.
    """
    sessions: list[SortedTrials] = []
    lacking: list[str] = []
    total = np.zeros(count, dtype=np.int64)
    dropped = 0
    for block in blocks:
        responses, codes, _ = labelled_trials(block.responses, block.labels, count)
        check_finite(responses)
        present = np.isfinite(responses)
        recorded = present.any(axis=1)
        hashes, codes, present = trial_hashes(block, responses, codes)[recorded], codes[recorded], present[recorded]
        # A trial without any recorded unit is no trial, whatever its label.
        trials = np.bincount(codes, minlength=count)
        total += trials
        if trials.min() < least:
            few = [f"{names[k]} ({trials[k]})" for k in np.flatnonzero(trials < least)]
            others = " and others" if len(few) > 4 else ""
            lacking.append(f"fewer than {least} trials of {', '.join(few[:4])}{others}")
            continue
        # Both halves need recorded trials of every stimulus in each unit that is kept.
        groups = [codes == stimulus for stimulus in range(count)]
        splittable = np.all([np.count_nonzero(present[group], axis=0) >= least for group in groups], axis=0)
        dropped += int((~splittable).sum())
        if splittable.any():
            columns = slice(None) if splittable.all() else splittable
            sessions.append(SortedTrials.sort(responses, codes, hashes, rows=np.flatnonzero(recorded), units=columns))
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


def trial_hashes(block: Trials, responses: Floats, codes: Ints) -> Hashes:
    """Return one hash per trial, of its key or of its content."""
    if block.keys is None:
        return content_hashes(responses, codes)
    if len(block.keys) != len(codes):
        raise UsageError(f"There are {len(codes)} trials but {len(block.keys)} keys; give one key per trial or none.")
    if len(set(map(str, block.keys))) < len(codes):
        raise UsageError("Trial keys repeat within a session; each trial needs its own key.")
    return key_hashes(block.keys)


def shifted_sessions(sessions: list[SortedTrials], count: int, *, by_unit: bool) -> list[SortedTrials]:
    """Subtract, in place, an offset that distances do not feel, but that half means would lose digits to.

    Correlation distance does not feel one number taken from all units, squared distance not even one per unit.
    """
    means = []
    for session in sessions:
        parts = [stimulus_means(session.responses[:, units], session.labels, count) for units in session.slices()]
        means.append(np.concatenate(parts, axis=1))
    if by_unit:
        shifts = [np.nanmean(mean, axis=0) for mean in means]
    else:
        shifts = [np.nanmean(np.concatenate([mean.ravel() for mean in means]))] * len(sessions)
    for session, shift in zip(sessions, shifts, strict=True):
        np.subtract(session.responses, shift, out=session.responses)
    # What was derived from the trials before does not hold for them now.
    return [replace(session) for session in sessions]
