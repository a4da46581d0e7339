"""RDMs of an animal by every method: parity with rsatoolbox, and rules for what is missing."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import noise_precision, rdm
from brainbench.metrics.reliability.halves import SplitRDMs, half_rdms, split_members
from brainbench.metrics.reliability.sessions import SortedTrials, key_hashes
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import make_block, make_latent


def _unbalanced(seed=0, units=12):
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(6), [5, 9, 12, 6, 4, 10])
    responses = rng.normal(size=(6, units))[labels] + rng.normal(size=(len(labels), units))
    return Trials(responses, labels, [f"{seed}/{i}" for i in range(len(labels))])


@pytest.mark.parametrize("noise", ["shrinkage_diag", "shrinkage_eye", "diag", "full"])
def test_mahalanobis_of_one_session_is_that_of_rdm(noise):
    block = _unbalanced()
    precision = noise_precision(block.responses, block.labels, method=noise)
    found = subject_rdm("a", [block], 6, method="mahalanobis", noise=noise, splits=5)
    expected = rdm(block.responses, block.labels, method="mahalanobis", precision=precision)
    np.testing.assert_allclose(found.rdm, expected, rtol=1e-10)


def test_crossnobis_with_unequal_trials_equals_rsatoolbox():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rsatoolbox.data import Dataset
        from rsatoolbox.rdm import calc_rdm_unbalanced
    block = _unbalanced()
    data = Dataset(block.responses, obs_descriptors={"stimulus": block.labels, "trial": np.arange(len(block.labels))})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = calc_rdm_unbalanced(
            data, method="crossnobis", descriptor="stimulus", cv_descriptor="trial"
        ).dissimilarities[0]
    found = subject_rdm("a", [block], 6, method="crossnobis", noise="none", splits=5)
    np.testing.assert_allclose(found.rdm, expected, atol=1e-10)


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "crossnobis"])
def test_halves_by_products_and_by_patterns_are_the_same(method, monkeypatch):
    block = make_block(make_latent(), units=60, repeats=8)
    session = SortedTrials.sort(block.responses, block.labels, key_hashes(block.keys))
    index = np.arange(7)
    first, second = half_rdms([session], 6, method, index, seed=3)
    member = split_members(session, 6, index, 3)
    monkeypatch.setattr("brainbench.metrics.reliability.halves.BY_PRODUCTS", ())
    for half, by_patterns in zip((first, second), SplitRDMs([session], 6, method).halves([member]), strict=True):
        np.testing.assert_allclose(half, by_patterns, atol=1e-11)


@pytest.mark.parametrize("noise", ["none", "diag", "shrinkage_diag", "full"])
def test_crossnobis_is_zero_on_average_where_stimuli_are_alike(noise):
    rng = np.random.default_rng(1)
    labels = np.repeat(np.arange(6), [4, 5, 6, 7, 8, 9])
    found = []
    for _ in range(40):
        block = Trials(rng.normal(size=(len(labels), 8)) * np.linspace(0.5, 2, 8), labels)
        found.append(subject_rdm("a", [block], 6, method="crossnobis", noise=noise, splits=1).rdm.mean())
    assert abs(np.mean(found)) < 4 * np.std(found) / np.sqrt(40)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["none", "diag", "full"])
def test_crossnobis_is_zero_on_average_in_two_thousand_simulations(noise):
    rng = np.random.default_rng(2)
    labels = np.repeat(np.arange(6), [4, 5, 6, 8, 10, 12])
    found, biased = [], []
    for _ in range(2000):
        block = Trials(rng.normal(size=(len(labels), 8)) * np.linspace(0.5, 2, 8), labels)
        found.append(subject_rdm("a", [block], 6, method="crossnobis", noise=noise, splits=1).rdm.mean())
        biased.append(subject_rdm("a", [block], 6, method="sqeuclidean", splits=1).rdm.mean())
    assert abs(np.mean(found)) < 3 * np.std(found) / np.sqrt(2000)
    assert np.mean(biased) > 0.2


@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "poisson"])
def test_a_noiseless_rdm_does_not_depend_on_the_number_of_trials(method):
    patterns = np.random.default_rng(2).random(size=(6, 15))
    few, many = (np.repeat(np.arange(6), counts) for counts in ([4] * 6, [4, 9, 5, 12, 8, 6]))
    found = [subject_rdm("a", [Trials(patterns[x], x)], 6, method=method, splits=2).rdm for x in (few, many)]
    np.testing.assert_allclose(*found, atol=1e-12)


def test_units_that_were_not_recorded_in_every_trial_leave_the_full_covariance_but_not_the_diagonal():
    block = _unbalanced(units=8)
    responses = block.responses.copy()
    responses[0, 2] = np.nan
    responses[:, 5] = 3.0
    gap = Trials(responses, block.labels, block.keys)
    diagonal = subject_rdm("a", [gap], 6, method="mahalanobis", noise="diag", splits=5)
    full = subject_rdm("a", [gap], 6, method="mahalanobis", noise="full", splits=5)
    assert diagonal.units == 7
    assert full.units == 6
    assert "1 units or bins left out: without noise or not in every trial" in diagonal.notes
    assert "2 units or bins left out: without noise or not in every trial" in full.notes
    crossed = subject_rdm("a", [gap], 6, method="crossnobis", noise="diag", splits=5)
    assert np.isfinite(crossed.rdm).all()


def test_too_few_trials_for_a_covariance_are_a_problem_in_words():
    rng = np.random.default_rng(3)
    labels = np.repeat(np.arange(6), 4)
    wide = Trials(rng.normal(size=(24, 60)), labels)
    found = subject_rdm("a", [wide], 6, method="mahalanobis", noise="full")
    assert found.problem.startswith("no session has a noise covariance: The noise covariance of 60 units")
    still = Trials(np.repeat(rng.normal(size=(6, 5)), 4, axis=0), labels)
    assert "no unit has noise" in subject_rdm("a", [still], 6, method="crossnobis").problem


def test_crossnobis_needs_four_trials_of_each_stimulus():
    block = make_block(make_latent(), repeats=3)
    found = subject_rdm("a", [block], 6, method="crossnobis")
    assert "fewer than 4 trials of 0 (3)" in found.problem


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"splits": 0}, "splits .*0"), ({"splits": 2.5}, r"splits .*2\.5"), ({"seed": -1}, "seed .*-1"),
        ({"seed": 1.5}, r"seed .*1\.5"), ({"noise": "dag"}, "did you mean 'diag'"),
    ],
)  # fmt: skip
def test_options_of_an_animals_rdm_are_checked_whatever_its_method(options, told) -> None:
    trials = Trials(np.arange(24.0).reshape(12, 2) % 5, np.repeat(range(3), 4))
    with pytest.raises(UsageError, match=told):
        subject_rdm("m", [trials], 3, **options)
