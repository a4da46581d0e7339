"""RDMs of an animal's trials, and of the halves of random splits of them, many at once.

Where nothing is missing, inner products of summed trials give the distances: the sums of one half, and those of all
trials less them, are all that a split needs. Else mean patterns are formed. Both give the same distances.

A unit's reliability is that of its mean responses over stimuli: the correlation between random halves of its own
trials, averaged over splits, then lengthened by Spearman and Brown's formula. (The published filter used one number per
animal.) Filtering is a choice made on the data that are then scored: it raises reliability also where there is nothing
to find, so report it with the score.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from brainbench.core.contracts import Trials
from brainbench.core.errors import check_number
from brainbench.metrics.arrays import Floats, Ints, finite_mean
from brainbench.metrics.rdms import dissimilarity
from brainbench.metrics.rdms.comparison import features, upper
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.sessions import Hashes, SortedTrials, draws, trial_hashes
from brainbench.metrics.stimulus_labels import labelled_trials, stimulus_means

_CHUNK_BYTES = 1 << 20  # sums of one chunk of splits stay in the processor's cache

_PATTERN_BYTES = 1 << 26  # mean patterns of one chunk of splits, where they are formed

_COMMON = 1e-3
"""Products of trials lose digits when less than this share of a pattern's square is left after taking
away its mean over units; then mean patterns are formed instead."""

BY_PRODUCTS = ("correlation", "sqeuclidean", "crossnobis")
"""Methods whose distances follow from inner products of summed trials."""


class SplitRDMs:
    """RDMs of an animal's trials and of their halves.

    ``count`` is K.
    """

    def __init__(self, sessions: list[SortedTrials], count: int, method: str) -> None:
        self._sessions, self._count, self._method = sessions, count, method
        self._every = [np.ones((1, len(session.labels))) for session in sessions]
        by_products = method in BY_PRODUCTS and all(session.complete for session in sessions)
        # Sums over all trials are made once for all splits.
        self._sums = self._summed(self._every) if by_products else None

    def whole(self) -> Floats:
        """Return the RDM [P] of all trials."""
        rdms = None if self._sums is None else self._from_products(self._sums)
        return (self._from_patterns(self._every) if rdms is None else rdms)[0]

    def halves(self, members: list[Floats]) -> tuple[Floats, Floats]:
        """Return the RDMs [N, P] of both halves, from 1 for the trials [N, R] of each session's first half, else 0."""
        if self._sums is not None:
            sums = self._summed(members)
            rest = [whole.without(half) for whole, half in zip(self._sums, sums, strict=True)]
            first, second = self._from_products(sums), self._from_products(rest)
            if first is not None and second is not None:
                return first, second
        # Both at once, since what takes time does not grow with the number of halves.
        rdms = self._from_patterns([np.concatenate([member, 1.0 - member]) for member in members])
        return rdms[: len(rdms) // 2], rdms[len(rdms) // 2 :]

    def crossed(self, parts: list[Ints]) -> Floats:
        """Return the RDMs [6, N, P] of products of differences between stimuli in two of four parts of the trials.

        ``parts`` are the numbers [N, R] of the parts in each session; their pairs come in order. Noise that no two
        parts share is on average in none.
        """
        pairs, total = [*combinations(range(4), 2)], 0.0
        for session, numbers in zip(self._sessions, parts, strict=True):
            # The factor has the products of the responses in fewer columns.
            part = replace(session, responses=session.factor) if session.complete else session
            members = np.concatenate([(numbers == index) * 1.0 for index in range(4)])
            for units in part.slices():
                means = np.split(mean_patterns(part, members, self._count, variances=False, units=units)[0], 4)
                sides = np.stack([means[a] for a, _ in pairs]), np.stack([means[b] for _, b in pairs])
                distances = dissimilarity.product_distances(*sides, missing=not session.complete)
                total = total + distances * means[0].shape[-1]
        return np.asarray(total)

    def _summed(self, members: list[Floats]) -> list[_Sums]:
        return [_Sums(*each, self._count) for each in zip(self._sessions, members, strict=True)]

    def _from_products(self, sums: list[_Sums]) -> Floats | None:
        """Return RDMs from summed trials, NaN where a stimulus has none left; None where that would lose digits."""
        gram, total = np.zeros_like(sums[0].gram), np.zeros_like(sums[0].units)
        units = float(sum(session.responses.shape[1] for session in self._sessions))
        with np.errstate(invalid="ignore", divide="ignore"):
            for index, part in enumerate(sums):
                number = np.where(part.number > 0, part.number, np.nan)
                # Inner products of mean patterns, s_k·s_l / (n_k n_l); sessions add up, since their units are joined.
                products = part.gram / (number[:, :, None] * number[:, None, :])
                if self._method == "crossnobis":
                    # The product of a trial with itself holds its noise; those of different trials do not.
                    pairs = part.number * (part.number - 1)
                    free = (np.einsum("nii->ni", part.gram) - part.squares) / np.where(pairs > 0, pairs, np.nan)
                    diagonal = np.einsum("nii->ni", products)
                    diagonal[...] = diagonal - self._sessions[index].inflation * (diagonal - free)
                gram += products
                total += part.units / number
        if self._method != "correlation":
            return dissimilarity.products_from_gram(gram, 1) / units
        # Correlation takes each pattern's mean over all units, which spans the sessions.
        centred = gram - total[:, :, None] * total[:, None, :] / units
        if (np.einsum("nii->ni", centred) <= _COMMON * np.einsum("nii->ni", gram)).any():
            return None
        return dissimilarity.correlation_from_gram(centred, np.zeros(gram.shape[:2]))

    def _from_patterns(self, members: list[Floats]) -> Floats:
        """Return RDMs from mean patterns: any method, missing entries, large common offsets."""
        each = list(zip(self._sessions, members, strict=True))
        if self._method == "correlation":
            means = [mean_patterns(*item, self._count, variances=False)[0] for item in each]
            return dissimilarity.correlation_distances(np.concatenate(means, axis=-1), missing=True)
        # The other distances are means over the units that both patterns have, so slices of units add up.
        total = number = 0.0
        for session, member in each:
            for units in session.slices():
                means = mean_patterns(session, member, self._count, variances=self._method == "crossnobis", units=units)
                distances, both = self._of_slice(*means)
                total, number = total + np.where(both > 0, distances * both, 0.0), number + both
        return np.divide(total, number, out=np.full(np.shape(total), np.nan), where=number > 0)

    def _of_slice(self, patterns: Floats, variances: Floats) -> tuple[Floats, Floats]:
        """Return distances [N, P] over some units, and how many of them both patterns have."""
        present = np.isfinite(patterns)
        if self._method == "crossnobis":
            present &= np.isfinite(variances)
        weight = present.astype(np.float64)
        shared = weight @ np.swapaxes(weight, -1, -2)
        both = upper(shared)
        if self._method == "crossnobis":
            # E‖x̂_i − x̂_j‖² = ‖x_i − x_j‖² + v_i + v_j: the noise of both means is taken away, over the units that both
            # have, which is the crossnobis distance with every trial as its own fold.
            summed = np.where(present, variances, 0.0) @ np.swapaxes(weight, -1, -2)
            seen = np.where(present, patterns, np.nan)
            with np.errstate(invalid="ignore", divide="ignore"):
                noise = upper((summed + np.swapaxes(summed, -1, -2)) / shared)
                return dissimilarity.product_distances(seen, seen, missing=True) - noise, both
        if self._method == "poisson":
            rates = dissimilarity.poisson_rates(patterns)
            return dissimilarity.product_distances(rates, np.log(rates), missing=True), both
        return dissimilarity.product_distances(patterns, patterns, missing=True), both


class _Sums:
    """Sums over the member trials of one session: of patterns [N, K, F], and of what distances take from them."""

    def __init__(self, session: SortedTrials, members: Floats, count: int) -> None:
        factor = session.factor
        self.patterns = np.empty((len(members), count, factor.shape[1]))
        # Trials are sorted by stimulus, so one pass of reduceat sums each of them.
        starts = np.searchsorted(session.labels, np.arange(count))
        for stimulus, (start, stop) in enumerate(pairwise((*starts.tolist(), len(factor)))):
            np.matmul(members[:, start:stop], factor[start:stop], out=self.patterns[:, stimulus])
        squares = np.einsum("ru,ru->r", factor, factor)
        self.number = np.add.reduceat(members, starts, axis=1)
        self.units = np.add.reduceat(members * session.responses.sum(axis=1), starts, axis=1)
        self.squares = np.add.reduceat(members * squares, starts, axis=1)
        self.gram = self.patterns @ self.patterns.swapaxes(-1, -2)

    def without(self, half: _Sums) -> _Sums:
        """Return the sums of the other half, whose inner products need no second pass over its patterns."""
        rest = object.__new__(_Sums)
        # (S − H)(S − H)ᵀ = SSᵀ − SHᵀ − HSᵀ + HHᵀ for the sums S of all trials and H of one half.
        cross = self.patterns @ half.patterns.swapaxes(-1, -2)
        rest.gram = self.gram - cross - cross.swapaxes(-1, -2) + half.gram
        for name in ("number", "units", "squares"):
            setattr(rest, name, getattr(self, name) - getattr(half, name))
        return rest


def mean_patterns(
    session: SortedTrials, members: Floats, count: int, *, variances: bool, units: slice = slice(None)
) -> tuple[Floats, Floats]:
    """Return mean patterns [N, K, F] of units over the trials that are 1 in [N, R], and, if asked for, their variances.

    A unit without a trial of a stimulus is NaN there; a variance needs two.
    """
    responses = session.responses[:, units]
    filled = responses if session.complete else np.nan_to_num(responses)
    shape = (len(members), count, responses.shape[1])
    means, spread = np.empty(shape), np.empty(shape if variances else (0, *shape[1:]))
    with np.errstate(invalid="ignore", divide="ignore"):
        for stimulus in range(count):
            rows = session.group(stimulus)
            member = members[:, rows]
            # A unit unseen in these trials is missing here, not silent.
            seen = np.ones((member.shape[1], 1)) if session.complete else np.isfinite(responses[rows]) * 1.0
            number = member @ seen
            number[number == 0] = np.nan
            means[:, stimulus] = member @ filled[rows] / number
            if variances:
                # The product of a trial with itself holds its noise: only those of different trials count.
                pairs = number * (number - 1)
                products = (member @ filled[rows]) ** 2 - member @ filled[rows] ** 2
                free = products / np.where(pairs > 0, pairs, np.nan)
                spread[:, stimulus] = session.inflation * (means[:, stimulus] ** 2 - free)
    return means, spread


def members(random: Hashes) -> Floats:
    """Return 1 for the trials [..., n] of the first half: the lower half of the random numbers."""
    count = random.shape[-1]
    order = np.argsort(random, axis=-1, kind="stable")
    # The lowest number's parity is the coin that gives the odd trial to either half.
    coin = np.take_along_axis(random, order[..., :1], axis=-1) & np.uint64(1)
    size = count // 2 + (count % 2) * coin.astype(np.int64)
    member = np.zeros(random.shape)
    np.put_along_axis(member, order, (np.arange(count) < size).astype(np.float64), axis=-1)
    return member


def split_members(session: SortedTrials, index: Ints | None, seed: int) -> Floats:
    """Return 1 for the trials [S, R] in the first half of their stimulus: in the splits ``index``, or in time."""
    random = _numbers(session, index, seed)
    first = np.empty(random.shape)
    sizes = np.bincount(session.labels)[session.labels]
    # Trials are sorted by stimulus; stimuli with as many trials are drawn in one call.
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        first[:, rows] = members(random[:, rows].reshape(len(random), -1, size)).reshape(len(random), -1)
    return first


SHIFTS = 4  # ways in which trials in order are divided into quarters, each a sixteenth further on than the last


def quarters(session: SortedTrials, index: Ints | None, seed: int) -> Ints:
    """Return the quarter 0 to 3 of its stimulus each trial [shift, S, R] is in; of fewer than four some are empty."""
    random = _numbers(session, index, seed)
    sizes = np.bincount(session.labels)
    places, number = np.arange(len(session.labels)) - np.repeat(np.cumsum(sizes) - sizes, sizes), sizes[session.labels]
    order = np.lexsort((random, np.broadcast_to(session.labels, random.shape)))
    result = np.empty((SHIFTS, *random.shape), dtype=np.int64)
    for shift in range(SHIFTS):
        quarter = (4 * SHIFTS * places + shift * number) // (SHIFTS * number) % 4
        np.put_along_axis(result[shift], order, quarter[None], axis=-1)
    return result


def _numbers(session: SortedTrials, index: Ints | None, seed: int) -> Hashes:
    """Return numbers [S, R] by which trials are divided, those with the same units alike.

    They are random in each split, or the order in time, whose last bit is a coin.
    """
    if index is None:
        places = np.argsort(np.argsort(session.times, kind="stable")).astype(np.uint64)
        random = (places[None] << np.uint64(1)) | (session.hashes & np.uint64(1))
    else:
        random = draws(session.hashes, index, seed)
    return _by_groups(random, session.groups) if len(session.groups) else random


def _by_groups(random: Hashes, groups: Ints) -> Hashes:
    """Return numbers [S, R] in whose lower part of a stimulus is the lower part of each of its groups."""
    sizes = np.bincount(groups)
    ranks = np.arange(len(groups)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    shares, order = np.empty(random.shape), np.lexsort((random, np.broadcast_to(groups, random.shape)))
    np.put_along_axis(shares, order, ((ranks + 0.5) / np.repeat(sizes, sizes))[None], axis=-1)
    places = np.argsort(np.lexsort((random, shares))).astype(np.uint64)
    return (places << np.uint64(1)) | (random & np.uint64(1))


def half_rdms(sessions: list[SortedTrials], count: int, method: str, index: Ints, seed: int) -> tuple[Floats, Floats]:
    """Return the RDMs [S, P] of both halves of the splits ``index`` [S]."""
    every = SplitRDMs(sessions, count, method)
    width = sum(min(session.responses.shape) for session in sessions)
    step = _CHUNK_BYTES // (8 * count * max(width, count))
    if method == "correlation":
        # It forms the patterns of all units; other distances come in slices of units.
        step = min(step, _PATTERN_BYTES // (8 * count * sum(session.responses.shape[1] for session in sessions)))
    step = max(1, step)
    parts = [
        every.halves([split_members(session, index[start : start + step], seed) for session in sessions])
        for start in range(0, len(index), step)
    ]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


UNIT_GATE = 0.5  # smallest reliability of a unit that reliable_units keeps (published)

_SPLITS = 100
_CHUNK = 20


def unit_reliability(blocks: Sequence[Trials], n_stimuli: int, *, seed: int = 0) -> tuple[Floats, ...]:
    """Return the reliability of every unit's tuning [F], for each session; NaN where it has none.

    Responses are [R, F] or [R, T, F], whose time is averaged. A unit without variation over stimuli, or with fewer than
    two trials of some stimulus in every split, has no reliability. Values can be negative.
    """
    check_number("The number of stimuli of a unit's tuning", n_stimuli, least=3, whole=True)
    reliabilities = []
    for block in blocks:
        values = np.asarray(block.responses)
        values = finite_mean(values, axis=1) if values.ndim == 3 else values
        responses, codes, _ = labelled_trials(values.astype(np.float64), block.labels, n_stimuli)
        session = SortedTrials.sort(responses, codes, trial_hashes(block, responses, codes))
        total, number = np.zeros(responses.shape[1]), np.zeros(responses.shape[1])
        for start in range(0, _SPLITS, _CHUNK):
            member = split_members(session, np.arange(start, start + _CHUNK), seed)
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


def tuning_by_chance(blocks: Sequence[Trials], n_stimuli: int, *, least: float = UNIT_GATE, seed: int = 0) -> float:
    """Return the tuning of the units that pass with random labels, as a share of that of those that pass; NaN for none.

    Tuning is the variance of mean responses over stimuli, which squared distances sum up. Units are chosen on the
    trials from which their reliability is taken afterwards, so what passes by chance looks reliable.
    """
    tuning = np.zeros(2)
    for block in blocks:
        values = np.asarray(block.responses, dtype=np.float64)
        values = finite_mean(values, axis=1) if values.ndim == 3 else values
        labels = np.asarray(block.labels)
        # By hashes, so that the order in which trials came is irrelevant here too.
        order = np.argsort(draws(trial_hashes(block, values, labels), np.zeros(1, dtype=np.int64), seed)[0])
        random = np.empty_like(labels)
        random[order] = np.sort(labels)
        for side, codes in enumerate((labels, random)):
            part = replace(block, responses=values, labels=codes)
            passed = unit_reliability([part], n_stimuli, seed=seed)[0] >= least
            means = stimulus_means(values[:, passed], codes, n_stimuli)
            tuning[side] += float(np.nansum((means - finite_mean(means, axis=0)) ** 2))
    return float(tuning[1] / tuning[0]) if tuning[0] > 0 else math.nan


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
            reliable.append(block.choose(good))
    every = sum(len(value) for value in values)
    left = sum(int((~(value >= least)).sum()) for value in values)
    return tuple(reliable), f"{left} of {every} units left out: reliability of their tuning below {least:g}"
