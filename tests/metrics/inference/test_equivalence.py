"""Equivalence of a model with the animals' own consistency."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.metrics import rdm
from brainbench.metrics.inference.equivalence import equivalence_test, turing_test
from brainbench.metrics.measures.rsa import RSA, score_rdms
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import make_block, make_latent

SAME = np.full(12, 0.0)
"""Left-out stimuli that change nothing."""


def test_the_two_one_sided_tests_equal_scipy_where_stimuli_change_nothing():
    difference = np.random.default_rng(0).normal(-0.03, 0.07, 11)
    found = equivalence_test(difference, SAME, margin=0.1)
    lower = stats.ttest_1samp(difference, -0.1, alternative="greater").pvalue
    upper = stats.ttest_1samp(difference, 0.1, alternative="less").pvalue
    assert found.p == pytest.approx(max(lower, upper))
    low, high = stats.t.interval(0.9, 10, loc=np.mean(difference), scale=stats.sem(difference))
    assert (found.interval.low, found.interval.high) == pytest.approx((low, high))
    wider = equivalence_test(difference, SAME + 0.01 * np.arange(12), margin=0.1)
    assert wider.interval.low < found.interval.low


@pytest.mark.parametrize(
    ("shift", "verdict"), [(0.0, "equivalent"), (-0.4, "worse"), (0.4, "better"), (0.1, "undecided")]
)
def test_the_verdict_follows_the_interval(shift, verdict):
    spread = 0.04 * np.array([-1.0, 1, -0.5, 0.5, 0, 0.7, -0.7])
    found = equivalence_test(shift + spread, SAME, margin=0.1)
    assert found.verdict == verdict
    assert (found.p < 0.05) == (verdict == "equivalent")
    assert found.status == "ok"


def test_few_animals_or_stimuli_are_unreliable_and_one_is_undefined():
    few = equivalence_test([0.0, -0.01, 0.01], SAME)
    assert few.status == "unreliable"
    assert "3 animals and 12 stimuli; at least 4 and 10 are needed" in few.summary()
    assert equivalence_test([0.0, -0.01, 0.01, 0.0], SAME[:6]).status == "unreliable"
    one = equivalence_test([0.0, np.nan], SAME)
    assert (one.status, one.verdict) == ("undefined", "undecided")
    assert "fewer than two animals" in one.summary()


def test_a_model_of_the_shared_geometry_passes_and_an_unrelated_one_does_not():
    latent, stimuli = make_latent(1, stimuli=16), [f"s{k}" for k in range(16)]
    animals = [
        subject_rdm(f"m{i}", [make_block(latent, seed=i, units=80, repeats=30, noise=2)], 16, splits=100)
        for i in range(8)
    ]
    between = RSA(comparison="pearson").score_animals(animals, stimuli=stimuli)
    rng = np.random.default_rng(0)
    true = score_rdms({"a": rdm(latent @ rng.normal(size=(4, 300)))}, animals, name="true", stimuli=stimuli)
    luck = score_rdms({"a": rdm(make_latent(99, stimuli=16))}, animals, name="luck", stimuli=stimuli)
    assert turing_test(true, between, margin=0.15).verdict == "equivalent"
    assert turing_test(luck, between, margin=0.15).verdict == "worse"
    # A verdict is no better than the scores behind it.
    doubtful = turing_test(dataclasses.replace(true, status="unreliable"), between, margin=0.15)
    assert (doubtful.verdict, doubtful.status) == ("equivalent", "unreliable")
    assert "true" in doubtful.reason
    with pytest.raises(UsageError, match="'default' and 'thesis'"):
        turing_test(true, dataclasses.replace(between, estimator="thesis"))


@pytest.mark.slow
def test_a_model_at_the_margin_passes_no_more_often_than_the_level():
    rng = np.random.default_rng(1)
    passed = np.mean(
        [
            equivalence_test(0.1 + 0.05 * rng.normal(size=11), SAME, margin=0.1).verdict == "equivalent"
            for _ in range(4000)
        ]
    )
    assert passed == pytest.approx(0.05, abs=0.01)


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="received 0"):
        equivalence_test([0, 0], SAME, margin=0)
