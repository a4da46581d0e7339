"""One animal as metrics see it: its RDM with split-half reliability, its mean responses and their noise.

An animal is a sequence of sessions (:class:`Trials`) with different units. Units of all sessions are joined after
averaging trials, so an RDM spans them all. :mod:`brainbench.metrics.reliability.sessions` says what cannot be split
and how ``mahalanobis`` and ``crossnobis`` divide by noise; ``crossnobis`` takes every trial as its own fold, so unequal
numbers of trials leave it unbiased.

How a perfect model would score is found from the animal without its noise: responses whose products, with the noise of
the means that trials tell, have the eigenvalues that were observed.

Where responses to a stimulus stay what they are, the halves of its trials by time agree as random halves do; the same
holds of earlier and later sessions. If few random halves agree as little, the responses drift. Noise that neighbours in
time share is no response either. In a sequence that repeats it makes stimuli that follow one another alike, in halves
by time too, but not in products between quarters, which share less in time than at random then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import Trials, natural_key
from brainbench.core.errors import DataError, UsageError, check_name, check_number
from brainbench.metrics.arrays import Floats, Ints, finite_mean
from brainbench.metrics.rdms.comparison import (
    LINEAR,
    WITHOUT,
    check_comparison,
    compare,
    permuted_pairs,
    products,
    products_without,
    stimulus_count,
)
from brainbench.metrics.rdms.dissimilarity import NOISE_METHODS, RDM_METHODS
from brainbench.metrics.reliability.halves import SHIFTS, SplitRDMs, half_rdms, quarters, split_members
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, spearman_brown
from brainbench.metrics.reliability.sessions import SortedTrials, shifted_sessions, usable_sessions, whitened_sessions
from brainbench.metrics.stimulus_labels import membership, stimulus_means

SPLITS = 1000  # random split halves per animal
_QUARTERS = 40  # divisions of the trials into random quarters, with which quarters in time are compared

FEWEST_SESSIONS = 3  # sessions of an animal from which their order can be told from chance

_CHUNK_BYTES = 1 << 24
_HALVES_BYTES = 1 << 26


@dataclass(frozen=True)
class SubjectRDM:
    """An animal, ready to be compared with any number of models."""

    subject: str
    rdm: Floats = field(repr=False)
    """[P] RDM of all trials; NaN pairs when ``problem`` says why."""
    split_half_r: Floats = field(repr=False)
    """[S] raw comparisons (by ``comparison``) of the RDMs of random split halves."""
    halves: Floats = field(repr=False)
    """[S′, 2, P] RDMs of the halves of the first S′ ≤ S splits (as many as fit in 64 MiB)."""
    units: int = 0
    """Neurons that entered."""
    trials: int = 0
    """Trials that entered."""
    method: str = "correlation"
    """Dissimilarity of two stimuli."""
    comparison: str = "pearson"
    reliability: float = math.nan
    """The mean of ``signal``, at most 1; without it the Spearman-Brown reliability of the mean of ``split_half_r``
    (averaged before, not after, the formula)."""
    seed: int = 0
    problem: str | None = None
    """Reason for having no usable RDM, in words; None otherwise."""
    signal: Floats = field(default_factory=lambda: np.empty(0), repr=False)
    """[S] product of the RDMs of a split's halves over the squared RDM of all trials, by ``comparison``: on average the
    share of it that is no noise. Empty where distances are biased or ranks compared; then Spearman and Brown's formula
    serves."""
    signal_without: Floats = field(default_factory=lambda: np.empty(0), repr=False)
    """[K] the mean of ``signal`` without each stimulus in turn; empty where it is not known."""
    notes: tuple[str, ...] = ()
    """Sessions and units that were left out, in words."""
    patterns: Floats = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """[K, U] mean responses over trials, units of all sessions joined; empty where only the RDM is known."""
    noise: Floats = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """[K, U] variance of those means, from the spread over trials."""
    columns: Mapping[str, NDArray] = field(default_factory=dict, repr=False)
    """What is known of each unit, such as its area: name → [U] texts, empty where unknown."""
    presented: Mapping[str, tuple[Floats, Ints]] = field(default_factory=dict, repr=False)
    """Session → times [R] and stimuli [R] of its trials, in the order of sessions; those without times are left out."""
    by_time: float = math.nan
    """Comparison of the RDMs of the earlier and the later half of each session's trials; NaN without times."""
    apart: Floats = field(default_factory=lambda: np.empty(0), repr=False)
    """[1 + S″] what four quarters of the trials share: in time (the first), and at random; empty without times."""
    between: Floats = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """[S, S] comparisons of the RDMs of single sessions, in order; empty below :data:`FEWEST_SESSIONS`."""
    nuisances: Mapping[str, Floats] = field(default_factory=dict, repr=False)
    """Name → RDM [P] of what else was measured in the trials; see :mod:`brainbench.metrics.measures.patterns`."""

    def take(self, stimuli: Ints) -> SubjectRDM:
        """Return the animal with some stimuli [K'], in this order; the split halves' comparisons stay as they are."""
        pairs = permuted_pairs(np.asarray(stimuli)[None], self.count)[0]
        every = len(self.signal_without) == len(stimuli)
        return replace(
            self,
            rdm=self.rdm[pairs],
            halves=self.halves[:0],
            signal_without=self.signal_without[stimuli] if every else self.signal_without[:0],
            patterns=self.patterns[stimuli] if len(self.patterns) else self.patterns,
            noise=self.noise[stimuli] if len(self.noise) else self.noise,
            nuisances={name: values[pairs] for name, values in self.nuisances.items()},
        )

    @property
    def count(self) -> int:
        """Number of stimuli."""
        return stimulus_count(len(self.rdm))

    def split_half_by(self, comparison: str) -> Floats:
        """Return the split-half comparisons [S] by any comparison (from the stored halves if need be)."""
        if comparison == self.comparison or self.problem is not None:
            return self.split_half_r
        return compare(self.halves[:, 0], self.halves[:, 1], method=comparison)

    def signal_by(self, comparison: str) -> Floats:
        """Return ``signal`` by any comparison (from the stored halves if need be); empty where there is none."""
        if comparison == self.comparison or self.problem is not None:
            return self.signal
        return _signal(self.halves[:, 0], self.halves[:, 1], self.rdm, self.method, comparison)

    def reliability_by(self, comparison: str) -> float:
        """Return the reliability of the RDM in a comparison."""
        signal = self.signal_by(comparison)
        if signal.size:
            return min(1.0, float(signal.mean()))
        return float(spearman_brown(finite_mean(self.split_half_by(comparison))))


