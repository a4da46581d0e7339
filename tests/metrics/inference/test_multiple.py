"""Corrections over layers, models and pairs of models."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.core.statistics import compare_scores
from brainbench.metrics import compare, compare_models, permutation_test
from brainbench.metrics.inference.multiple import adjust, step_down
from brainbench.metrics.inference.permutation import layer_p
from brainbench.metrics.measures.rsa import score_rdms
from tests.factories.animals import STIMULI, make_rdm, make_subject


def _make_animals(rng, shared, count=6, noise=0.05):
    return [make_subject(f"m{i}", shared + noise * rng.normal(size=15), seed=i) for i in range(count)]


def test_holm_and_benjamini_hochberg_equal_the_published_examples():
    # scipy for the false discovery rate; Holm's 1979 rule by hand.
    p = [0.01, 0.02, 0.03, 0.005, 0.5]
    np.testing.assert_allclose(adjust(p, "fdr"), stats.false_discovery_control(p))
    np.testing.assert_allclose(adjust(p, "holm"), [0.04, 0.06, 0.06, 0.025, 0.5])
    np.testing.assert_allclose(adjust(p, "none"), p)
    np.testing.assert_array_equal(adjust([0.01, np.nan, 0.04], "holm"), [0.02, np.nan, 0.04])


def test_the_step_down_maximum_equals_counting_by_hand():
    null = np.array([[3.0, 1, 2, 0, 4], [2.0, 1, 5, 0, 1], [0.5, 1, 0, 2, 0]])
    # Largest observed (3) against the maximum of all, next (2) against the two lower rows, last against itself.
    assert step_down(null).tolist() == [3 / 5, 3 / 5, 3 / 5]
    lone = np.array([[9.0, 1, 2, 0, 4], [2.0, 1, 1, 0, 1], [0.5, 1, 0, 2, 0]])
    assert step_down(lone).tolist() == [1 / 5, 2 / 5, 3 / 5]


def test_two_models_meet_the_same_permutations():
    rng = np.random.default_rng(1)
    brain = np.stack([make_rdm(rng, 9) for _ in range(3)])
    model = make_rdm(rng, 9)
    np.testing.assert_allclose(permutation_test(-model, brain).null, -permutation_test(model, brain).null, atol=1e-12)


def test_a_true_model_stands_out_among_sixty_and_luck_does_not():
    rng = np.random.default_rng(2)
    shared = make_rdm(rng)
    animals = _make_animals(rng, shared)
    models = {f"luck{i}": {"a": make_rdm(rng)} for i in range(60)} | {"true": {"a": shared, "b": make_rdm(rng)}}
    found = compare_models(models, animals, stimuli=STIMULI)
    by_name = {test.score.name: test for test in found.models}
    assert by_name["true"].p_corrected <= 0.01
    lucky = min((test for name, test in by_name.items() if name != "true"), key=lambda test: test.score.p)
    assert lucky.score.p < 0.05 < lucky.p_corrected
    assert all(test.p_corrected >= test.score.p for test in found.models)
    assert by_name["true"].score == score_rdms(models["true"], animals, name="true", stimuli=STIMULI)


def test_pairs_are_compared_on_the_same_animals_and_stimuli():
    rng = np.random.default_rng(3)
    shared, stimuli = make_rdm(rng, 12), [f"s{k}" for k in range(12)]
    animals = [make_subject(f"m{i}", shared + 0.05 * rng.normal(size=66), seed=i) for i in range(8)]
    models = {
        "true": {"a": shared},
        "near": {"a": shared + 0.05 * rng.normal(size=66)},
        "luck": {"a": make_rdm(rng, 12)},
    }
    found = compare_models(models, animals, stimuli=stimuli, correction="holm")
    assert [(pair.first, pair.second) for pair in found.pairs] == [("true", "near"), ("true", "luck"), ("near", "luck")]
    scores = {m.score.name: m.score for m in found.models}
    for pair in found.pairs:
        one, two = scores[pair.first], scores[pair.second]
        each = [a.value - b.value for a, b in zip(one.subjects, two.subjects, strict=True)]
        without = np.subtract(one.without_stimulus, two.without_stimulus)
        over_animals = np.var(each, ddof=1) / 8
        over_stimuli = 11 / 12 * ((without - without.mean()) ** 2).sum()
        # The scale of both differs by their chance alone, which is near zero for correlations.
        assert pair.difference == pytest.approx(np.mean(each), abs=0.02)
        error = np.sqrt(over_animals + over_stimuli)
        freedom = error**4 / (over_animals**2 / 7 + over_stimuli**2 / 11)
        assert pair.p == pytest.approx(2 * stats.t.sf(abs(np.mean(each)) / error, freedom), rel=0.3, abs=1e-6)
        assert pair.interval.low < pair.difference < pair.interval.high
    np.testing.assert_allclose([pair.p_corrected for pair in found.pairs], adjust([p.p for p in found.pairs], "holm"))
    assert found.pairs[1].p < 0.01


def test_too_few_animals_or_stimuli_have_no_paired_test_and_say_what_is_needed():
    rng = np.random.default_rng(4)
    shared = make_rdm(rng)
    models = {"a": {"x": shared}, "b": {"x": make_rdm(rng)}}
    alone = compare_models(models, _make_animals(rng, shared, 1), stimuli=STIMULI).pairs[0]
    assert np.isnan(alone.p)
    assert alone.reason == "fewer than two animals have a value for both models"
    few = compare_models(models, _make_animals(rng, shared, 6), stimuli=STIMULI).pairs[0]
    assert np.isnan(few.p)
    assert few.reason == "6 animals and 6 stimuli; at least 4 and 10 are needed"
    assert few.interval.low < few.difference < few.interval.high


def test_scores_of_two_metrics_are_compared_on_their_common_scale():
    rng = np.random.default_rng(8)
    shared, stimuli = make_rdm(rng, 12), [f"s{k}" for k in range(12)]
    animals = [make_subject(f"m{i}", shared + 0.05 * rng.normal(size=66), seed=i) for i in range(6)]
    score = score_rdms({"a": shared}, animals, name="x", stimuli=stimuli)
    # The same score in a metric whose chance is .5 and whose best is 3.
    moved = dataclasses.replace(
        score,
        chance=0.5,
        attainable=3.0,
        subjects=tuple(dataclasses.replace(s, value=0.5 + 2.5 * score.on_scale(s.value)) for s in score.subjects),
        without_stimulus=tuple(0.5 + 2.5 * score.on_scale(value) for value in score.without_stimulus),
    )
    assert compare_scores(score, moved).difference == pytest.approx(0, abs=1e-12)


def test_layers_are_corrected_by_their_largest():
    rng = np.random.default_rng(5)
    shared = make_rdm(rng)
    animals = _make_animals(rng, shared)
    layers = {"luck": make_rdm(rng), "flat": np.full(15, 0.5), "true": shared}
    score = score_rdms(layers, animals, name="x", stimuli=STIMULI)
    luck, true = score.provenance.statistics["layer_tests"]
    brain = np.stack([animal.rdm for animal in animals])
    assert (luck["layer"], true["layer"]) == ("luck", "true")
    assert luck["p"] == pytest.approx(permutation_test(layers["luck"], brain).p, abs=0.02)
    assert luck["p_corrected"] >= luck["p"]
    assert true["p"] == true["p_corrected"] == pytest.approx(1 / 720)
    factor = np.sqrt((1 + 0.45 / 0.55) / 2 / (0.45 / 0.55))
    assert score.layers[0].value == pytest.approx(compare(layers["luck"], brain).mean() * factor, rel=1e-6)


@pytest.mark.slow
def test_false_alarms_over_twenty_models_and_over_twelve_layers_keep_their_level():
    rng = np.random.default_rng(6)
    models, layers = [], []
    for _ in range(2000):
        animals = _make_animals(rng, make_rdm(rng), 3, noise=0.1)
        given = np.stack([make_rdm(rng) for _ in range(20)])
        brain = np.stack([animal.rdm for animal in animals])
        null = np.stack([permutation_test(each, brain).null for each in given], axis=1)
        layers.append(layer_p(null)[1].min() <= 0.05)
        models.append(step_down(null.T).min() <= 0.05)
    # Two standard errors of 2,000 simulations are .01.
    assert np.mean(models) <= 0.06
    assert np.mean(layers) <= 0.06


def test_misuse_is_told_in_a_sentence():
    rng = np.random.default_rng(7)
    animals = _make_animals(rng, make_rdm(rng), 2)
    with pytest.raises(UsageError, match="did you mean 'holm'"):
        compare_models({"a": {"x": make_rdm(rng)}}, animals, stimuli=STIMULI, correction="hollm")
    with pytest.raises(UsageError, match="no models"):
        compare_models({}, animals, stimuli=STIMULI)
