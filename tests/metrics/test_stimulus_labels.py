"""Labels of trials, responses to them and their means."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import rdm
from brainbench.metrics.rdms.comparison import permuted_pairs, square


def _make_trials(seed=0, stimuli=6, units=23, repeats=10, offset=5.0):
    rng = np.random.default_rng(seed)
    labels = np.tile(np.arange(stimuli), repeats)
    folds = np.repeat(np.arange(repeats) % 5, stimuli)
    means = rng.gamma(2.0, 2.0, size=(stimuli, units))
    return means[labels] + rng.gamma(1.0, 1.0, size=(len(labels), units)) + offset, labels, folds


def test_the_mean_over_trials_skips_missing_entries():
    trials, labels, _ = _make_trials(stimuli=3, repeats=3, units=4)
    trials[0, 1] = np.nan
    means = np.array([[np.nanmean(trials[labels == k, u]) for u in range(4)] for k in range(3)])
    np.testing.assert_allclose(rdm(trials, labels), pdist(means, "correlation"), atol=1e-12)


def test_a_stimulus_without_trials_is_missing_in_its_own_place():
    trials = np.random.default_rng(6).normal(size=(6, 8))
    result = square(rdm(trials, [0, 0, 1, 1, 3, 3]))
    assert result.shape == (4, 4)
    assert np.isnan(result[2, [0, 1, 3]]).all()


def _exact_correlation_distance(x, y):
    """Arithmetic on the floats' exact values; only the last square root rounds."""
    a, b = [Fraction(float(v)) for v in x], [Fraction(float(v)) for v in y]
    a, b = [v - sum(a) / len(a) for v in a], [v - sum(b) / len(b) for v in b]
    cross = sum(p * q for p, q in zip(a, b, strict=True))
    size = sum(p * p for p in a) * sum(q * q for q in b)
    return 1 - float(cross) / math.sqrt(float(size))


def test_a_huge_offset_costs_no_digits():
    patterns = 1e8 + 1e-3 * np.random.default_rng(8).normal(size=(3, 50))
    exact = [_exact_correlation_distance(patterns[i], patterns[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(rdm(patterns), exact, atol=1e-12)
    exact_squares = [float(np.mean((patterns[i] - patterns[j]) ** 2)) for i, j in ((0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(rdm(patterns, method="sqeuclidean"), exact_squares, rtol=1e-9)
    labels = np.repeat([0, 1, 2], 4)
    trials = np.repeat(patterns, 4, axis=0)
    np.testing.assert_allclose(rdm(trials, labels), exact, atol=1e-4)


def test_string_labels_are_sorted_and_integer_labels_are_positions():
    trials, labels, _ = _make_trials(stimuli=3)
    names = np.array(["c", "a", "b"])[labels]
    order = permuted_pairs(np.array([[1, 2, 0]]))[0]
    np.testing.assert_allclose(rdm(trials, names), rdm(trials, labels)[order], rtol=1e-12)


def test_responses_must_be_a_matrix_of_numbers():
    with pytest.raises(UsageError, match="flatten time and space"):
        rdm(np.ones((3, 4, 5)))
    with pytest.raises(UsageError, match="real numbers"):
        rdm([["a", "b"], ["c", "d"]])
    with pytest.raises(UsageError, match="unequal length"):
        rdm([[1, 2], [3]])


def test_infinite_trials_are_refused():
    with pytest.raises(DataError, match="1 responses are infinite"):
        rdm([[1.0, np.inf], [2.0, 0.0]], [0, 1])
