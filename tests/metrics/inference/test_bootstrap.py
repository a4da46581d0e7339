"""The hierarchical bootstrap: its draws, its independence of order, and the ceilings of rsatoolbox."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import compare, noise_ceiling
from brainbench.metrics.inference.bootstrap import (
    animal_counts,
    bootstrap_ceiling,
    bootstrap_comparisons,
    bootstrap_score,
    ceilings,
)
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.metrics.score import score_rdms
from tests.factories.animals import STIMULI, make_block, make_latent, make_rdm, make_subject


def _make_animals(count=6, draws=200, noise=1.5):
    latent = make_latent(1)
    blocks = [[make_block(latent, seed=i, noise=noise)] for i in range(count)]
    return [subject_rdm(f"m{i}", block, 6, splits=50, draws=draws) for i, block in enumerate(blocks)]


def test_drawing_trials_doubles_their_noise_and_the_reliability_of_the_draws_says_so():
    latent = make_latent(2)
    animals = [
        subject_rdm(str(i), [make_block(latent, seed=i, repeats=30, noise=3.5)], 6, splits=100, draws=100)
        for i in range(8)
    ]
    reliability = np.mean([animal.reliability for animal in animals])
    drawn = np.mean([2 * r / (1 + r) for animal in animals for r in [np.nanmean(animal.draws_r)]])
    # Noise variance doubles: ratio of signal to noise ρ/(1−ρ) halves.
    ratio = reliability / (1 - reliability) / 2
    assert drawn == pytest.approx(ratio / (1 + ratio), abs=0.05)


def test_the_bootstrap_of_animals_repeats_the_estimator_without_copies_of_the_animal():
    animals = _make_animals()
    rng = np.random.default_rng(3)
    layers = {f"l{i}": make_rdm(rng) for i in range(4)}
    found = bootstrap_score(layers, animals, draws=50, levels="animals", seed=1)
    score = score_rdms(layers, animals, name="x", stimuli=STIMULI)
    assert found.estimate == pytest.approx(score.value, abs=1e-12)
    np.testing.assert_allclose(found.values, [subject.value for subject in score.subjects], atol=1e-12)
    for index in range(6):
        rest = [animal for i, animal in enumerate(animals) if i != index]
        assert found.jackknife[index] == pytest.approx(score_rdms(layers, rest, name="x", stimuli=STIMULI).value)


def test_the_score_carries_its_bootstrap_and_its_monte_carlo_error():
    animals = _make_animals()
    score = score_rdms({"a": make_rdm(np.random.default_rng(0))}, animals, name="x", stimuli=STIMULI)
    found = score.provenance["statistics"]
    assert found["bootstrap"]["draws"] == 200
    assert found["bootstrap"]["levels"] == "animals, sessions and trials"
    assert found["bootstrap"]["interval"]["low"] < score.value < found["bootstrap"]["interval"]["high"]
    assert found["monte_carlo_error"]["p"] == 0
    repeated = [
        score_rdms(
            {"a": make_rdm(np.random.default_rng(0))},
            [
                subject_rdm(f"m{i}", [make_block(make_latent(1), seed=i, noise=1.5)], 6, splits=50, seed=s)
                for i in range(6)
            ],
            name="x",
            stimuli=STIMULI,
        ).value
        for s in range(30)
    ]
    assert found["monte_carlo_error"]["value"] == pytest.approx(np.std(repeated), rel=0.5)


def test_one_animal_is_bootstrapped_over_its_trials():
    (animal,) = _make_animals(1)
    found = bootstrap_score([animal.rdm], [animal], draws=100)
    assert found.levels == "sessions and trials"
    assert found.standard_error > 0
    assert found.interval("percentile").method.endswith("unreliable: coverage not verified below 5 animals")
    assert found.interval("t") is None


def test_bca_equals_scipy():
    from scipy import stats

    rng = np.random.default_rng(0)
    values = rng.gamma(2.0, size=12)
    from brainbench.metrics.inference.intervals import bca_interval

    draws = rng.choice(values, (20_000, 12)).mean(axis=1)
    jackknife = (values.sum() - values) / 11
    found = bca_interval(draws, values.mean(), jackknife, 0.9)
    expected = stats.bootstrap((values,), np.mean, confidence_level=0.9, n_resamples=20_000, rng=1).confidence_interval
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.02)


@pytest.mark.parametrize("method", ["pearson", "spearman", "rho-a", "cosine", "tau-a"])
def test_ceilings_of_draws_are_those_of_noise_ceiling(method):
    rng = np.random.default_rng(1)
    rdms = np.stack([make_rdm(rng) for _ in range(5)])
    assert ceilings(rdms, np.ones((1, 5)), method)[0] == pytest.approx(tuple(noise_ceiling(rdms, method=method)))


@pytest.mark.parametrize(
    ("ours", "theirs"), [("pearson", "corr"), ("rho-a", "rho-a"), ("cosine", "cosine"), ("spearman", "spearman")]
)
def test_ceilings_of_draws_equal_rsatoolbox(ours, theirs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rsatoolbox.inference.noise_ceiling import boot_noise_ceiling
        from rsatoolbox.rdm import RDMs
    rng = np.random.default_rng(2)
    rdms = np.stack([make_rdm(rng) for _ in range(5)])
    for counts in ([1, 1, 1, 1, 1], [2, 1, 1, 1, 0], [3, 0, 0, 2, 0]):
        rows = np.repeat(np.arange(5), counts)
        drawn = RDMs(rdms[rows], rdm_descriptors={"animal": rows})
        expected = boot_noise_ceiling(drawn, method=theirs, rdm_descriptor="animal")
        np.testing.assert_allclose(ceilings(rdms, np.array([counts], dtype=float), ours)[0], expected, atol=1e-10)


def test_models_meet_the_same_draws_of_animals():
    rng = np.random.default_rng(4)
    models, brain = np.stack([make_rdm(rng) for _ in range(3)]), np.stack([make_rdm(rng) for _ in range(5)])
    found = bootstrap_comparisons(models, brain, draws=2000, seed=3)
    counts = animal_counts(np.random.default_rng(3), 5, 2000)
    drawn = np.repeat(np.arange(5), counts[7].astype(int))
    np.testing.assert_allclose(found[7], compare(models[:, None], brain[drawn]).mean(axis=1), atol=1e-12)
    np.testing.assert_allclose(found.mean(axis=0), compare(models[:, None], brain).mean(axis=1), atol=0.03)


def test_a_draw_of_one_animal_has_no_lower_ceiling():
    rdms = np.stack([make_rdm(np.random.default_rng(i)) for i in range(3)])
    found = ceilings(rdms, np.array([[3.0, 0, 0]]), "pearson")[0]
    assert np.isnan(found[0])
    assert found[1] == pytest.approx(1)


def test_misuse_is_told_in_a_sentence():
    animals = [make_subject(f"m{i}", make_rdm(np.random.default_rng(i))) for i in range(3)]
    with pytest.raises(UsageError, match="need 1000 draws"):
        bootstrap_score([make_rdm(np.random.default_rng(0))], animals)
    with pytest.raises(UsageError, match="allowed: 'animals', 'all'"):
        bootstrap_score([animals[0].rdm], animals, levels="trials")
    with pytest.raises(UsageError, match="at least 1 draw"):
        bootstrap_score([animals[0].rdm], animals, levels="animals", draws=0)
    with pytest.raises(UsageError, match="No animal can be scored"):
        bootstrap_score([animals[0].rdm], [make_subject("a", np.full(15, np.nan))])
    with pytest.raises(UsageError, match="at least 2 animals"):
        bootstrap_ceiling(animals[0].rdm[None])
    with pytest.raises(UsageError, match="did you mean 'percentile'"):
        bootstrap_score([animals[0].rdm], animals, levels="animals", draws=10).interval("percentil")
    with pytest.raises(UsageError, match="between 0 and 1"):
        bootstrap_score([animals[0].rdm], animals, levels="animals", draws=10).interval(level=95)
