"""Sessions of an animal that can be split into halves: their trials sorted, numbered and divided by their noise.

Rules for what cannot be split: a session that lacks two trials of some stimulus (four for ``crossnobis``, whose halves
need two) is left out, of the RDM too, so that the RDM and its reliability describe the same data; a unit with fewer
recorded trials of some stimulus is left out of its session. What was left out is told in words. Without any session
left the animal is undefined.

Random numbers belong to a trial, not to its place in an array: they are a hash of (seed, split, trial), so shuffling
trials, sessions or units changes none of them. Mixing is the 64-bit finaliser of SplitMix64 (Steele 2014).

Dividing a session by its noise turns squared distances into Mahalanobis distances. The noise is estimated from the same
trials. Their means do not depend on it, but what crossnobis takes away does: the noise of a trial divided by its own
estimate is 1 on average, that of a mean divided by an independent estimate is E[σ²/σ̂²] > 1. So crossnobis would stay
above zero for stimuli that are alike, by 5 % of the noise with 40 degrees of freedom. The factor is known for Gaussian
noise (ν/(ν − 2) per unit, ν/(ν − U − 1) for a full covariance of U units); with shrinkage it is measured by holding out
a tenth of the residuals in turn.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.rdms.dissimilarity import NOISE_METHODS, NoiseModel, estimate_noise
from brainbench.metrics.stimulus_labels import check_finite, labelled_trials, stimulus_means

Hashes = NDArray[np.uint64]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_REFINEMENTS = 2


def key_hashes(keys: Sequence[str]) -> Hashes:
    """Hash trial keys to 64 bits each, equally on every machine."""
    return np.array(
        [int.from_bytes(hashlib.blake2b(str(key).encode(), digest_size=8).digest(), "little") for key in keys],
        dtype=np.uint64,
    )


def content_hashes(responses: NDArray, codes: Ints) -> Hashes:
    """Hash each trial's responses [R, F], whatever the order of trials, units and stimuli.

    A trial starts as the set of its values; then trials and units describe one another (a unit by
    the trials it responds in, a trial by its units' values), so trials that hold the same values on
    different units differ. Trials that are still equal are numbered; swapping them changes nothing.
    """
    # Adding zero turns −0.0 into 0.0, which is equal but has other bits.
    values = _mix((np.where(np.isnan(responses), np.inf, responses).astype(np.float64) + 0.0).view(np.uint64))
    with np.errstate(over="ignore"):
        trial = _mix(values.sum(axis=1, dtype=np.uint64))
        for _ in range(_REFINEMENTS):
            stimulus = np.zeros(int(codes.max(initial=-1)) + 1, dtype=np.uint64)
            np.add.at(stimulus, codes, trial)
            trial = _mix(trial + _mix(stimulus)[codes])
            # Sums of mixed values do not depend on order, which makes trials and units anonymous sets to one another.
            unit = _mix(_mix(values ^ trial[:, None]).sum(axis=0, dtype=np.uint64))
            trial = _mix(trial + _mix(values ^ unit).sum(axis=1, dtype=np.uint64))
        order = np.argsort(trial, kind="stable")
        _, first, inverse = np.unique(trial[order], return_index=True, return_inverse=True)
        occurrence = np.empty(len(trial), dtype=np.uint64)
        occurrence[order] = np.arange(len(trial)) - first[inverse]
        return _mix(trial + occurrence * _STEP)


def draws(hashes: Hashes, splits: Ints, seed: int) -> Hashes:
    """Return one 64-bit random number per split and trial [S, R]."""
    with np.errstate(over="ignore"):
        start = _mix(np.uint64(seed & 0xFFFFFFFFFFFFFFFF) * _STEP + np.uint64(1))
        state = _mix(splits.astype(np.uint64) * _STEP + start)
        return _mix(hashes[None, :] ^ state[:, None])


def _mix(state: NDArray[np.uint64] | np.uint64) -> Hashes:
    with np.errstate(over="ignore"):
        z = np.asarray(state, dtype=np.uint64) + _STEP
        # SplitMix64's finaliser (Steele 2014) maps 64 bits one to one, so different trials keep different numbers.
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


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
    groups: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64), repr=False)
    """[R] numbers of the trials of one stimulus with the same units; empty where all of a stimulus have the same."""

    @classmethod
    def sort(
        cls,
        responses: Floats,
        labels: Ints,
        hashes: Hashes,
        *,
        rows: Ints | None = None,
        units: Any = slice(None),
        block: Trials | None = None,
    ) -> SortedTrials:
        """Sort trials by stimulus and hash, so that the order in which they came is forgotten.

        ``rows`` [R] are the trials of ``responses`` [R′, U′] that are taken (all by default) and ``units`` an index or
        mask of its units; ``labels`` and ``hashes`` [R] are those of the trials taken. Times, columns and the name of
        the session are those of the ``block``.
        """
        # Sorted by content, sums are formed in one order, so results do not change with the order of trials.
        order = np.lexsort((hashes, labels))
        values = np.empty((len(order), responses[:1, units].shape[1]))
        # Row by row, so that nothing but the result is large.
        trials = order if rows is None else rows[order]
        for place, row in enumerate(trials):
            values[place] = responses[row, units]
        stated: dict[str, Any] = {}
        if block is not None:
            columns = {name: np.asarray(texts)[units] for name, texts in block.columns.items()}
            times = None if block.times is None else np.asarray(block.times, dtype=np.float64)[trials]
            stated = {"times": times, "session": block.session, "columns": columns}
        return cls(values, labels[order], hashes=hashes[order], **stated)

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
            few = listing((f"{names[k]} ({trials[k]})" for k in np.flatnonzero(trials < least)), limit=4, quoted=False)
            lacking.append(f"fewer than {least} trials of {few}")
            continue
        # Both halves need recorded trials of every stimulus in each unit that is kept.
        groups = [codes == stimulus for stimulus in range(count)]
        splittable = np.all([np.count_nonzero(present[group], axis=0) >= least for group in groups], axis=0)
        dropped += int((~splittable).sum())
        if splittable.any():
            columns = slice(None) if splittable.all() else splittable
            how: dict[str, Any] = {"rows": np.flatnonzero(recorded), "units": columns, "block": block}
            sessions.append(SortedTrials.sort(responses, codes, hashes, **how))
        else:
            lacking.append(f"no unit recorded in {least} trials of every stimulus")
    notes = [f"{len(lacking)} of {len(blocks)} sessions left out: {'; '.join(sorted(set(lacking)))}"] if lacking else []
    if dropped:
        notes.append(f"{dropped} units or bins left out: recorded in fewer than {least} trials of some stimulus")
    problem = None
    if (total == 0).any():
        problem = f"no trials of {listing(names[place] for place in np.flatnonzero(total == 0))}"
    elif not sessions:
        problem = f"no session can be split into halves: {'; '.join(sorted(set(lacking)))}"
    return grouped_sessions(sessions), problem, tuple(notes)


def grouped_sessions(sessions: list[SortedTrials]) -> list[SortedTrials]:
    """Return sessions that know which trials have the same units, in all sessions that a trial stands in.

    Halves of other units would differ by these, not by noise, and the noise of a trial stays in one half of all probes.
    """
    units, grouped = defaultdict[int, list[tuple[int, int]]](list), []
    for place, session in enumerate(sessions):
        for key, row in zip(session.hashes.tolist(), np.isfinite(session.responses), strict=True):
            units[key].append((place, hash(row.tobytes())))
    for session in sessions:
        names = [(n, *units[key]) for key, n in zip(session.hashes.tolist(), session.labels.tolist(), strict=True)]
        number = {name: place for place, name in enumerate(dict.fromkeys(names))}
        different = len(number) > len(np.unique(session.labels))
        grouped.append(replace(session, groups=np.array([number[name] for name in names])) if different else session)
    return grouped


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


_FOLDS = 10


def whitened_sessions(
    sessions: list[SortedTrials], count: int, noise: str, notes: tuple[str, ...]
) -> tuple[list[SortedTrials], str | None, tuple[str, ...]]:
    """Whiten every session; return those with a noise covariance, why there is none (or None), and notes for people."""
    results = [whitened(session, count, noise) for session in sessions]
    usable = [session for session, _ in results if session is not None]
    notes += tuple(dict.fromkeys(told for session, told in results if told and session is not None))
    lost = sorted({told for session, told in results if session is None})
    if not usable:
        return sessions, f"no session has a noise covariance: {'; '.join(lost)}", notes
    if lost:
        notes += (f"{len(results) - len(usable)} sessions left out: {'; '.join(lost)}",)
    return usable, None, notes


def whitened(session: SortedTrials, count: int, noise: str) -> tuple[SortedTrials | None, str]:
    """Return the session with noise of unit covariance, and what was left out in words.

    The covariance comes from all trials of the session, about their stimulus' mean. Units that never vary between
    trials of a stimulus have no noise to divide by and are left out. ``diag`` scales each unit by the trials it was
    recorded in; the other methods mix units, so they leave out units that were not recorded in every trial.

    ``none`` divides by nothing.
    """
    check_name("noise covariance method", noise, ("none", *NOISE_METHODS))
    if noise == "none":
        return session, ""
    varies, power, number = (np.concatenate(part) for part in zip(*_noise(session, count), strict=True))
    usable = varies if noise == "diag" else varies & np.isfinite(session.responses).all(axis=0)
    lost = int((~usable).sum())
    note = f"{lost} units or bins left out: without noise or not in every trial" if lost else ""
    if not usable.any():
        return None, "no unit has noise to divide by"
    session = session if usable.all() else session.choose(usable)
    responses = session.responses
    if noise == "diag":
        # ν = trials − stimuli, per unit; for Gaussian noise E[σ²/σ̂²] = ν/(ν − 2).
        freedom = number[usable] - count
        scaled = np.divide(responses, np.sqrt(power[usable] / freedom), out=responses)
        # Units with two degrees of freedom or fewer have no expected factor; four is the least anyone has.
        inflation = float(np.mean(freedom / np.maximum(freedom - 2, 1)))
        return replace(session, responses=scaled, inflation=inflation), note
    try:
        precision = estimate_noise(responses, session.labels, count, noise).precision()
    except DataError as error:
        return None, str(error).rstrip(".")
    # With the precision P̂ = L Lᵀ, trials times L have noise of unit covariance.
    inflation = _inflation(responses, session.labels, noise, count)
    return replace(session, responses=responses @ np.linalg.cholesky(precision), inflation=inflation), note


def _noise(session: SortedTrials, count: int) -> Iterator[tuple[NDArray[np.bool_], Floats, Ints]]:
    """Yield for slices of units whether each varies between trials of a stimulus, Σ residual² and its trials."""
    for units in session.slices():
        # Noise is what trials differ by from their stimulus' mean; below the rounding of its values a unit has none.
        responses = session.responses[:, units]
        residuals = responses - stimulus_means(responses, session.labels, count)[session.labels]
        largest = np.nanmax(np.abs(responses), axis=0)
        varies = np.nanmax(np.abs(residuals), axis=0) > 8 * np.finfo(np.float64).eps * largest
        yield varies, np.nansum(residuals**2, axis=0), np.isfinite(residuals).sum(axis=0)


def _inflation(responses: Floats, codes: Ints, noise: str, count: int) -> float:
    """Return tr(P̂ S) of a precision P̂ and the covariance S of other trials, over that of its own trials."""
    units, freedom = responses.shape[1], len(codes) - count
    # Mean of an inverse Wishart matrix: E[Σ̂⁻¹] = Σ⁻¹ ν/(ν − U − 1), exact for Gaussian noise.
    if noise == "full":
        return freedom / (freedom - units - 1) if freedom > units + 1 else 1.0
    residuals = responses - stimulus_means(responses, codes, count)[codes]
    # Trials of each stimulus go to the folds in turn, so that every fold has its share.
    place = np.empty(len(codes), dtype=np.int64)
    for stimulus in range(count):
        rows = np.flatnonzero(codes == stimulus)
        place[rows] = (np.arange(len(rows)) + stimulus) % _FOLDS
    ratios = []
    for fold in range(_FOLDS):
        rest, held = residuals[place != fold], residuals[place == fold]
        try:
            model = estimate_noise(rest, np.zeros(len(rest), dtype=np.int64), 1, noise)
            ratio = _mean_square(held, model, len(held)) / _mean_square(rest, model, len(rest) - 1)
        except DataError:
            return 1.0
        ratios.append(ratio)
    # An estimate from nine tenths errs by ten ninths of what one from all trials does.
    return 1 + (float(np.mean(ratios)) - 1) * (1 - 1 / _FOLDS)


def _mean_square(residuals: Floats, model: NoiseModel, freedom: int) -> float:
    """Return tr(P̂ S) for the covariance S of residuals."""
    left, right = model.sides(residuals, residuals)
    return float((left * right).sum()) / freedom
