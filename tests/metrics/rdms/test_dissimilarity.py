"""RDMs against rsatoolbox, closed forms and exact arithmetic."""

from __future__ import annotations

import math
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import noise_precision, rdm
from brainbench.metrics.rdms.comparison import permuted_pairs, square
from brainbench.metrics.rdms.dissimilarity import RDM_METHODS

METHODS_WITHOUT_FOLDS = [method for method in RDM_METHODS if method != "crossnobis"]


def _make_trials(seed=0, stimuli=6, units=23, repeats=10, offset=5.0):
    rng = np.random.default_rng(seed)
    labels = np.tile(np.arange(stimuli), repeats)
    folds = np.repeat(np.arange(repeats) % 5, stimuli)
    means = rng.gamma(2.0, 2.0, size=(stimuli, units))
    return means[labels] + rng.gamma(1.0, 1.0, size=(len(labels), units)) + offset, labels, folds


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("method", ["shrinkage_diag", "shrinkage_eye", "diag", "full"])
def test_noise_precision_equals_rsatoolbox(method):
    rsa_data = pytest.importorskip("rsatoolbox.data")
    from rsatoolbox.data.noise import prec_from_unbalanced

    trials, labels, _ = _make_trials(repeats=20)
    expected = prec_from_unbalanced(rsa_data.Dataset(trials, obs_descriptors={"s": labels}), "s", method=method)
    np.testing.assert_allclose(noise_precision(trials, labels, method=method), expected, rtol=1e-8, atol=1e-10)


def test_a_covariance_of_too_few_trials_names_the_way_out():
    trials, labels, _ = _make_trials(repeats=2, units=30)
    with pytest.raises(DataError, match="use method='shrinkage_diag'"):
        noise_precision(trials, labels, method="full")
    assert np.isfinite(noise_precision(trials, labels)).all()
    trials[:, 3] = 1.0
    with pytest.raises(DataError, match="1 of 30 units never vary"):
        noise_precision(trials, labels)
    with pytest.raises(DataError, match="more complete trials"):
        noise_precision(trials[:6], labels[:6])
    with pytest.raises(UsageError, match="did you mean 'diag'"):
        noise_precision(trials, labels, method="diagg")


@pytest.mark.parametrize("wrong", [np.full((2, 2), np.nan), [[1.0, 0.5], [0.1, 1.0]], -np.eye(2), np.zeros((2, 2))])
def test_a_noise_precision_is_symmetric_and_positive(wrong) -> None:
    with pytest.raises(UsageError, match="noise precision is a symmetric"):
        rdm(np.arange(6.0).reshape(3, 2), method="mahalanobis", precision=wrong)


def _rsatoolbox_rdm(trials, labels, method, **options):
    rsa_data = pytest.importorskip("rsatoolbox.data")
    rsa_rdm = pytest.importorskip("rsatoolbox.rdm")
    descriptors = {"stimulus": labels}
    if "folds" in options:
        descriptors["fold"] = options.pop("folds")
        options["cv_descriptor"] = "fold"
    dataset = rsa_data.Dataset(trials, obs_descriptors=descriptors)
    return rsa_rdm.calc_rdm(dataset, method=method, descriptor="stimulus", **options).dissimilarities[0]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("method", "theirs"), [("correlation", "correlation"), ("sqeuclidean", "euclidean"), ("poisson", "poisson")]
)
def test_plain_distances_equal_rsatoolbox(method, theirs):
    trials, labels, _ = _make_trials()
    np.testing.assert_allclose(
        rdm(trials, labels, method=method), _rsatoolbox_rdm(trials, labels, theirs), rtol=1e-10, atol=1e-12
    )


@pytest.mark.filterwarnings("ignore")
def test_mahalanobis_equals_rsatoolbox():
    trials, labels, _ = _make_trials()
    precision = noise_precision(trials, labels)
    expected = _rsatoolbox_rdm(trials, labels, "mahalanobis", noise=precision)
    np.testing.assert_allclose(rdm(trials, labels, method="mahalanobis", precision=precision), expected, rtol=1e-10)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("with_precision", [False, True])
