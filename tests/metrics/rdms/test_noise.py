"""Noise precision against rsatoolbox, and what has none."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import noise_precision, rdm
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