def subject_rdm(
    subject: str,
    blocks: Sequence[Trials],
    n_stimuli: int,
    *,
    stimuli: Sequence[str] | None = None,
    method: str = "correlation",
    comparison: str = "pearson",
    splits: int = SPLITS,
    seed: int = 0,
    noise: str = "diag",
) -> SubjectRDM:
    """Return an animal's RDM and its split halves from the trials of its sessions.

    Every stimulus' trials of each session are split into random halves, whose RDMs are compared. With an odd number
    of trials the larger half is drawn too. Random numbers are hashes of (seed, split, trial key).

    An animal whose data cannot be used comes back with ``problem`` (for example ``no trials of 'convex-far'``) instead
    of an error, so the others can still be scored. ``n_stimuli`` is K; names of the ``stimuli`` are for messages.
    ``method`` is one of :func:`brainbench.metrics.rdm`. ``noise`` is the noise covariance of ``mahalanobis`` and
    ``crossnobis``: ``none`` or one of :func:`brainbench.metrics.noise_precision`. ``diag``, ``none`` and ``full`` leave
    crossnobis unbiased; shrinkage leaves a bias of up to .01 per unit (docs/calibration.md).
    """
    check_name("RDM method of an animal", method, RDM_METHODS)
    check_comparison(comparison)
    check_name("noise covariance method", noise, ("none", *NOISE_METHODS))
    for name, value, least in (("splits", splits, 1), ("n_stimuli", n_stimuli, 2), ("seed", seed, 0)):
        check_number(name, value, least=least, whole=True)
    names = [str(name) for name in (range(n_stimuli) if stimuli is None else stimuli)]
    if len(names) != n_stimuli:
        raise UsageError(f"There are {n_stimuli} stimuli but {len(names)} names.")
    sessions, problem, notes = usable_sessions(blocks, n_stimuli, names, least=4 if method == "crossnobis" else 2)
    if method in ("mahalanobis", "crossnobis") and problem is None:
        sessions, problem, notes = whitened_sessions(sessions, n_stimuli, noise, notes)
    pairs = n_stimuli * (n_stimuli - 1) // 2
    empty = SubjectRDM(
        subject=subject,
        rdm=np.full(pairs, np.nan),
        split_half_r=np.empty(0),
        halves=np.empty((0, 2, pairs)),
        units=sum(session.responses.shape[1] for session in sessions),
        trials=sum(len(session.labels) for session in sessions),
        method=method,
        comparison=comparison,
        seed=seed,
        problem=problem,
        notes=notes,
    )
    if problem is not None:
        return empty
    if method == "poisson" and any((session.responses < 0).any() for session in sessions):
        raise DataError("method='poisson' needs rates or counts, which are never negative; some responses are.")
    # Trials without noise covariance left make squared distances Mahalanobis distances.
    distance = "sqeuclidean" if method == "mahalanobis" else method
    patterns, variances = _mean_responses(sessions, n_stimuli)
    if distance != "poisson":
        sessions = shifted_sessions(sessions, n_stimuli, by_unit=distance != "correlation")
    rdm = SplitRDMs(sessions, n_stimuli, distance).whole()
    halves, r, signal = _split_halves(sessions, n_stimuli, distance, comparison, splits, seed, rdm)
    signal |= _in_time(sessions, n_stimuli, distance, comparison, seed)
    animal = replace(empty, rdm=rdm, split_half_r=r, halves=halves, patterns=patterns, noise=variances, **signal)
    if not np.isfinite(rdm).all() or not np.isfinite(r).any():
        flat = np.isnan(rdm).any()
        reason = "the mean responses to a stimulus are constant across units" if flat else "all pairs are equal"
        return replace(animal, problem=f"its RDM is undefined: {reason}")
    return replace(animal, reliability=animal.reliability_by(comparison))


