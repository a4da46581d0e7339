"""Bootstrap of one animal: sessions drawn with replacement, then trials of each stimulus within them.

Each draw gives an RDM and, from split halves of the drawn trials, its agreement with itself. Both
halves of a split hold different trials: a trial drawn twice stays in its half, or the halves would
agree by sharing noise. Random numbers are seeded by the trials' hashes, so the order of trials,
stimuli, sessions and units changes nothing. A session drawn twice counts its units twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.distances import correlation_from_gram, products_from_gram
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.halves import Session, pattern_rdms, split_members

_CHUNK_BYTES = 1 << 20
"""Sums of one chunk of draws stay in the processor's cache."""

_COMMON = 1e-3
_BY_GRAM = ("correlation", "sqeuclidean", "crossnobis")


def resample(
    sessions: list[Session], count: int, method: str, comparison: str, *, draws: int, splits: int, seed: int
) -> tuple[Floats, Floats]:
    """Return the RDMs [D, P] of the draws and the comparisons [D, S] of their halves (NaN: none exists)."""
    sessions = sorted(sessions, key=lambda session: session.identity)
    counts = [_trial_counts(session, count, draws, seed) for session in sessions]
    copies = _session_copies(sessions, draws, seed)
    members = [split_members(session, count, np.arange(splits), seed) for session in sessions]
    pairs = count * (count - 1) // 2
    rdms, agreement = np.empty((draws, pairs)), np.empty((draws, splits))
    by_gram = method in _BY_GRAM and all(session.complete for session in sessions)
    parts = [_Part(session) for session in sessions] if by_gram else []
    width = sum(part.values.shape[1] for part in parts) or sum(s.responses.shape[1] for s in sessions)
    step = max(1, _CHUNK_BYTES // (8 * count * max(width, count)))
    for start in range(0, draws, step):
        rows = slice(start, min(start + step, draws))
        drawn = [number[rows] for number in counts]
        found = _by_gram(sessions, parts, drawn, copies[rows], members, count, method, comparison) if by_gram else None
        if found is None:
            found = _by_patterns(sessions, drawn, copies[rows], members, count, method, comparison)
        rdms[rows], agreement[rows] = found
    whole = np.stack([_splittable(*each, count, method) for each in zip(sessions, counts, members, strict=True)])
    # A session that was not drawn has no say, whatever it lacks.
    agreement[~(whole | (copies.T == 0)[..., None]).all(axis=0)] = np.nan
    return rdms, agreement


def _splittable(session: Session, counts: Floats, members: Floats, count: int, method: str) -> NDArray[np.bool_]:
    """Whether both halves [D, S] have enough different trials of every stimulus."""
    drawn, needed = (counts > 0).astype(np.float64), 2 if method == "crossnobis" else 1
    enough = np.ones((len(counts), len(members)), dtype=bool)
    for stimulus in range(count):
        rows = session.group(stimulus)
        for half in (members[:, rows], 1.0 - members[:, rows]):
            enough &= drawn[:, rows] @ half.T >= needed
    return enough


def _trial_counts(session: Session, count: int, draws: int, seed: int) -> Floats:
    """Return how often each trial [D, R] was drawn among those of its stimulus."""
    parts = []
    for stimulus in range(count):
        rows = session.group(stimulus)
        number = rows.stop - rows.start
        generator = np.random.default_rng([seed, int(session.hashes[rows].sum(dtype=np.uint64))])
        drawn = generator.integers(0, number, (draws, number)) + number * np.arange(draws)[:, None]
        parts.append(np.bincount(drawn.ravel(), minlength=draws * number).reshape(draws, number))
    return np.concatenate(parts, axis=1).astype(np.float64)


def _session_copies(sessions: list[Session], draws: int, seed: int) -> Ints:
    """Return how often each session [D, J] was drawn."""
    number = len(sessions)
    generator = np.random.default_rng([seed, *(session.identity for session in sessions)])
    drawn = generator.integers(0, number, (draws, number)) + number * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=draws * number).reshape(draws, number)


class _Part:
    """What the products of a session's trials need: no more columns than trials."""

    def __init__(self, session: Session) -> None:
        self.units = session.responses.shape[1]
        self.sums = session.responses.sum(axis=1)
        self.squares = np.einsum("ru,ru->r", session.responses, session.responses)
        self.values = session.responses
        if self.units > len(self.sums):
            # Only inner products of trials matter; a triangular factor has the same ones.
            self.values = np.asarray(np.linalg.qr(session.responses.T, mode="r")).T


