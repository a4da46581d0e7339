"""Power analysis: the share of experiments that find a model which is truly alike.

Experiments are simulated at the level of RDMs. Every RDM is a standardised vector of squared Euclidean
distances between random patterns of ``dimensions``, so distances that share a stimulus are dependent as
they are in data: the fewer dimensions, the more of them depend on a few directions, and the easier unrelated
models agree by luck. With s shared by all animals and the other terms drawn anew for each:

    animal      t = √c · s + √(1 − c) · own        c: consistency between animals' noiseless RDMs
    measured    √q · t + √(1 − q) · noise          q: reliability of what differs between its distances
    model       (e/√c) · s + √(1 − e²/c) · other   e: the effect, the score that is true, between chance and 1

A score states the reliability r of whole RDMs. Their mean distance is reliable and says nothing of a model: over n =
K − 1 contrasts of Gaussian patterns it has h = (nD + 2)/((n − 1)(n + 2)) times the whitened square of the differences,
from the same moments as the dimensions below, so q = r/(r + (1 + h)(1 − r)).

A score, a consistency and a reliability are means over experiments of what a few stimuli show. There the comparison of
x · a + √(1 − x²) · b with a is below x on average, by 8 % with five stimuli. The weights above are therefore those
whose mean comparison is √c, √q and e/√c; sums whose other terms are independent multiply these means.

Each experiment goes through the permutation test of a score, with the
choice among ``layers`` of which one has the effect and the others know nothing. The comparison is the whitened one
with the mean distance taken away, which has the same permutations as the whitened cosine and a chance of 0.

The participation ratio of a signal covariance Σ is (tr Σ)²/tr Σ² (Gao & Ganguli 2015, doi:10.1016/j.conb.2015.04.003):
D for D dimensions of equal variance. Over few stimuli it is smaller: (nD + 2)/(D + n + 1) for n = K − 1 contrasts of
Gaussian patterns in D dimensions, from the second moments of a Wishart matrix, which is solved for D here.

Letters: K stimulus, R trial, U unit, F feature.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError, check_name, check_number
from brainbench.core.limits import Count, Limit, Share, limited
from brainbench.core.records import Interval
from brainbench.core.statistics import wilson_interval
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.evaluation import held_out
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, label_orders, smallest_p, tail_p
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import LINEAR, features, upper

MOST = 100.0  # largest number of dimensions that is told apart from more
_SPLITS = 20


def pattern_dimensions(patterns: ArrayLike) -> float:
    """Return the dimensions of patterns [K, F] without noise, such as a layer's features."""
    array = np.asarray(patterns, dtype=np.float64)
    if array.ndim != 2 or len(array) < 3:
        raise UsageError(f"Dimensions need patterns [stimuli, features] of 3 stimuli; received shape {array.shape}.")
    gram = _products(array, array)
    return _solved(_moments(gram, gram), len(array))


def signal_dimensions(animals: Iterable[Sequence[Trials]], n_stimuli: int, *, seed: int = 0) -> float:
    """Return the dimensions of what animals share, without the noise of trials and of the sample of units.

    Trials of every stimulus are split into four parts and units into two, at random and several times. Products of
    different parts of the trials hold no trial noise, and products of the two sets of units no noise of their sampling;
    numerator and denominator are averaged over splits and animals before they are divided. What an animal has of its
    own adds dimensions to its responses. Shared and own parts with weights a and b = 1 − a give 1/D_one = (a² + b²)/D
    within an animal and 1/D_two = a²/D between two, which are solved for D. ``animals`` are the sessions of each
    animal, responses [R, U] or [R, T, U], whose time is averaged.
    """
    check_number("The number of stimuli of dimensions", n_stimuli, least=3, whole=True)
    within, products = np.zeros(2), []
    for index, blocks in enumerate(animals):
        whole = np.zeros((n_stimuli, n_stimuli))
        for number, block in enumerate(blocks):
            values = np.asarray(block.responses, dtype=np.float64)
            values = values.mean(axis=1) if values.ndim == 3 else values
            values = values[:, np.isfinite(values).all(axis=0)]
            labels = np.asarray(block.labels)
            if values.shape[1] < 2 or np.bincount(labels, minlength=n_stimuli).min() < 4:
                continue
            generator = np.random.default_rng([seed, index, number])
            for _ in range(_SPLITS):
                first, second = _split_products(values, labels, n_stimuli, generator)
                within += _moments(first, second)
                whole += first + second
        if whole.any():
            products.append(whole)
    if not products:
        raise DataError("Dimensions need a session with 4 trials of every stimulus and 2 units; there is none.")
    inside = 1 / _solved(within, n_stimuli)
    if len(products) == 1:
        return 1 / inside
    between = sum((_moments(one, two) for one, two in combinations(products, 2)), np.zeros(2))
    shared = min(inside, 1 / _solved(between, n_stimuli))
    return min(MOST, max(1.0, (math.sqrt(shared) + math.sqrt(inside - shared)) ** -2))


