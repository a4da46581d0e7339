"""Representational dissimilarity matrices (RDMs).

Conventions are those of rsatoolbox 0.3.2: distances are squared and divided by the number of units,
correlation distance is 1 − r, and the result is the upper triangle [P], row by row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.errors import DataError, UsageError, unknown_name
from brainbench.metrics._distances import correlation_distances, product_distances, products_from_gram
from brainbench.metrics._labels import listed, response_matrix, stimulus_codes, stimulus_means
from brainbench.metrics._pairs import Floats, Ints

POISSON_PRIOR_MEAN = 1.0
POISSON_PRIOR_WEIGHT = 0.1
"""Gamma prior that keeps the logarithm of a silent unit finite (rsatoolbox's defaults)."""


@dataclass(frozen=True)
class _Trials:
    """What a method may use: responses of K stimuli as given, and for labelled trials their codes."""

    responses: NDArray
    count: int
    codes: Ints | None
    folds: ArrayLike | None
    precision: ArrayLike | None

    @property
    def missing(self) -> bool:
        """Whether NaN means not recorded; a NaN activation makes its pattern useless instead."""
        return self.codes is not None

    @property
    def trials(self) -> NDArray | None:
        """[R, U] labelled trials."""
        return None if self.codes is None else self.responses

    def patterns(self) -> NDArray:
        """Return patterns [K, U]."""
        return self.responses if self.codes is None else stimulus_means(self.responses, self.codes, self.count)


def rdm(
    responses: ArrayLike,
    labels: ArrayLike | None = None,
    *,
    method: str = "correlation",
    folds: ArrayLike | None = None,
    precision: ArrayLike | None = None,
) -> Floats:
    """Return the RDM of stimulus patterns, upper triangle [P].

    Without ``labels`` each row of ``responses`` [K, U] is one stimulus' complete pattern. With
    ``labels`` [R] the rows are trials [R, U], averaged per stimulus; NaN is a missing entry, and a
    pair of stimuli uses the units that have a value for both (with ``precision`` a stimulus that lacks
    a unit has NaN pairs). Integer labels are positions 0 … K−1, strings are sorted.

    Args:
        responses: [K, U] or [R, U], any real type; computed in float64.
        labels: Stimulus of each trial, or None.
        method: ``correlation`` 1 − Pearson r; ``sqeuclidean``; ``mahalanobis`` (with ``precision``;
            squared Euclidean without); ``crossnobis`` cross-validated Mahalanobis distance, mean over
            pairs of folds (Walther 2016; unbiased, can be negative); ``poisson`` symmetrised
            Kullback-Leibler divergence of Poisson rates (Schütt 2023).
        folds: Cross-validation fold of each trial [R]; needed by ``crossnobis`` only. Every fold weighs
            the same; fold pairs in which a stimulus is missing are left out of its pairs.
        precision: Inverse noise covariance [U, U] between units, symmetric, see :func:`noise_precision`.

    Returns:
        Distances [P], float64. A pair that has no distance (constant pattern, non-finite entry, no
        trials) is NaN; :func:`rdm_problem` says why.

    Raises:
        UsageError: unknown method, shapes that do not fit, folds missing or not wanted.
        DataError: infinite trials, or negative rates for ``poisson``.

    >>> rdm([[1, 2, 3], [2, 4, 6], [3, 2, 1]]).round(3).tolist()
    [0.0, 2.0, 2.0]
    >>> rdm([[1, 2], [3, 2], [5, 5]], ["b", "b", "a"], method="sqeuclidean").tolist()
    [9.0]
    """
    if method not in _METHODS:
        raise unknown_name("RDM method", method, _METHODS)
    if folds is not None and method != "crossnobis":
        raise UsageError(f"folds are for method='crossnobis'; method={method!r} averages all trials; leave them out.")
    if precision is not None and method not in ("mahalanobis", "crossnobis"):
        raise UsageError(f"A noise precision is for 'mahalanobis' and 'crossnobis'; method={method!r} does not use it.")
    return _METHODS[method](_prepare(responses, labels, folds, precision))


def rdm_problem(responses: ArrayLike, labels: ArrayLike | None = None) -> str | None:
    """Say in words why some pairs of the RDM of ``responses`` have no distance; None if none does.

    Constant patterns matter to correlation distance only.
    """
    matrix = response_matrix(responses, "stimuli" if labels is None else "trials")
    if labels is None:
        patterns, names = matrix, tuple(str(row) for row in range(len(matrix)))
    else:
        codes, names = stimulus_codes(labels)
        patterns = stimulus_means(matrix, codes, len(names))
        empty = np.asarray(~np.isfinite(patterns).any(axis=1))
        if empty.any():
            return f"no trials of stimulus {listed(names, empty)}"
    broken = np.asarray(~np.isfinite(patterns).all(axis=1))
    if labels is None and broken.any():
        return f"activations that are not finite for stimulus {listed(names, broken)}"
    with np.errstate(invalid="ignore"):
        spread = np.nanmax(patterns, axis=1) - np.nanmin(patterns, axis=1)
        constant = np.asarray(spread <= 8 * np.finfo(np.float64).eps * np.nanmax(np.abs(patterns), axis=1))
    if constant.any():
        return f"a constant response across units to stimulus {listed(names, constant)}"
    return None


def _prepare(
    responses: ArrayLike, labels: ArrayLike | None, folds: ArrayLike | None, precision: ArrayLike | None
) -> _Trials:
    if labels is None:
        matrix, codes = response_matrix(responses, "stimuli"), None
        count = len(matrix)
    else:
        matrix = response_matrix(responses, "trials")
        codes, names = stimulus_codes(labels)
        count = len(names)
        if len(codes) != len(matrix):
            raise UsageError(f"There are {len(matrix)} trials but {len(codes)} labels; give one label per trial.")
    if count < 2:
        raise UsageError(f"An RDM compares at least 2 stimuli; received {count}.")
    return _Trials(matrix, count, codes, folds, precision)


def _correlation(given: _Trials) -> Floats:
    return correlation_distances(given.patterns(), missing=given.missing)


def _sqeuclidean(given: _Trials) -> Floats:
    patterns = given.patterns()
    return product_distances(patterns, patterns, missing=given.missing)


def _mahalanobis(given: _Trials) -> Floats:
    if given.precision is None:
        return _sqeuclidean(given)
    patterns = given.patterns()
    weight = _precision_matrix(given.precision, patterns.shape[1])
    # The shift per unit must go before the product mixes units.
    centred = patterns - patterns.mean(axis=0, dtype=np.float64)
    return product_distances(centred, centred @ weight)


def _crossnobis(given: _Trials) -> Floats:
    if given.trials is None or given.codes is None or given.folds is None:
        raise UsageError(
            "method='crossnobis' needs labels and folds: one stimulus and one cross-validation fold per trial."
        )
    folds = np.asarray(given.folds)
    if folds.shape != given.codes.shape:
        raise UsageError(f"There are {len(given.codes)} trials but folds of shape {folds.shape}; give one per trial.")
    names = np.unique(folds)
    if len(names) < 2:
        raise UsageError(f"method='crossnobis' compares at least 2 folds; received {len(names)}.")
    units, count = given.trials.shape[1], given.count
    weight = None if given.precision is None else _precision_matrix(given.precision, units)
    # Fold and stimulus together number the cells, so one pass over the trials averages all of them.
    cells = np.searchsorted(names, folds) * count + given.codes
    means = stimulus_means(given.trials, cells, len(names) * count).reshape(len(names), count, units)
    if not np.isfinite(means).all():
        return _crossnobis_of_present(means, weight)
    means -= means.mean(axis=(0, 1))
    # Products of all folds with all, less those of each with itself, are those of all pairs of folds.
    if len(names) == 2:
        gram = (means[0] if weight is None else means[0] @ weight) @ means[1].T
        return products_from_gram(gram, units)
    flat = means.reshape(-1, units)
    weighted = flat if weight is None else flat @ weight
    total = means.sum(axis=0) @ weighted.reshape(means.shape).sum(axis=0).T
    gram = total - np.einsum("fiu,fju->ij", means, weighted.reshape(means.shape), optimize=True)
    return products_from_gram(gram, units) / (len(names) * (len(names) - 1))


def _crossnobis_of_present(means: Floats, weight: Floats | None) -> Floats:
    """Average over the pairs of folds in which both stimuli have a value."""
    weighted = means if weight is None else means @ weight
    total = np.zeros(means.shape[1] * (means.shape[1] - 1) // 2)
    found = np.zeros_like(total)
    for first in range(len(means)):
        for second in range(first + 1, len(means)):
            distance = product_distances(means[first], weighted[second], missing=True)
            known = np.isfinite(distance)
            total += np.where(known, distance, 0.0)
            found += known
    return np.where(found > 0, total / np.maximum(found, 1), np.nan)


def _poisson(given: _Trials) -> Floats:
    patterns = given.patterns()
    low = float(np.nanmin(patterns, initial=np.inf))
    if low < 0:
        raise DataError(f"method='poisson' needs rates or counts, which are never negative; the smallest is {low:g}.")
    rates = poisson_rates(patterns)
    return product_distances(rates, np.log(rates), missing=given.missing)


def poisson_rates(rates: NDArray) -> Floats:
    """Return rates under the gamma prior, which are never zero."""
    return (rates + POISSON_PRIOR_MEAN * POISSON_PRIOR_WEIGHT) / (1 + POISSON_PRIOR_WEIGHT)


def _precision_matrix(precision: ArrayLike, units: int) -> Floats:
    weight = np.asarray(precision, dtype=np.float64)
    if weight.shape != (units, units):
        raise UsageError(f"The noise precision of {units} units has shape ({units}, {units}); received {weight.shape}.")
    return weight


_METHODS: dict[str, Callable[[_Trials], Floats]] = {
    "correlation": _correlation,
    "sqeuclidean": _sqeuclidean,
    "mahalanobis": _mahalanobis,
    "crossnobis": _crossnobis,
    "poisson": _poisson,
}

RDM_METHODS = tuple(_METHODS)
"""Names that ``method`` of :func:`rdm` takes."""
