"""RDMs of random halves of an animal's trials, many splits at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from brainbench.metrics.rdms.dissimilarity import poisson_rates
from brainbench.metrics.rdms.distances import (
    correlation_distances,
    correlation_from_gram,
    product_distances,
    products_from_gram,
)
from brainbench.metrics.rdms.pairs import Floats, Ints, upper
from brainbench.metrics.reliability.trial_hashes import Hashes, draws

_CHUNK_BYTES = 1 << 24

_COMMON = 1e-3
"""Products of trials lose digits when less than this share of a pattern's square is left after taking
away its mean over units; then half means are formed instead."""


@dataclass(frozen=True)
class Session:
    """Trials of one session that can be split, sorted by stimulus."""

    responses: Floats
    """[R, F]; NaN is missing."""
    codes: Ints
    """[R], ascending."""
    hashes: Hashes
    """[R]"""
    inflation: float = 1.0
    """How much larger the noise of means is, in units of the noise that the trials were divided by."""
    complete: bool = field(init=False)

    identity: int = field(init=False)
    """A number that depends on the trials, not on their order."""

    def __post_init__(self) -> None:
        order = np.lexsort((self.hashes, self.codes))
        for name in ("responses", "codes", "hashes"):
            object.__setattr__(self, name, getattr(self, name)[order])
        object.__setattr__(self, "complete", bool(np.isfinite(self.responses).all()))
        object.__setattr__(self, "identity", int(self.hashes.sum(dtype=np.uint64)))

    def group(self, stimulus: int) -> slice:
        """Return the rows of a stimulus."""
        first, last = np.searchsorted(self.codes, [stimulus, stimulus + 1])
        return slice(int(first), int(last))


def distances(patterns: Floats, method: str) -> Floats:
    """Return RDMs [..., P] of patterns [..., K, F] that may lack entries (NaN)."""
    return _DISTANCES[method](patterns)


def unbiased_distances(patterns: Floats, variances: Floats) -> Floats:
    """Return squared distances per unit [..., P] less what the noise of the patterns [..., K, F] adds to them.

    With ``variances`` [..., K, F] of the patterns (sample variance over trials / trials) this is the
    crossnobis distance with every trial as its own fold; units without either value are left out of a pair.
    """
    present = np.isfinite(patterns) & np.isfinite(variances)
    weight = present.astype(np.float64)
    own = np.where(present, variances, 0.0) @ np.swapaxes(weight, -1, -2)
    both = weight @ np.swapaxes(weight, -1, -2)
    seen = np.where(present, patterns, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        return product_distances(seen, seen, missing=True) - upper((own + np.swapaxes(own, -1, -2)) / both)


def half_rdms(sessions: list[Session], count: int, method: str, index: Ints, seed: int) -> tuple[Floats, Floats]:
    """Return the RDMs [S, P] of both halves of the splits ``index`` [S].

    Where trials are few against units, products of trials serve all splits (the RDM of any half is
    a sum of them); else half means are formed. Both give the same distances.
    """
    units = sum(session.responses.shape[1] for session in sessions)
    trials = max(len(session.codes) for session in sessions)
    by_products = method != "poisson" and trials <= 4 * units and all(session.complete for session in sessions)
    widest = trials if by_products else count * units
    step = max(1, _CHUNK_BYTES // (8 * max(widest, count * count)))
    products = [session.responses @ session.responses.T for session in sessions] if by_products else []
    parts = []
    for start in range(0, len(index), step):
        chosen = index[start : start + step]
        members = [split_members(session, count, chosen, seed) for session in sessions]
        pair = _from_products(sessions, products, members, count, method) if by_products else None
        if pair is None:
            pair = (
                pattern_rdms(sessions, members, count, method),
                pattern_rdms(sessions, [1.0 - member for member in members], count, method),
            )
        parts.append(pair)
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def pattern_rdms(
    sessions: list[Session], weights: list[Floats], count: int, method: str, copies: Ints | None = None
) -> Floats:
    """Return the RDMs [N, P] of patterns averaged with one weight per trial [N, R] of each session.

    ``copies`` [J] counts the units of each session so many times; once by default.
    """
    unbiased = method == "crossnobis"
    found = [weighted_patterns(s, w, count, variances=unbiased) for s, w in zip(sessions, weights, strict=True)]
    if copies is not None:
        found = [found[index] for index in np.repeat(np.arange(len(found)), copies)]
    patterns = np.concatenate([item[0] for item in found], axis=-1)
    if not unbiased:
        return distances(patterns, method)
    return unbiased_distances(patterns, np.concatenate([item[1] for item in found], axis=-1))


def weighted_patterns(session: Session, weights: Floats, count: int, *, variances: bool) -> tuple[Floats, Floats]:
    """Return mean patterns [N, K, F] over trials weighted by [N, R], and their variances (empty unless asked for).

    A unit without a weighted trial of a stimulus is NaN there; a variance needs two.
    """
    shape = (len(weights), count, session.responses.shape[1])
    means, spread = np.empty(shape), np.empty(shape if variances else (0, *shape[1:]))
    filled = session.responses if session.complete else np.nan_to_num(session.responses)
    with np.errstate(invalid="ignore", divide="ignore"):
        for stimulus in range(count):
            rows = session.group(stimulus)
            weight = weights[:, rows]
            # A unit unseen in these trials is missing here, not silent.
            seen = np.ones((weight.shape[1], 1)) if session.complete else np.isfinite(session.responses[rows]) * 1.0
            number = weight @ seen
            number[number == 0] = np.nan
            means[:, stimulus] = weight @ filled[rows] / number
            if variances:
                # Repeats of one trial tell nothing of its noise: only products of different trials count.
                squares, pairs = weight**2 @ filled[rows] ** 2, number**2 - weight**2 @ seen
                free = ((weight @ filled[rows]) ** 2 - squares) / np.where(pairs > 0, pairs, np.nan)
                spread[:, stimulus] = session.inflation * (means[:, stimulus] ** 2 - free)
    return means, spread


def members(random: Hashes) -> Floats:
    """Return 1 for the trials [S, n] of the first half: the lower half of the random numbers."""
    count = random.shape[1]
    order = np.argsort(random, axis=1, kind="stable")
    # The lowest number's parity is the coin that gives the odd trial to either half.
    coin = np.take_along_axis(random, order[:, :1], axis=1) & np.uint64(1)
    size = count // 2 + (count % 2) * coin.astype(np.int64)
    member = np.zeros(random.shape)
    np.put_along_axis(member, order, (np.arange(count) < size).astype(np.float64), axis=1)
    return member


def split_members(session: Session, count: int, index: Ints, seed: int) -> Floats:
    """Return 1 for the trials [S, R] in the first half of their stimulus, in the splits ``index`` [S]."""
    random = draws(session.hashes, index, seed)
    return np.concatenate([members(random[:, session.group(stimulus)]) for stimulus in range(count)], axis=1)


def _from_products(
    sessions: list[Session], products: list[Floats], chosen: list[Floats], count: int, method: str
) -> tuple[Floats, Floats] | None:
    """Return both halves' RDMs from products of trials, or None where that would lose digits."""
    splits = len(chosen[0])
    units = sum(session.responses.shape[1] for session in sessions)
    grams, sums = np.zeros((2, splits, count, count)), np.zeros((2, splits, count))
    for session, product, member in zip(sessions, products, chosen, strict=True):
        group = np.zeros((len(session.codes), count))
        group[np.arange(len(session.codes)), session.codes] = 1.0
        for half, weight in enumerate((member, 1.0 - member)):
            number = weight @ group
            # A half's mean pattern is its trials weighted by these shares.
            share = weight / number[:, session.codes]
            sums[half] += (share * session.responses.sum(axis=1)) @ group
            gram = np.empty((splits, count, count))
            for stimulus in range(count):
                rows = session.group(stimulus)
                gram[:, stimulus] = ((share[:, rows] @ product[rows]) * share) @ group
            if method == "crossnobis":
                # The product of a trial with itself holds its noise; those of different trials do not.
                diagonal = np.einsum("sii->si", gram)
                free = (number**2 * diagonal - (weight * np.diag(product)) @ group) / (number * (number - 1))
                diagonal[...] = diagonal - session.inflation * (diagonal - free)
            grams[half] += gram
    if method in ("sqeuclidean", "crossnobis"):
        return products_from_gram(grams[0], units), products_from_gram(grams[1], units)
    # Correlation takes each pattern's mean over all units, which spans the sessions.
    common = sums[..., :, None] * sums[..., None, :] / units
    centred = grams - common
    if (np.einsum("...ii->...i", centred) <= _COMMON * np.einsum("...ii->...i", grams)).any():
        return None
    floor = np.zeros((splits, count))
    return correlation_from_gram(centred[0], floor), correlation_from_gram(centred[1], floor)


def _correlation(patterns: Floats) -> Floats:
    return correlation_distances(patterns, missing=True)


def _sqeuclidean(patterns: Floats) -> Floats:
    return product_distances(patterns, patterns, missing=True)


def _poisson(patterns: Floats) -> Floats:
    rates = poisson_rates(patterns)
    return product_distances(rates, np.log(rates), missing=True)


_DISTANCES: dict[str, Callable[[Floats], Floats]] = {
    "correlation": _correlation,
    "sqeuclidean": _sqeuclidean,
    "poisson": _poisson,
}
