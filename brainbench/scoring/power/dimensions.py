"""Number of dimensions of a representation, for the simulated experiments of ``brainbench power``.

The participation ratio of a signal covariance Σ is (tr Σ)²/tr Σ² (Gao & Ganguli 2015, doi:10.1016/j.conb.2015.04.003):
D for D dimensions of equal variance. Over few stimuli it is smaller: (nD + 2)/(D + n + 1) for n = K − 1 contrasts of
Gaussian patterns in D dimensions, from the second moments of a Wishart matrix, which is solved for D here.

Letters: K stimulus, R trial, U unit, F feature.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.metrics.arrays import Floats

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
    if n_stimuli < 3:
        raise UsageError(f"Dimensions are estimated from at least 3 stimuli; received {n_stimuli}.")
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