def _mean_responses(sessions: list[SortedTrials], count: int) -> tuple[Floats, Floats]:
    """Return mean responses [K, U] over trials, units of all sessions joined, and the variance of those means."""
    means, noise = [], []
    for session in sessions:
        for units in session.slices():
            responses = session.responses[:, units]
            mean = stimulus_means(responses, session.labels, count)
            square = stimulus_means((responses - mean[session.labels]) ** 2, session.labels, count)
            # Trials counted by unit, since a unit may be missing in some of them.
            number = membership(session.labels, count) @ np.isfinite(responses)
            means.append(mean)
            # Mean square deviation × n/(n − 1) is the variance over trials; over n, that of their mean.
            noise.append(square / (number - 1))
    return np.concatenate(means, axis=1), np.concatenate(noise, axis=1)


def _split_halves(
    sessions: list[SortedTrials], count: int, method: str, comparison: str, splits: int, seed: int, whole: Floats
) -> tuple[Floats, Floats, dict[str, Floats]]:
    """Return the RDMs [S′, 2, P] of the halves that are kept, the comparison [S] of every split's, and their signal."""
    pairs = count * (count - 1) // 2
    most = max(1, min(splits, _HALVES_BYTES // (16 * pairs)))
    halves, r, signal, without = np.empty((most, 2, pairs)), np.empty(splits), [], np.zeros(count)
    # Chunks of splits: memory does not grow with their number.
    step = max(1, _CHUNK_BYTES // (8 * pairs))
    for start in range(0, splits, step):
        index = np.arange(start, min(start + step, splits))
        first, second = half_rdms(sessions, count, method, index, seed)
        r[index] = compare(first, second, method=comparison)
        signal.append(_signal(first, second, whole, method, comparison))
        if signal[-1].size and comparison in WITHOUT:
            without += products_without(first[:, None], second[:, None], comparison).sum(axis=(0, 1, 2)) / splits
        stored = index[index < most]
        halves[stored, 0], halves[stored, 1] = first[: len(stored)], second[: len(stored)]
    parts = {"signal": np.concatenate(signal)}
    if without.any():
        with np.errstate(invalid="ignore", divide="ignore"):
            parts["signal_without"] = without / products_without(whole[None], whole[None], comparison)[0, 0]
    return halves, r, parts


def _in_time(sessions: list[SortedTrials], count: int, method: str, comparison: str, seed: int) -> dict[str, Any]:
    """Return what an animal keeps of times: of its trials, the agreement of quarters in time, and of its sessions."""
    ordered = sorted(sessions, key=lambda session: natural_key(session.session))
    by_name = {session.session or str(place): session for place, session in enumerate(ordered)}
    names = {name for session in sessions for name in session.columns}
    stated: dict[str, Any] = {
        "presented": {name: (part.times, part.labels) for name, part in by_name.items() if part.times is not None},
        "columns": {
            name: np.concatenate([s.columns.get(name, np.full(s.responses.shape[1], "")) for s in sessions])
            for name in sorted(names)
        },
    }
    if all(session.times is not None for session in sessions):
        first, second = SplitRDMs(sessions, count, method).halves([split_members(each, None, 0) for each in sessions])
        stated["by_time"] = float(compare(first, second, method=comparison)[0])
        number = max(_QUARTERS // 4, _QUARTERS * 40 // max(count, 40))
        step = max(1, _CHUNK_BYTES // (48 * count * max(count, *(min(part.responses.shape) for part in sessions))))
        index = [None, *(np.arange(start, min(start + step, number)) for start in range(0, number, step))]
        stated["apart"] = np.concatenate([_shared(sessions, count, comparison, part, seed) for part in index])
    if len(ordered) >= FEWEST_SESSIONS:
        rdms = np.stack([SplitRDMs([each], count, method).whole() for each in ordered])
        # A session whose units are silent for some stimulus has no RDM of its own, and says nothing.
        rdms = rdms[~is_flat(rdms)]
        stated["between"] = compare(rdms[:, None], rdms[None], method=comparison)
    return stated


def _shared(sessions: list[SortedTrials], count: int, comparison: str, index: Ints | None, seed: int) -> Floats:
    """Return the product [S] of RDMs that are crossed between two quarters and the other two, over that of all trials.

    No two of the four sides have a trial in common, so the only noise in it is what trials share. Quarters in time do
    not share what neighbours do.
    """
    comparison = comparison if comparison in LINEAR else "pearson"
    every, shared = SplitRDMs(sessions, count, "sqeuclidean"), 0.0
    for parts in zip(*(quarters(each, index, seed) for each in sessions), strict=True):
        crossed = every.crossed(list(parts))
        # Pairs of four in order: the first goes with the last.
        shared = shared + products(crossed[:3], crossed[:2:-1], comparison).mean(axis=0) / SHIFTS
    whole = every.whole()
    total = products(whole, whole, comparison)
    return np.divide(shared, total, out=np.full(np.shape(shared), np.nan), where=total > 0)


def _signal(first: Floats, second: Floats, whole: Floats, method: str, comparison: str) -> Floats:
    """Return the products [S] of the RDMs [S, P] of halves over the square of that of all trials, where it is known."""
    # Only unbiased distances have halves whose product holds no noise.
    if method != "crossnobis" or comparison not in LINEAR:
        return np.empty(0)
    square = products(whole, whole, comparison)
    # A flat RDM has no comparison either; its halves are products of noise.
    return products(first, second, comparison) / square if square > 0 else np.empty(0)


def is_flat(rdms: Floats) -> NDArray[np.bool_]:
    """Return where RDMs [..., P] have missing pairs or no differences between pairs: nothing compares with them."""
    return np.isnan(compare(rdms, rdms, method="pearson")) | ~np.isfinite(rdms).all(axis=-1)


SIMULATIONS = 20  # noisy copies of an animal over which what a perfect model attains is averaged
_ROUNDS, _DRAWS, _DRAWN_STIMULI = 10, 8, 800
"""Corrections of the eigenvalues of noiseless products, and draws of the noise in each: fewer above 100 stimuli."""
_ROUNDING = 1e-12


def denoised(patterns: Floats, noise: Floats) -> Floats:
    """Return patterns [K, U] that, with noise on them, have products with the eigenvalues of the given ones.

    Noise spreads eigenvalues: it adds small ones, which no other stimulus predicts, and makes large ones larger. Those
    of the noiseless products are moved until noise makes what was observed of them; their sum is unbiased.

    Args:
        patterns: [K, U] mean responses.
        noise: [K, U] variance of these means.
    """
    mean, order = patterns.mean(axis=0), unit_order(patterns, noise)
    centred, spread = (patterns - mean)[:, order], np.sqrt(np.maximum(noise, 0.0))[:, order]
    count = min(len(patterns) - 1, patterns.shape[1])
    observed, vectors = (part[..., ::-1] for part in np.linalg.eigh(centred @ centred.T))
    total = float(observed.sum() - noise.sum() * (1 - 1 / len(patterns)))
    if not total > 0:
        return np.broadcast_to(mean, patterns.shape)
    # Each unit keeps its part in every direction of the stimuli.
    size = np.sqrt(np.where(observed > _ROUNDING * observed[0], observed, np.inf))[:, None]
    units = vectors.T @ centred / size
    # Of many stimuli the eigenvalues of one draw are as good as their mean.
    generator, draws = np.random.default_rng(0), max(1, min(_DRAWS, _DRAWN_STIMULI // len(patterns)))
    crossed, squares = np.empty((2, draws, len(patterns), len(patterns)))
    for index in range(draws):
        drawn = spread * generator.standard_normal(patterns.shape)
        drawn = vectors.T @ (drawn - drawn.mean(axis=0))
        crossed[index], squares[index] = units @ drawn.T, drawn @ drawn.T
    values = np.where(np.arange(len(patterns)) < count, total / count, 0.0)
    for _ in range(_ROUNDS):
        mixed = np.sqrt(values)[:, None] * crossed
        noisy = np.linalg.eigvalsh(np.diag(values) + mixed + mixed.swapaxes(1, 2) + squares)[:, ::-1].mean(axis=0)
        moved = np.sort(np.maximum(values + observed - noisy, 0.0)[:count])[::-1]
        if not moved.any():
            break
        values[:count] = moved * total / moved.sum()
    return mean + ((vectors * np.sqrt(values)) @ units)[:, np.argsort(order)]


def unit_order(patterns: Floats, noise: Floats) -> Ints:
    """Return an order of the units that does not depend on how they were listed."""
    # Rounding makes no order.
    scale = np.abs(patterns).max(initial=0.0) or 1.0
    return np.lexsort(np.round(np.concatenate([noise / scale**2, patterns / scale]), 9))


def simulated_animals(animal: SubjectRDM, seed: int) -> tuple[Floats, list[SubjectRDM]]:
    """Return an animal's responses without noise [K, U], and copies of the animal with new noise on them."""
    units = unit_order(animal.patterns, animal.noise)
    animal = replace(animal, patterns=animal.patterns[:, units], noise=animal.noise[:, units])
    truth = denoised(animal.patterns, animal.noise)
    generator = np.random.default_rng(seed)
    spread = np.sqrt(np.maximum(animal.noise, 0.0))
    drawn = (truth + spread * generator.standard_normal(truth.shape) for _ in range(SIMULATIONS))
    return truth, [replace(animal, patterns=patterns) for patterns in drawn]


LEVEL = 0.01  # responses drift where so few random halves agree as little; of fewer than 100 halves, where none does
_ORDERS = 999
_TIE = 1e-12


@dataclass(frozen=True)
class Drift:
    """Agreement of parts by time, and of random ones."""

    by_time: float
    """Within sessions a reliability, between them a share of what any two sessions have in common."""
    random: float
    p: float
    """Of an agreement as low for random halves."""
    level: float
    animals: int

    @property
    def present(self) -> bool:
        """True where parts by time agree less than chance explains."""
        return self.p <= self.level

    @property
    def reliable(self) -> bool:
        """True where parts by time are as reliable as a score needs."""
        return self.by_time >= RELIABILITY_GATE

    @property
    def stated(self) -> dict[str, Any]:
        """What a record keeps."""
        return {"by_time": self.by_time, "random": self.random, "p": self.p, "animals": self.animals}


def drift_within(animals: Sequence[SubjectRDM]) -> Drift | None:
    """Compare the parts by time of every session's trials with random ones; None where no times are known."""
    timed = [animal for animal in animals if animal.problem is None and np.isfinite(animal.by_time)]
    if not timed:
        return None
    # Comparisons, not products: what changes over time averages out in the length of the whole, not in that of halves.
    # Splits of different animals are independent, so each column of splits is a draw of the mean over animals.
    null = finite_mean(np.stack([animal.split_half_r for animal in timed]), axis=0)
    null = null[np.isfinite(null)]
    observed = float(np.mean([animal.by_time for animal in timed]))
    p, smallest = _tail(null, observed), 1 / (len(null) + 1)
    shorter, longer = spearman_brown([observed, float(null.mean())])
    share = float(shorter / longer) if longer > 0 else np.nan
    # Halves by time agree less where tuning changes; quarters share less where neighbours in time have common noise.
    if (apart := _apart(timed)) is not None and apart[0] < p:
        (p, share), smallest = apart, 0.0
    reliability = float(np.mean([animal.reliability for animal in timed]))
    # The smaller p of two.
    return Drift(reliability * share, reliability, min(1.0, 2 * p), 2 * max(LEVEL, smallest), len(timed))


def _apart(animals: Sequence[SubjectRDM]) -> tuple[float, float] | None:
    """Return the p of what quarters in time share, and its size beside random ones; None where no quarters are."""
    from scipy.special import stdtr

    observed, *null = finite_mean(np.stack([animal.apart for animal in animals]), axis=0)
    chance = np.array(null)[np.isfinite(null)]
    if not np.isfinite(observed) or len(chance) < 3 or not chance.std() > 0:
        return None
    # Means over animals, shifts and pairs of stimuli are nearly normal: Student's t of one value beside others.
    t = (observed - chance.mean()) / (chance.std(ddof=1) * math.sqrt(1 + 1 / len(chance)))
    share = max(0.0, float(observed)) / float(chance.mean()) if chance.mean() > 0 else math.nan
    return float(stdtr(len(chance) - 1, t)), share


def drift_between(animals: Sequence[SubjectRDM], *, seed: int = 0) -> Drift | None:
    """Compare the earlier with the later sessions of each animal, in random orders too; None without such animals."""
    generator, sums, count = np.random.default_rng(seed), np.zeros(_ORDERS + 1), 0
    for animal in animals:
        size = len(animal.between)
        common = animal.between.sum() - np.trace(animal.between)
        # Sessions that have nothing in common lose nothing over time.
        if size < FEWEST_SESSIONS or not common > 0:
            continue
        orders = np.tile(np.arange(size), (_ORDERS + 1, 1))
        orders[1:] = generator.permuted(orders[1:], axis=1)
        half = size // 2
        crossed = animal.between[orders[:, :half, None], orders[:, None, size - half :]]
        sums += crossed.mean(axis=(1, 2)) / (common / (size * (size - 1)))
        count += 1
    if not count:
        return None
    shares = sums / count
    return Drift(float(shares[0]), 1.0, _tail(shares[1:], float(shares[0])), LEVEL, count)


def _tail(null: np.ndarray, observed: float) -> float:
    return float((1 + (null <= observed + _TIE).sum()) / (len(null) + 1))