def _by_gram(
    sessions: list[Session],
    parts: list[_Part],
    counts: list[Floats],
    copies: Ints,
    members: list[Floats],
    count: int,
    method: str,
    comparison: str,
) -> tuple[Floats, Floats] | None:
    """Return RDMs and agreements from inner products of summed trials; None where that would lose digits."""
    draws, splits = len(copies), len(members[0])
    units = (copies @ np.array([part.units for part in parts])).astype(np.float64)
    sizes = [_Sums(session, part, number, count) for session, part, number in zip(sessions, parts, counts, strict=True)]
    rdms = _distances(sizes, copies, units, method)
    agreement = np.empty((draws, splits))
    for split in range(splits):
        first = [
            _Sums(session, part, number * member[split], count)
            for session, part, number, member in zip(sessions, parts, counts, members, strict=True)
        ]
        second = [whole.without(half) for whole, half in zip(sizes, first, strict=True)]
        one, two = (_distances(half, copies, units, method) for half in (first, second))
        if one is None or two is None:
            return None
        agreement[:, split] = compare(one, two, method=comparison)
    return None if rdms is None else (rdms, agreement)


class _Sums:
    """Sums over weighted trials of one session: of patterns [D, K, F], and of what distances take from them."""

    def __init__(self, session: Session, part: _Part, weights: Floats, count: int) -> None:
        groups = [session.group(stimulus) for stimulus in range(count)]
        self.patterns = np.empty((len(weights), count, part.values.shape[1]))
        for stimulus, rows in enumerate(groups):
            np.matmul(weights[:, rows], part.values[rows], out=self.patterns[:, stimulus])
        starts = [rows.start for rows in groups]
        self.number = np.add.reduceat(weights, starts, axis=1)
        self.number_squared = np.add.reduceat(weights**2, starts, axis=1)
        self.units = np.add.reduceat(weights * part.sums, starts, axis=1)
        self.squares = np.add.reduceat(weights**2 * part.squares, starts, axis=1)
        self.gram = self.patterns @ self.patterns.swapaxes(-1, -2)
        self.inflation = session.inflation

    def without(self, half: _Sums) -> _Sums:
        """Return the sums of the other half, whose inner products need no second pass over its patterns."""
        other = object.__new__(_Sums)
        cross = self.patterns @ half.patterns.swapaxes(-1, -2)
        other.gram = self.gram - cross - cross.swapaxes(-1, -2) + half.gram
        other.inflation = self.inflation
        for name in ("number", "number_squared", "units", "squares"):
            setattr(other, name, getattr(self, name) - getattr(half, name))
        return other


def _distances(sums: list[_Sums], copies: Ints, units: Floats, method: str) -> Floats | None:
    """Return RDMs [D, P] of the summed patterns; NaN where a stimulus has no trial left."""
    gram, total = np.zeros_like(sums[0].gram), np.zeros_like(sums[0].units)
    with np.errstate(invalid="ignore", divide="ignore"):
        for index, part in enumerate(sums):
            number = np.where(part.number > 0, part.number, np.nan)
            own = part.gram / (number[:, :, None] * number[:, None, :])
            if method == "crossnobis":
                pairs = part.number**2 - part.number_squared
                free = (np.einsum("dii->di", part.gram) - part.squares) / np.where(pairs > 0, pairs, np.nan)
                diagonal = np.einsum("dii->di", own)
                diagonal[...] = diagonal - part.inflation * (diagonal - free)
            weight = copies[:, index].astype(np.float64)[:, None, None]
            gram += np.where(weight > 0, weight * own, 0.0)
            total += np.where(weight[..., 0] > 0, weight[..., 0] * part.units / number, 0.0)
    if method != "correlation":
        return products_from_gram(gram, 1) / units[:, None]
    centred = gram - total[:, :, None] * total[:, None, :] / units[:, None, None]
    if (np.einsum("dii->di", centred) <= _COMMON * np.einsum("dii->di", gram)).any():
        return None
    return correlation_from_gram(centred, np.zeros(gram.shape[:2]))


def _by_patterns(
    sessions: list[Session],
    counts: list[Floats],
    copies: Ints,
    members: list[Floats],
    count: int,
    method: str,
    comparison: str,
) -> tuple[Floats, Floats]:
    """Return RDMs and agreements from mean patterns: any method, missing entries, large common offsets."""
    draws, splits = len(copies), len(members[0])
    rdms, agreement = np.empty((draws, count * (count - 1) // 2)), np.empty((draws, splits))
    combinations, which = np.unique(copies, axis=0, return_inverse=True)
    for index, repeats in enumerate(combinations):
        rows = np.flatnonzero(which.ravel() == index)
        weights = [number[rows] for number in counts]
        rdms[rows] = pattern_rdms(sessions, weights, count, method, repeats)
        for split in range(splits):
            first = [weight * member[split] for weight, member in zip(weights, members, strict=True)]
            second = [weight - half for weight, half in zip(weights, first, strict=True)]
            one, two = (pattern_rdms(sessions, half, count, method, repeats) for half in (first, second))
            agreement[rows, split] = compare(one, two, method=comparison)
    return rdms, agreement
