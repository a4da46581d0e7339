"""Corrections over layers, models and pairs of models."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.metrics import compare, compare_models, permutation_test
from brainbench.metrics.inference.multiple import adjust, layer_tests, sign_flip_p, step_down
from brainbench.metrics.inference.permutation import permuted_values
from brainbench.metrics.score import score_rdms
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


def test_sign_flips_equal_scipy_and_have_a_smallest_p():
    rng = np.random.default_rng(0)
    d = rng.normal(0.3, size=9)
    found = stats.permutation_test(
        (d,),
        lambda x, axis: np.abs(x.mean(axis=axis)),
        permutation_type="samples",
        alternative="greater",
        n_resamples=np.inf,
    )
    assert sign_flip_p(d) == pytest.approx(found.pvalue)
    assert sign_flip_p(np.arange(1.0, 12)) == pytest.approx(2 / 2**11)
    assert sign_flip_p(d[::-1]) == sign_flip_p(d)
    many = rng.normal(0.2, size=30)
    assert sign_flip_p(many) == pytest.approx(stats.ttest_1samp(many, 0).pvalue, abs=0.03)


def test_the_step_down_maximum_equals_counting_by_hand():
    null = np.array([[3.0, 1, 2, 0, 4], [2.0, 1, 5, 0, 1], [0.5, 1, 0, 2, 0]])
    # Largest observed (3) against the maximum of all, next (2) against the two lower rows, last against itself.
    assert step_down(null).tolist() == [3 / 5, 3 / 5, 3 / 5]
    lone = np.array([[9.0, 1, 2, 0, 4], [2.0, 1, 1, 0, 1], [0.5, 1, 0, 2, 0]])
    assert step_down(lone).tolist() == [1 / 5, 2 / 5, 3 / 5]


def test_two_models_meet_the_same_permutations():
    rng = np.random.default_rng(1)
    brain = np.stack([make_rdm(rng, 9) for _ in range(3)])
    one, two = make_rdm(rng, 9), np.stack([make_rdm(rng, 9) for _ in range(40)])
    first = permuted_values(one[None], brain, lambda r: r[:, 0].mean(axis=-1))
    second = permuted_values(np.concatenate([one[None], two]), brain, lambda r: r[:, 0].mean(axis=-1))
    np.testing.assert_allclose(first, second, atol=1e-12)


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


def test_pairs_compare_models_on_the_same_animals():
    rng = np.random.default_rng(3)
    shared = make_rdm(rng)
    animals = _make_animals(rng, shared, 8)
    models = {"true": {"a": shared}, "near": {"a": shared + 0.05 * rng.normal(size=15)}, "luck": {"a": make_rdm(rng)}}
    found = compare_models(models, animals, stimuli=STIMULI, correction="holm")
    assert [(pair.first, pair.second) for pair in found.pairs] == [("true", "near"), ("true", "luck"), ("near", "luck")]
    values = {m.score.name: np.array([subject.value for subject in m.score.subjects]) for m in found.models}
    for pair in found.pairs:
        d = values[pair.first] - values[pair.second]
        assert pair.difference == pytest.approx(d.mean())
        assert pair.p == sign_flip_p(d)
        assert pair.interval.low < pair.difference < pair.interval.high
    np.testing.assert_allclose([pair.p_corrected for pair in found.pairs], adjust([p.p for p in found.pairs], "holm"))
    assert found.pairs[1].p == pytest.approx(2 / 2**8)


def test_one_animal_has_no_paired_test_and_says_why():
    rng = np.random.default_rng(4)
    shared = make_rdm(rng)
    found = compare_models(
        {"a": {"x": shared}, "b": {"x": make_rdm(rng)}}, _make_animals(rng, shared, 1), stimuli=STIMULI
    )
    assert np.isnan(found.pairs[0].p)
    assert found.pairs[0].reason == "fewer than two animals have a value for both models"


def test_layers_are_corrected_by_their_largest():
    rng = np.random.default_rng(5)
    shared = make_rdm(rng)
    animals = _make_animals(rng, shared)
    layers = {"luck": make_rdm(rng), "flat": np.full(15, 0.5), "true": shared}
    luck, flat, true = layer_tests(layers, animals)
    brain = np.stack([animal.rdm for animal in animals])
    assert luck.p == pytest.approx(permutation_test(layers["luck"], brain).p, abs=0.02)
    assert luck.p_corrected >= luck.p
    assert true.p == true.p_corrected == pytest.approx(1 / 720)
    assert np.isnan([flat.value, flat.p, flat.p_corrected]).all()
    factor = np.sqrt((1 + 0.45 / 0.55) / 2 / (0.45 / 0.55))
    assert luck.value == pytest.approx(compare(layers["luck"], brain).mean() * factor, rel=1e-6)
    without = [dataclasses.replace(animal, problem="no trials of 'a'") for animal in animals]
    assert np.isnan(layer_tests(layers, without)[0].p)


@pytest.mark.slow
def test_false_alarms_over_twenty_models_and_over_twelve_layers_keep_their_level():
    rng = np.random.default_rng(6)
    models, layers = [], []
    for _ in range(2000):
        animals = _make_animals(rng, make_rdm(rng), 3, noise=0.1)
        given = np.stack([make_rdm(rng) for _ in range(20)])
        found = layer_tests({str(i): rdm for i, rdm in enumerate(given)}, animals)
        layers.append(min(test.p_corrected for test in found) <= 0.05)
        brain = np.stack([animal.rdm for animal in animals])
        null = permuted_values(given, brain, lambda r: r.mean(axis=-1))
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
    with pytest.raises(UsageError, match="no layers"):
        layer_tests({}, animals)