def test_crossnobis_equals_rsatoolbox_on_balanced_folds(with_precision):
    trials, labels, folds = _make_trials()
    precision = noise_precision(trials, labels) if with_precision else None
    expected = _rsatoolbox_rdm(trials, labels, "crossnobis", noise=precision, folds=folds)
    result = rdm(trials, labels, method="crossnobis", folds=folds, precision=precision)
    np.testing.assert_allclose(result, expected, rtol=1e-10, atol=1e-12)


def test_scipy_agrees_on_patterns_without_trials():
    patterns = np.random.default_rng(1).normal(size=(7, 40))
    np.testing.assert_allclose(rdm(patterns), pdist(patterns, "correlation"), atol=1e-13)
    np.testing.assert_allclose(rdm(patterns, method="sqeuclidean"), pdist(patterns, "sqeuclidean") / 40, rtol=1e-12)


def test_crossnobis_is_zero_on_average_when_stimuli_do_not_differ():
    rng = np.random.default_rng(2)
    labels, folds = np.tile(np.arange(3), 4), np.repeat(np.arange(4), 3)
    draws = np.stack(
        [rdm(rng.normal(size=(12, 20)), labels, method="crossnobis", folds=folds) for _ in range(400)]
    ).ravel()
    assert abs(draws.mean()) < 4 * draws.std() / math.sqrt(len(draws) / 3)
    assert (draws < 0).mean() > 0.3


def test_crossnobis_leaves_out_fold_pairs_that_lack_a_stimulus():
    trials, labels, folds = _make_trials(repeats=5)
    keep = ~((labels == 2) & (folds == 4))
    complete = rdm(trials[folds != 4], labels[folds != 4], method="crossnobis", folds=folds[folds != 4])
    result = rdm(trials[keep], labels[keep], method="crossnobis", folds=folds[keep])
    touches_two = square(np.arange(15.0) + 1)[2]
    of_two = np.isin(np.arange(15.0) + 1, touches_two)
    np.testing.assert_allclose(result[of_two], complete[of_two], rtol=1e-12)
    assert not np.allclose(result[~of_two], complete[~of_two])


def test_a_pair_uses_the_units_recorded_in_both_stimuli():
    rng = np.random.default_rng(3)
    means = rng.normal(size=(3, 12))
    means[0, :3] = np.nan
    both = [(0, 1, slice(3, None)), (0, 2, slice(3, None)), (1, 2, slice(None))]
    expected = [1 - np.corrcoef(means[i, s], means[j, s])[0, 1] for i, j, s in both]
    np.testing.assert_allclose(rdm(means, [0, 1, 2]), expected, atol=1e-12)
    squared = [np.mean((means[i, s] - means[j, s]) ** 2) for i, j, s in both]
    np.testing.assert_allclose(rdm(means, [0, 1, 2], method="sqeuclidean"), squared, rtol=1e-12)


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "mahalanobis", "poisson"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_complete_pattern_with_a_broken_activation_is_broken_not_missing(value, method):
    patterns = np.random.default_rng(4).gamma(2.0, size=(4, 9))
    patterns[1, 3] = value
    precision = np.eye(9) + 0.1 if method == "mahalanobis" else None
    result = square(rdm(patterns, method=method, precision=precision))
    assert np.isnan(result[1, [0, 2, 3]]).all()
    assert np.isfinite(result[np.ix_([0, 2, 3], [0, 2, 3])]).all()


@pytest.mark.parametrize("value", [0.1, 1e8, 0.0])
def test_a_constant_pattern_has_nan_correlation_distances_and_a_reason(value):
    patterns = np.random.default_rng(5).normal(size=(3, 1001))
    patterns[2] = value
    assert np.isnan(rdm(patterns)).tolist() == [False, True, True]
    assert np.isfinite(rdm(patterns, method="sqeuclidean")).all()


def test_infinite_activations_give_nan_pairs():
    patterns = np.random.default_rng(7).normal(size=(3, 5))
    patterns[0, 0] = np.inf
    for method in METHODS_WITHOUT_FOLDS[:3]:
        assert np.isnan(rdm(patterns, method=method)[:2]).all()


