"""The same numbers by numpy and by torch, on the processor here and on CUDA where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import compare_models, noise_precision, permutation_test, rdm
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.metrics.rdms.comparison import COMPARISONS
from brainbench.metrics.rdms.dissimilarity import NOISE_METHODS, RDM_METHODS
from tests.factories.animals import STIMULI, make_rdm, make_subject

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]


def _make_trials(seed=0, stimuli=5, units=37, repeats=8):
    rng = np.random.default_rng(seed)
    labels = np.tile(np.arange(stimuli), repeats)
    trials = rng.gamma(2.0, 2.0, size=(stimuli, units))[labels] + rng.gamma(1.0, 1.0, size=(len(labels), units))
    return trials, labels, np.repeat(np.arange(repeats) % 4, stimuli)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("method", RDM_METHODS)
def test_rdms_of_trials_are_the_same(method, dtype, device):
    trials, labels, folds = _make_trials()
    trials = trials.astype(dtype)
    options = {"method": method, "folds": folds if method == "crossnobis" else None}
    expected = rdm(trials, labels, **options)
    for given, where in ((trials, device), (torch.from_numpy(trials).to(device), None)):
        found = rdm(given, labels, device=where, **options)
        assert isinstance(found, np.ndarray)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "poisson"])
def test_rdms_of_wide_patterns_are_the_same_in_slices(method, device, monkeypatch):
    monkeypatch.setattr("brainbench.metrics.rdms.dissimilarity._SLICE_ELEMENTS", 64)
    patterns = 1e4 + np.random.default_rng(1).gamma(2.0, size=(6, 301))
    patterns[2, 5] = np.nan
    expected = rdm(patterns, method=method)
    assert np.isnan(expected).sum() == 5
    np.testing.assert_allclose(rdm(patterns, method=method, device=device), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", RDM_METHODS)
def test_missing_entries_are_left_out_alike(method, device):
    trials, labels, folds = _make_trials(seed=2)
    rng = np.random.default_rng(3)
    trials[rng.random(trials.shape) < 0.3] = np.nan
    trials[np.ix_(labels == 1, [4, 7])] = np.nan
    trials[(labels == 2) & (folds == 3)] = np.nan
    options = {"method": method, "folds": folds if method == "crossnobis" else None}
    expected = rdm(trials, labels, **options)
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(rdm(trials, labels, device=device, **options), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("device", [None, *DEVICES])
@pytest.mark.parametrize("noise", NOISE_METHODS)
@pytest.mark.parametrize(("units", "repeats"), [(37, 20), (90, 12)])
@pytest.mark.parametrize("method", ["mahalanobis", "crossnobis"])
def test_a_noise_covariance_by_name_gives_what_its_inverse_gives(method, units, repeats, noise, device):
    trials, labels, folds = _make_trials(seed=4, units=units, repeats=repeats)
    options = {"method": method, "folds": folds if method == "crossnobis" else None}
    if noise == "full" and units > len(trials):
        with pytest.raises(DataError, match="use method='shrinkage_diag'"):
            rdm(trials, labels, precision=noise, device=device, **options)
        return
    precision = noise_precision(trials, labels, method=noise)
    expected = rdm(trials, labels, precision=precision, **options)
    for weight in (noise, precision):
        found = rdm(trials, labels, precision=weight, device=device, **options)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(noise_precision(trials, labels, method=noise, device=device), precision, atol=1e-10)


def test_a_noise_covariance_by_name_needs_no_matrix_of_units_by_units():
    # 60,000 units: the matrix alone would take 29 GB.
    trials, labels, folds = _make_trials(seed=5, units=60_000, repeats=4)
    found = rdm(trials, labels, method="crossnobis", folds=folds, precision="shrinkage_diag")
    assert np.isfinite(found).all()
    plain = rdm(trials * 3, labels, method="crossnobis", folds=folds, precision="diag")
    np.testing.assert_allclose(found, plain, rtol=0.3)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", COMPARISONS)
@pytest.mark.parametrize("stimuli", [6, 10])
def test_permutation_tests_are_the_same(method, stimuli, device, monkeypatch):
    monkeypatch.setattr("brainbench.metrics.inference.permutation.RANDOM_PERMUTATIONS", 300)
    rng = np.random.default_rng(6)
    model, brain = rdm(rng.normal(size=(stimuli, 9))), np.stack([rdm(rng.normal(size=(stimuli, 9))) for _ in range(4)])
    expected = permutation_test(model, brain, method=method)
    found = permutation_test(model, brain, method=method, device=device)
    np.testing.assert_allclose(found.null, expected.null, atol=1e-12)
    assert found.p == expected.p


@pytest.mark.parametrize("device", DEVICES)
def test_scores_are_the_same(device):
    rng = np.random.default_rng(7)
    animals = [make_subject(f"m{i}", make_rdm(rng), seed=i) for i in range(4)]
    layers = {name: make_rdm(rng) for name in "abc"}
    one = score_rdms(layers, animals, name="x", stimuli=STIMULI)
    two = score_rdms(layers, animals, name="x", stimuli=STIMULI, device=device)
    assert (one.value, one.p, one.layer) == (pytest.approx(two.value, abs=1e-12), two.p, two.layer)
    for plain, moved in zip(*(score.provenance.statistics["layer_tests"] for score in (one, two)), strict=True):
        assert plain == moved
    first, second = (compare_models({"x": layers}, animals, stimuli=STIMULI, device=d) for d in (None, device))
    assert first.models[0].p_corrected == second.models[0].p_corrected


def test_infinite_trials_are_refused_on_a_device_too():
    trials, labels, _ = _make_trials()
    trials[0, 0] = np.inf
    with pytest.raises(DataError, match="1 responses are infinite"):
        rdm(trials, labels, device="cpu")


def test_a_covariance_by_name_is_spelled_right_and_has_trials():
    with pytest.raises(UsageError, match="did you mean 'shrinkage_diag'"):
        rdm(np.eye(4), method="mahalanobis", precision="shrinkage-diag")
    with pytest.raises(UsageError, match="estimated from trials: give labels"):
        rdm(np.eye(4), method="mahalanobis", precision="diag")