def _split_products(
    values: Floats, labels: np.ndarray, count: int, generator: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return two independent estimates [K, K] of the inner products of mean responses."""
    # Trials of a stimulus go round the four parts in a random order.
    order = generator.permutation(len(labels))
    part = np.empty(len(labels), dtype=np.int64)
    for stimulus in range(count):
        rows = order[labels[order] == stimulus]
        part[rows] = (np.arange(len(rows)) + generator.integers(4)) % 4
    member = np.zeros((4, count, len(labels)))
    member[part, labels, np.arange(len(labels))] = 1.0
    means = (member / member.sum(axis=2, keepdims=True)) @ values
    units = generator.permutation(values.shape[1])
    first, second = np.array_split(units, 2)
    return (_products(means[0][:, first], means[1][:, first]), _products(means[2][:, second], means[3][:, second]))


def _products(left: Floats, right: Floats) -> Floats:
    """Return symmetric inner products [K, K] per unit of patterns centred over stimuli."""
    product = (left - left.mean(axis=0)) @ (right - right.mean(axis=0)).T / left.shape[1]
    return (product + product.T) / 2


def _moments(first: Floats, second: Floats) -> Floats:
    """Return tr G · tr G′ and tr GG′ of inner products [K, K]."""
    return np.array([np.trace(first) * np.trace(second), (first * second).sum()])


def _solved(moments: Floats, stimuli: int) -> float:
    """Return D from estimates of (tr G)² and tr G² over K stimuli."""
    square, total = moments.tolist()
    if not (math.isfinite(square) and square > 0 and total > 0):
        raise DataError("The responses to the stimuli do not differ beyond noise, so they have no dimensions.")
    contrasts = stimuli - 1
    ratio = square / total
    if ratio >= contrasts:
        return MOST
    return min(MOST, max(1.0, (ratio * (contrasts + 1) - 2) / (contrasts - ratio)))


SIMULATIONS = 1000
STIMULUS_COUNTS = (4, 5, 6, 7, 8, 10, 12, 16, 20, 24, 32)
ANIMAL_COUNTS = (1, 2, 3, 4, 5, 6, 8, 11, 15, 20, 30, 50, 100)  # numbers that needed tries, in order

DIMENSIONS = 10  # dimensions of the patterns where nothing is known of them
_COMPARISON = "whitened-pearson"
_ORDERS = 999  # random orders of simulated tests at levels from .01 on; below, as many as a score takes
_EXACT_STIMULI = 6  # up to this many stimuli all orders are taken
_CHUNK_ELEMENTS = 1 << 21
_PAIRS, _WEIGHTS = 4000, 101  # pairs of RDMs, and weights of their sums, whose mean comparison is looked up


@limited
class ExperimentDesign:
    """An experiment, and the truth it is to find."""

    stimuli: Annotated[int, Limit(least=2)] = 6
    """Number of stimuli."""
    animals: Count = 11
    """Number of animals."""
    effect: Annotated[float, Limit(least=-1, most=1)] = 0.5
    """True score of the model on the scale from chance (0) to all that is reliable (1); 0 gives the false alarms."""
    consistency: Share = 0.8
    """Correlation of two animals' noiseless RDMs."""
    reliability: Share = 0.8
    """Reliability of one animal's RDM, as a score and 'recordings rdm --metric rsa' state it."""
    layers: Count = 1
    """Layers among which one is chosen; one of them has the effect."""
    alpha: Annotated[float, Limit(above=0, below=1)] = 0.05
    """Level of the test."""
    dimensions: Count = DIMENSIONS
    """Dimensions of the representations, see :mod:`brainbench.scoring.power.experiments`."""

    def __post_init__(self) -> None:
        """Refuse what no model can reach."""
        if self.effect**2 > self.consistency + 1e-12:
            raise UsageError(
                f"No model can score {self.effect:g} on animals whose consistency is {self.consistency:g}: "
                f"what they share bounds it by √consistency = {math.sqrt(self.consistency):.3g}; lower the effect."
            )

    @property
    def reliability_of_differences(self) -> float:
        """Reliability of an animal's RDM without its mean distance, on which a comparison with a chance of 0 rests."""
        contrasts = self.stimuli - 1
        if contrasts < 2:  # a single distance differs from none
            return 0.0
        mean = (contrasts * self.dimensions + 2) / ((contrasts - 1) * (contrasts + 2))
        return self.reliability / (self.reliability + (1 + mean) * (1 - self.reliability))


@dataclass(frozen=True)
class Power:
    """Share of experiments in which a design finds its effect."""

    design: ExperimentDesign
    power: float
    """Share of simulated experiments with p ≤ α; 0 where no p can be that small."""
    interval: Interval | None
    """Wilson interval from the number of simulations."""
    simulations: int
    p_smallest: float
    reason: str = ""
    """Reason for doing without simulations; empty otherwise."""


def power(design: ExperimentDesign, *, simulations: int = SIMULATIONS, seed: int = 0) -> Power:
    """Simulate experiments of one design."""
    check_number("The number of simulations", simulations, least=1, whole=True)
    check_number("seed", seed, least=0, whole=True)
    smallest = smallest_p(design.stimuli, RSA.orders)
    if design.stimuli < SMALLEST_STIMULI or smallest > design.alpha:
        reason = f"{design.stimuli} stimuli allow no p below {smallest:.3g}, whatever is true"
        return Power(design, 0.0, None, 0, smallest, reason=reason)
    generator = np.random.default_rng(seed)
    # All experiments share their orders of the stimuli, so places are looked up once.
    draws = _ORDERS if design.alpha >= 0.01 else RSA.orders
    orders = np.concatenate(list(label_orders(design.stimuli, seed, exact=_EXACT_STIMULI, draws=draws)))
    # A square matrix read row by row: the entry (i, j) comes from (order[i], order[j]).
    places = (orders[:, :, None] * design.stimuli + orders[:, None, :]).reshape(len(orders), -1)
    # Bounds the models' moved entries and the comparisons, held at once over experiments and orders.
    each = len(places) * design.layers * max(design.stimuli**2, design.animals)
    step, detections = max(1, _CHUNK_ELEMENTS // each), 0
    for start in range(0, simulations, step):
        model, brain = simulate_experiments(generator, design, min(step, simulations - start))
        null = _statistics(model, brain, places)
        detections += int((tail_p(null.T) <= design.alpha).sum())
    interval = wilson_interval(detections, simulations, over="simulated experiments")
    return Power(design, detections / simulations, interval, simulations, smallest)


def needed(
    design: ExperimentDesign,
    vary: str = "stimuli",
    *,
    target: float = 0.8,
    simulations: int = SIMULATIONS,
    seed: int = 0,
) -> int | None:
    """Return the smallest tried number of stimuli or animals whose power reaches ``target``; None if none does."""
    tried = {"stimuli": STIMULUS_COUNTS, "animals": ANIMAL_COUNTS}
    check_name("number that a power analysis varies", vary, tried)
    check_number("The target power", target, above=0, below=1)
    for number in tried[vary]:
        changed = replace(design, **{vary: number})
        if power(changed, simulations=simulations, seed=seed).power >= target:
            return number
    return None


def simulate_experiments(generator: np.random.Generator, design: ExperimentDesign, size: int) -> tuple[Floats, Floats]:
    """Return models [S, L, P] and measured animals [S, A, P]."""
    rdms = partial(_rdms, generator, design.stimuli, design.dimensions)
    c, q = design.consistency, design.reliability_of_differences

    def _mixed(comparison: float, rdm: Floats, rest: Floats) -> Floats:
        # The weights x and √(1 − x²) keep every RDM at unit variance.
        weight = _weight(min(abs(comparison), 1.0), design.stimuli, design.dimensions)
        return math.copysign(weight, comparison) * rdm + math.sqrt(1 - weight**2) * rest

    # The three equations of the module's text.
    shared = rdms(size, 1)
    model = rdms(size, design.layers)
    model[:, :1] = _mixed(design.effect / math.sqrt(c) if c else 0.0, shared, model[:, :1])
    animals = _mixed(math.sqrt(c), shared, rdms(size, design.animals))
    return model, _mixed(math.sqrt(q), animals, rdms(size, design.animals))


def _rdms(generator: np.random.Generator, stimuli: int, dimensions: int, *shape: int) -> Floats:
    """Return standardised squared distances [*shape, P] of Gaussian patterns."""
    patterns = generator.standard_normal((*shape, stimuli, dimensions))
    products = patterns @ patterns.swapaxes(-1, -2)
    squares = np.einsum("...kk->...k", products)
    distances = upper(squares[..., None] + squares[..., None, :] - 2 * products)
    # Squared distances of Gaussian patterns have mean 2D and variance 8D.
    return (distances - 2 * dimensions) / math.sqrt(8 * dimensions)


@lru_cache(maxsize=256)
def _weight(comparison: float, stimuli: int, dimensions: int) -> float:
    """Return x for which x · a + √(1 − x²) · b and a have this mean comparison, for independent RDMs a and b."""
    if stimuli < 3:  # a single distance is compared with nothing
        return comparison
    a, b = LINEAR[_COMPARISON](_rdms(np.random.default_rng(0), stimuli, dimensions, 2, _PAIRS))
    aa, bb, ab = (a * a).sum(axis=-1), (b * b).sum(axis=-1), (a * b).sum(axis=-1)
    # Both signs of what a pair shares by luck, so that the mean of unrelated RDMs is exactly 0.
    aa, bb, ab = np.tile(aa, 2), np.tile(bb, 2), np.concatenate([ab, -ab])
    x = np.linspace(0, 1, _WEIGHTS)[:, None]
    rest = np.sqrt(1 - x**2)
    comparisons = (x * aa + rest * ab) / np.sqrt(aa * (x**2 * aa + 2 * x * rest * ab + rest**2 * bb))
    return float(np.interp(comparison, comparisons.mean(axis=1), x[:, 0]))


def _statistics(model: Floats, brain: Floats, places: Ints) -> Floats:
    """Return the mean comparison [S, N] under every order, the layer chosen on the other animals each time."""
    # Unit vectors once per RDM; a comparison under an order is then a product of moved entries.
    left, right = features(model, _COMPARISON), features(brain, _COMPARISON)
    # r is linear in the animals' unit vectors: with one layer they are averaged before the orders are taken.
    if model.shape[1] == 1:
        return np.einsum("snp,sp->sn", left[:, 0].take(places, axis=1), right.mean(axis=1))
    r = left.take(places, axis=2).reshape(*left.shape[:2], *places.shape) @ right.swapaxes(-1, -2)[:, None]
    r = r.swapaxes(1, 2)
    return (held_out(r) if brain.shape[1] > 1 else r.max(axis=2)).mean(axis=-1)