def test_float32_input_is_computed_in_float64():
    patterns = (100 + np.random.default_rng(9).normal(size=(4, 3000))).astype(np.float32)
    np.testing.assert_array_equal(rdm(patterns), rdm(patterns.astype(np.float64)))


def test_patterns_larger_than_one_slice_of_units_agree_with_scipy(monkeypatch):
    monkeypatch.setattr("brainbench.metrics.rdms.dissimilarity._SLICE_ELEMENTS", 64)
    patterns = np.random.default_rng(10).normal(size=(5, 333))
    np.testing.assert_allclose(rdm(patterns), pdist(patterns, "correlation"), atol=1e-13)
    np.testing.assert_allclose(rdm(patterns, method="sqeuclidean"), pdist(patterns, "sqeuclidean") / 333, rtol=1e-12)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from(RDM_METHODS))
def test_the_order_of_trials_units_and_stimuli_is_irrelevant(seed, method):
    trials, labels, folds = _make_trials(seed=seed % 50, stimuli=5, units=9, repeats=6)
    rng = np.random.default_rng(seed)
    rows, columns, relabelled = rng.permutation(len(trials)), rng.permutation(9), rng.permutation(5)
    chosen = folds if method == "crossnobis" else None
    expected = rdm(trials, labels, method=method, folds=chosen)
    result = rdm(
        trials[np.ix_(rows, columns)],
        np.argsort(relabelled)[labels][rows],
        method=method,
        folds=None if chosen is None else chosen[rows],
    )
    np.testing.assert_allclose(result, expected[permuted_pairs(relabelled[None])[0]], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "corelation"}, "did you mean 'correlation'"),
        ({"folds": [0, 1, 0]}, "folds are for method='crossnobis'"),
        ({"precision": np.eye(4)}, "method='correlation' does not use it"),
        ({"method": "crossnobis"}, "needs labels and folds"),
        ({"method": "mahalanobis", "precision": np.eye(3)}, r"shape \(4, 4\); received \(3, 3\)"),
        ({"labels": [0, 1]}, "3 trials but 2 labels"),
        ({"labels": [0.5, 1, 2]}, "Labels must be integers from 0 or strings"),
        ({"labels": [-1, 0, 1]}, "run from 0"),
        ({"labels": [0, 0, 0]}, "number of stimuli of an RDM .*at least 2; received 1"),
    ],
)
def test_misuse_is_told_in_a_sentence(arguments, message):
    with pytest.raises(UsageError, match=message):
        rdm(np.ones((3, 4)), **arguments)


def test_negative_rates_are_refused_by_poisson():
    with pytest.raises(DataError, match="the smallest is -1"):
        rdm([[1.0, -1.0], [2.0, 0.0]], method="poisson")


def test_a_single_unit_has_distances_but_no_correlations():
    responses = np.array([[1.0], [2.0], [4.0]])
    assert np.isnan(rdm(responses)).all()
    np.testing.assert_array_equal(rdm(responses, method="sqeuclidean"), [1.0, 9.0, 4.0])


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_crossnobis_of_unequal_folds_is_the_mean_over_pairs_of_folds(missing):
    random = np.random.default_rng(0)
    labels, folds = np.append(np.arange(5), random.integers(0, 5, 45)), random.integers(0, 4, 50)
    trials = random.normal(size=(50, 7)) + 100
    trials[random.random(trials.shape) < missing] = np.nan
    expected = []
    for i, j in combinations(range(5), 2):
        found = []
        for m, n in permutations(range(4), 2):
            cells = [trials[(folds == fold) & (labels == label)] for fold in (m, n) for label in (i, j)]
            if all(map(len, cells)):
                means = [np.ma.masked_invalid(cell).mean(axis=0) for cell in cells]
                found.append(((means[0] - means[1]) * (means[2] - means[3])).mean())
        expected.append(np.mean(found))
    np.testing.assert_allclose(rdm(trials, labels, method="crossnobis", folds=folds), expected)
