"""Animal-to-animal scores."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.metrics import compare
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.pairs import permuted_pairs
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent, make_rdm, make_subject


def score_animals(animals, stimuli=STIMULI):
    return RSA(comparison="pearson").score_animals(animals, stimuli=stimuli)


def _make_animals(count, seed=0, noise=3.0, latent=None, splits=100):
    return [
        subject_rdm(
            f"m{i}",
            [make_block(make_latent(seed) if latent is None else latent[i], seed=seed + i, units=40, noise=noise)],
            6,
            splits=splits,
        )
        for i in range(count)
    ]


def test_each_animal_meets_the_mean_of_the_others_and_both_are_corrected():
    animals = _make_animals(3)
    score = score_animals(animals, stimuli=STIMULI)
    others = np.mean([animals[1].rdm, animals[2].rdm], axis=0)
    halves = np.mean([animals[1].halves, animals[2].halves], axis=0)
    both = spearman_brown(animals[0].split_half_r.mean()) * spearman_brown(compare(halves[:, 0], halves[:, 1]).mean())
    assert score.subjects[0].value == pytest.approx(float(compare(animals[0].rdm, others)) / math.sqrt(both))
    assert score.value == pytest.approx(np.mean([subject.value for subject in score.subjects]))
    assert score.stimuli == STIMULI
    assert score.status == "ok"


def test_animals_that_share_a_geometry_agree_fully_after_correction():
    # Tuning is drawn anew per animal, so many units are needed before the geometry itself is shared.
    animals = [
        subject_rdm(f"m{i}", [make_block(make_latent(1), seed=i, units=600, noise=5.0)], 6, splits=100)
        for i in range(8)
    ]
    score = score_animals(animals)
    assert score.r < 0.96
    assert score.value == pytest.approx(1.0, abs=0.03)
    assert score.p == pytest.approx(1 / 500)


def test_animals_that_share_nothing_do_not_agree():
    p = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        animals = [make_subject(f"m{i}", make_rdm(rng), reliability=0.9, seed=i) for i in range(4)]
        p.append(score_animals(animals).p)
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_the_order_of_animals_and_stimuli_is_irrelevant():
    latent = make_latent(2)
    rng = np.random.default_rng(3)
    order = rng.permutation(6)
    blocks = [make_block(latent, seed=i, noise=4.0) for i in range(4)]
    moved = [type(b)(b.responses, np.argsort(order)[b.labels], b.keys) for b in blocks]
    first = score_animals([subject_rdm(f"m{i}", [blocks[i]], 6, splits=30) for i in range(4)])
    second = score_animals([subject_rdm(f"m{i}", [moved[i]], 6, splits=30) for i in (2, 0, 3, 1)])
    assert second.value == pytest.approx(first.value, abs=1e-12)
    assert second.p == first.p
    pairs = permuted_pairs(order[None])[0]
    np.testing.assert_allclose(second.brain_rdm, np.array(first.brain_rdm)[pairs], atol=1e-12)


def test_one_animal_is_undefined_in_words():
    score = score_animals(_make_animals(1))
    assert score.status == "undefined"
    assert score.reasons[0] == "fewer than two animals can be used"
    assert math.isnan(score.value)


def test_two_animals_make_one_comparison_and_have_no_interval():
    score = score_animals(_make_animals(2))
    assert score.subjects[0].value == pytest.approx(score.subjects[1].value, abs=1e-12)
    assert score.interval is None
    assert "two animals make one comparison: no confidence interval" in score.reasons


def test_unreliable_animals_are_left_out_and_named():
    animals = _make_animals(3)
    noisy = make_subject("z", make_rdm(np.random.default_rng(0)), reliability=0.2)
    score, without = score_animals([*animals, noisy]), score_animals(animals)
    assert score.value == pytest.approx(without.value, abs=1e-15)
    assert any(reason.startswith("animal z left out: reliability 0.20") for reason in score.reasons)


def test_unreliable_animals_alone_are_scored_as_unreliable():
    rng = np.random.default_rng(4)
    shared = make_rdm(rng)
    animals = [make_subject(f"m{i}", shared + 0.05 * rng.normal(size=15), reliability=0.4, seed=i) for i in range(3)]
    score = score_animals(animals)
    assert score.status == "unreliable"
    assert math.isfinite(score.value)


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="at least two SubjectRDM"):
        score_animals([])
    with pytest.raises(UsageError, match="6 stimuli; 2 are scored"):
        score_animals(_make_animals(2), stimuli=["a", "b"])
