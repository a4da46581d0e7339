"""The score of a model: what is in it, what makes it unreliable or undefined, and its independence of order."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.core.records import Interval, Score
from brainbench.core.statistics import t_interval, two_factor_error, two_factor_interval
from brainbench.metrics import compare, noise_ceiling, noise_corrected, rdm
from brainbench.metrics.measures.metric import get_metric
from brainbench.metrics.measures.rsa import RSA, score_rdms
from brainbench.metrics.rdms.comparison import compare_all, permuted_pairs
from brainbench.metrics.reliability.noise_correction import spearman_brown
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.metrics.score import held_to_scale, interval_reasons
from tests.factories.animals import (
    STIMULI,
    make_animals,
    make_block,
    make_latent,
    make_layers,
    make_rdm,
    make_subject,
    score_of,
)


def test_the_score_is_the_mean_over_animals_of_the_held_out_corrected_comparison():
    latent = make_latent(1)
    layers, animals = make_layers(latent), make_animals(latent)
    score = score_of(layers, animals)
    r = compare(np.stack(list(layers.values()))[:, None], np.stack([animal.rdm for animal in animals]))
    values = []
    for index, animal in enumerate(animals):
        chosen = int(np.argmax(np.delete(r, index, axis=1).mean(axis=1)))
        values.append(noise_corrected(r[chosen, index], animal.split_half_r).value)
        assert score.subjects[index].layer == f"conv{chosen}"
        assert score.subjects[index].value == pytest.approx(values[-1])
        assert (score.subjects[index].units, score.subjects[index].trials) == (20, 48)
    assert score.status == "ok"
    assert score.value == pytest.approx(np.mean(values))
    assert score.reliability == pytest.approx(np.mean([animal.reliability for animal in animals]))
    without = []
    for k in range(6):
        kept = permuted_pairs(np.delete(np.arange(6), k)[None], 6)[0]
        left = [
            float(compare(layers[subject.layer][kept], animal.rdm[kept])) * value / subject.r
            for subject, animal, value in zip(score.subjects, animals, values, strict=True)
        ]
        without.append(np.mean(left))
    assert score.without_stimulus == pytest.approx(without)
    over_animals, over_stimuli = np.var(values, ddof=1) / 6, 5 * np.var(without)
    freedom = (over_animals + over_stimuli) ** 2 / (over_animals**2 / 5 + over_stimuli**2 / 5)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(over_animals + over_stimuli)
    assert (score.interval.low, score.interval.high) == pytest.approx((score.value - half, score.value + half))
    assert score.interval.method == "t over 6 animals and 6 stimuli (jackknife)"
    lower, upper = noise_ceiling(np.stack([animal.rdm for animal in animals]))
    assert (score.ceiling.lower, score.ceiling.upper) == pytest.approx((lower, upper))
    assert score.layer_rule == "chosen on the other animals, evaluated on the animal held out"
    assert score.p == score.p_smallest == pytest.approx(1 / 720)
    assert score.metric == "RSA: correlation RDM, pearson comparison"
    np.testing.assert_allclose(score.model_rdm, layers[score.layer], rtol=1e-6)
    np.testing.assert_allclose(score.brain_rdm, np.mean([animal.rdm for animal in animals], axis=0), rtol=1e-6)


def test_the_optimistic_maximum_stands_beside_the_score():
    rng = np.random.default_rng(2)
    animals = [make_subject(f"m{i}", make_rdm(rng), seed=i) for i in range(5)]
    score = score_of({f"l{i}": make_rdm(rng) for i in range(30)}, animals)
    assert score.best_layer_value == max(layer.value for layer in score.layers)
    assert score.best_layer_value > score.value + 0.05
    assert [layer.layer for layer in score.layers] == [f"l{i}" for i in range(30)]


def test_the_chance_level_after_choosing_a_layer_stands_in_the_method():
    rng = np.random.default_rng(20)
    shared = make_rdm(rng)
    animals = [make_subject(f"m{i}", shared + 0.05 * rng.normal(size=15), seed=i) for i in range(4)]
    layers = {f"l{i}": make_rdm(rng) for i in range(10)}
    many, one = score_of(layers, animals), score_of({"l0": layers["l0"]}, animals)
    assert one.p_method.endswith("all 720 orders; one layer; mean score under permutation 0.00")
    chance = float(many.p_method.rpartition(" ")[2])
    assert "layer chosen anew in each" in many.p_method
    assert 0.25 < chance < 0.6


def test_one_layer_needs_no_choice():
    latent = make_latent(3)
    animals = make_animals(latent)
    layer = make_layers(latent)["conv3"]
    score = score_of({"only": layer}, animals)
    assert score.layer_rule == "only layer"
    assert score.value == pytest.approx(score.best_layer_value)
    assert score.r == pytest.approx(np.mean([float(compare(layer, animal.rdm)) for animal in animals]))


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["default", "thesis", "thesis-input"]), st.sampled_from([1, 3]))
def test_the_order_of_animals_sessions_trials_units_and_stimuli_is_irrelevant(seed, estimator, animals):
    rng = np.random.default_rng(seed)
    latent = make_latent(seed)
    layers = make_layers(latent, 3)
    blocks = [[make_block(latent, seed=seed % 89 + 10 * i + j, repeats=4) for j in range(2)] for i in range(animals)]
    order = rng.permutation(6)
    pairs = permuted_pairs(order[None])[0]

    def shuffled(block):
        rows, columns = rng.permutation(len(block.labels)), rng.permutation(block.responses.shape[1])
        labels = np.argsort(order)[block.labels][rows]
        return type(block)(block.responses[np.ix_(rows, columns)], labels, [block.keys[row] for row in rows])

    first = [subject_rdm(f"m{i}", blocks[i], 6, splits=20) for i in range(animals)]
    second = [
        subject_rdm(f"m{i}", [shuffled(block) for block in blocks[i][::-1]], 6, splits=20)
        for i in rng.permutation(animals)
    ]
    expected = score_of(layers, first, estimator=estimator)
    found = score_rdms(
        {name: layer[pairs] for name, layer in layers.items()},
        second,
        name="model",
        stimuli=[STIMULI[k] for k in order],
        estimator=estimator,
    )
    for field in ("value", "r", "reliability", "p", "best_layer_value"):
        np.testing.assert_allclose(getattr(found, field), getattr(expected, field), atol=1e-12, err_msg=field)
    np.testing.assert_allclose(found.brain_rdm, np.array(expected.brain_rdm)[pairs], atol=1e-12)
    assert (found.layer, found.status) == (expected.layer, expected.status)
    assert [subject.subject for subject in found.subjects] == [subject.subject for subject in expected.subjects]


def test_many_stimuli_use_random_permutations_that_do_not_depend_on_their_order():
    latent = make_latent(4, stimuli=10)
    names = [f"s{k}" for k in range(10)]
    animals, layers = make_animals(latent, 3, noise=6.0), {"a": make_rdm(np.random.default_rng(0), 10)}
    order = np.random.default_rng(1).permutation(10)
    pairs = permuted_pairs(order[None])[0]
    moved = [dataclasses.replace(animal, rdm=animal.rdm[pairs], halves=animal.halves[..., pairs]) for animal in animals]
    expected = score_rdms(layers, animals, name="x", stimuli=names)
    found = score_rdms({"a": layers["a"][pairs]}, moved, name="x", stimuli=[names[k] for k in order])
    assert found.p == expected.p
    assert "1,999 random orders" in found.p_method


def test_a_broken_layer_is_never_chosen_and_broken_models_are_undefined():
    latent = make_latent(8)
    layers, animals = make_layers(latent), make_animals(latent, 4)
    broken = {"nan": np.full(15, np.nan), **layers, "flat": np.full(15, 0.3)}
    score = score_of(broken, animals)
    assert score.value == pytest.approx(score_of(layers, animals).value, abs=1e-15)
    assert {layer.layer for layer in score.layers if layer.status == "undefined"} == {"nan", "flat"}
    assert any("never chosen: nan, flat" in reason for reason in score.reasons)
    nothing = score_of({"nan": np.full(15, np.nan), "flat": np.full(15, 0.3)}, animals)
    assert nothing.status == "undefined"
    assert nothing.reasons[0] == "activations of every layer are constant or not finite"
    assert nothing.summary().startswith("model: undefined (activations of every layer")
    assert nothing.reliability > 0.5


def test_one_animal_chooses_on_one_half_and_is_scored_on_the_other():
    latent = make_latent(9)
    (animal,) = make_animals(latent, 1)
    layers = make_layers(latent)
    score = score_of(layers, [animal])
    stack = np.stack(list(layers.values()))
    held = []
    for first, second in animal.halves:
        for choose, evaluate in ((first, second), (second, first)):
            best = int(np.argmax(compare(stack, choose)))
            held.append(float(compare(stack[best], evaluate)))
    assert score.value == pytest.approx(np.mean(held) / math.sqrt(animal.split_half_r.mean()))
    assert score.layer_rule.startswith("chosen on one half of the only animal's trials")
    assert score.interval is None
    assert score.ceiling is None
    assert "one animal: no confidence interval, since nothing is known about other animals" in score.reasons
    assert score.p_smallest == pytest.approx(1 / 720)
    assert score.p <= 3 / 720
    assert score.reliability_interval is None


def test_splits_whose_halves_have_no_rdm_do_not_choose():
    latent = make_latent(9)
    (animal,) = make_animals(latent, 1)
    halves = animal.halves.copy()
    halves[::3, 0] = np.nan
    layers = make_layers(latent)
    kept = dataclasses.replace(animal, halves=np.delete(animal.halves, np.s_[::3], axis=0))
    found = score_of(layers, [dataclasses.replace(animal, halves=halves)])
    assert found.value == pytest.approx(score_of(layers, [kept]).value, abs=1e-15)
    halves[:] = np.nan
    nothing = score_of(layers, [dataclasses.replace(animal, halves=halves)])
    assert nothing.status == "undefined"
    assert "no layer can be chosen" in nothing.reasons[0]


def test_few_animals_or_stimuli_say_how_many_are_needed():
    latent = make_latent(10)
    score = score_of(make_layers(latent), make_animals(latent, 3))
    assert score.status == "ok"
    needed = "too few to tell models apart: 3 animals, at least 4 are needed; 6 stimuli, at least 10 are needed"
    assert needed in score.reasons


@pytest.mark.parametrize("estimator", ["thesis", "thesis-input"])
def test_the_published_estimators_take_the_maximum_over_layers_and_say_so(estimator):
    latent = make_latent(11)
    layers, animals = make_layers(latent), make_animals(latent, 4)
    score = score_of(layers, animals, estimator=estimator)
    by_layer = [
        np.mean(
            [
                noise_corrected(float(compare(layer, animal.rdm)), animal.split_half_r, estimator=estimator).value
                for animal in animals
            ]
        )
        for layer in layers.values()
    ]
    assert score.value == pytest.approx(max(by_layer), rel=1e-12)
    assert score.value == score.best_layer_value
    assert any(reason.startswith("optimistic") for reason in score.reasons)
    assert score.estimator == estimator


def test_three_stimuli_have_a_value_but_no_p_and_two_have_nothing():
    latent = make_latent(12, stimuli=3)
    animals = make_animals(latent, 3, noise=0.5)
    score = score_rdms(make_layers(latent), animals, name="x", stimuli=["a", "b", "c"])
    assert score.status == "unreliable"
    assert math.isfinite(score.value)
    assert math.isnan(score.p)
    assert score.p_smallest == pytest.approx(1 / 6)
    assert "3 stimuli allow no p below 0.167; at least 4 are needed" in score.reasons
    latent = make_latent(12, stimuli=2)
    two = score_rdms({"a": [0.4]}, make_animals(latent, 2), name="x", stimuli=["a", "b"])
    assert (two.status, two.p_smallest) == ("undefined", 1.0)
    assert two.reasons[0].startswith("2 stimuli are too few")


@pytest.mark.parametrize("method", ["spearman", "cosine", "tau-a", "whitened-pearson"])
def test_other_comparisons_use_their_own_split_halves(method):
    latent = make_latent(13)
    animals = make_animals(latent, 3)
    score = score_of(make_layers(latent), animals, compare=method)
    halves = animals[0].halves
    r = compare(halves[:, 0], halves[:, 1], method=method)
    assert score.subjects[0].reliability == pytest.approx(2 * r.mean() / (1 + r.mean()))
    assert score.metric.endswith(f"{method} comparison")


def test_a_score_survives_json():
    latent = make_latent(14)
    animals = [subject_rdm(f"m{i}", [make_block(latent, seed=i)], 6, splits=60) for i in range(2)]
    score = score_of(make_layers(latent), animals)
    assert len(score.without_stimulus) == 6
    assert Score.from_json(score.to_json()) == score


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"layer_rdms": {}}, "no layers"),
        ({"layer_rdms": {"a": np.ones(10)}}, r"Layer 'a' has an RDM \[10\]; 6 stimuli have 15 pairs"),
        ({"subjects": []}, "no animals"),
        ({"estimator": "defualt"}, "did you mean 'default'"),
        ({"compare": "pearsn"}, "did you mean 'pearson'"),
        ({"stimuli": ["a"] * 6}, "more than once"),
    ],
)
def test_misuse_is_told_in_a_sentence(change, message):
    latent = make_latent(15)
    arguments = {"layer_rdms": make_layers(latent), "subjects": make_animals(latent, 2), "stimuli": STIMULI}
    with pytest.raises(UsageError, match=message):
        score_rdms(name="x", **{**arguments, **change})


@pytest.mark.slow
@pytest.mark.parametrize("animals", [5, 11])
def test_the_interval_covers_the_mean_of_all_animals(animals):
    latent = make_latent(17)
    layer = rdm(latent + 0.3 * make_latent(18))
    everyone = [
        subject_rdm(f"m{i}", [make_block(latent, seed=i, units=40, repeats=15, noise=4.0)], 6, splits=100)
        for i in range(1500)
    ]
    values = np.array(
        [noise_corrected(float(compare(layer, animal.rdm)), animal.split_half_r).value for animal in everyone]
    )
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(2000):
        interval = t_interval(rng.choice(values, animals, replace=False))
        covered += interval.low <= values.mean() <= interval.high
    assert 0.93 <= covered / 2000 <= 0.97


def _difference(rng, stimuli, animals, shares):
    """Two models that hold a share of what animals' features have in common: difference, its error and freedom."""
    shared = rng.normal(size=(stimuli, 6))
    brain, layers = [], []
    for _ in range(animals):
        tuning = shared @ rng.normal(size=(6, 40)) / math.sqrt(6)
        brain.append(rdm(tuning + rng.normal(size=tuning.shape), method="sqeuclidean"))
    for share in shares:
        weight = 1 / (1 + math.sqrt(1 / share**2 - 1)) if share else 0.0
        other = rng.normal(size=shared.shape)
        features = np.concatenate([math.sqrt(weight) * shared, math.sqrt(1 - weight) * other], axis=1)
        layers.append(rdm(features, method="sqeuclidean"))
    models, brain = np.stack(layers), np.stack(brain)
    values = compare_all(models, brain, method="whitened-cosine")
    without = []
    for stimulus in range(stimuli):
        kept = permuted_pairs(np.delete(np.arange(stimuli), stimulus)[None], stimuli)[0]
        without.append(compare_all(models[:, kept], brain[:, kept], method="whitened-cosine").mean(axis=1))
    each, left_out = values[0] - values[1], np.array(without)
    error, freedom = two_factor_error(each, left_out[:, 0] - left_out[:, 1])
    return each.mean(), float(error), float(freedom)


@pytest.mark.slow
@pytest.mark.parametrize(("stimuli", "animals"), [(12, 4), (24, 8)])
def test_models_that_know_nothing_are_rarely_told_apart_and_a_better_one_mostly_is(stimuli, animals):
    rng = np.random.default_rng(stimuli)
    null = [_difference(rng, stimuli, animals, (0.0, 0.0)) for _ in range(150)]
    p = [2 * stats.t.sf(abs(mean) / error, freedom) for mean, error, freedom in null]
    # Three standard errors of 150 simulations at 5 %.
    assert np.mean(np.array(p) <= 0.05) <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 150)
    # The error is that of the difference over studies, or a little more.
    spread = np.std([mean for mean, _, _ in null], ddof=1)
    assert 0.9 * spread < np.sqrt(np.mean([error**2 for _, error, _ in null])) < 2.5 * spread
    if stimuli < 20:
        return
    found = [_difference(rng, stimuli, animals, (0.9, 0.4)) for _ in range(40)]
    power = np.mean([mean > 0 and 2 * stats.t.sf(mean / error, freedom) <= 0.05 for mean, error, freedom in found])
    assert power >= 0.8


def test_the_interval_is_students_where_stimuli_change_nothing_and_wider_where_they_do():
    values = np.random.default_rng(0).normal(0.5, 0.1, 8)
    narrow = two_factor_interval(values.mean(), values, np.full(20, values.mean()))
    low, high = stats.t.interval(0.95, 7, loc=values.mean(), scale=stats.sem(values))
    assert (narrow.low, narrow.high) == pytest.approx((low, high))
    wide = two_factor_interval(values.mean(), values, values.mean() + 0.02 * np.random.default_rng(1).normal(size=20))
    assert wide.low < narrow.low < narrow.high < wide.high
    assert two_factor_interval(0.5, [0.5], np.full(20, 0.5)) is None


def test_too_few_animals_or_stimuli_say_what_is_needed():
    assert interval_reasons(8, 20) == ()
    assert "1" not in interval_reasons(1, 20)[0]
    (told,) = interval_reasons(3, 20)
    assert "3 animals" in told
    assert "stimuli" not in told
    assert "6 stimuli" in interval_reasons(8, 6)[0]


def test_a_score_above_all_that_is_reliable_is_not_trusted():
    above = Score("x", 0.9, "ok", interval=Interval(0.88, 0.92), chance=0.5, attainable=0.8)
    held = held_to_scale(above)
    assert (held.status, "1.27" in held.reasons[0]) == ("unreliable", True)
    reaching = replace(above, interval=Interval(0.78, 1.02))
    assert held_to_scale(reaching) is reaching


def score_animals(animals, stimuli=STIMULI):
    return RSA(comparison="pearson").score_animals(animals, stimuli=stimuli)


def _make_agreeing_animals(count, seed=0, noise=3.0, latent=None, splits=100):
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
    animals = _make_agreeing_animals(3)
    score = score_animals(animals, stimuli=STIMULI)
    others = np.mean([animals[1].rdm, animals[2].rdm], axis=0)
    halves = np.mean([animals[1].halves, animals[2].halves], axis=0)
    both = spearman_brown(animals[0].split_half_r.mean()) * spearman_brown(compare(halves[:, 0], halves[:, 1]).mean())
    assert score.subjects[0].value == pytest.approx(float(compare(animals[0].rdm, others)) / math.sqrt(both))
    assert score.value == pytest.approx(np.mean([subject.value for subject in score.subjects]))
    assert score.stimuli == STIMULI
    assert score.status == "ok"


@pytest.mark.parametrize("name", ["rsa", "rsa-correlation", "rsa-crossnobis", "cka", "procrustes", "ridge"])
def test_an_animal_with_larger_responses_decides_no_more_than_others(name):
    metric, values = get_metric(name), []
    for scale in (1.0, 64.0):
        blocks = [make_block(make_latent(0), seed=seed, units=30) for seed in range(4)]
        blocks[0] = replace(blocks[0], responses=blocks[0].responses * scale)
        animals = [metric.animal(f"m{index}", [block], 6) for index, block in enumerate(blocks)]
        values.append(metric.score_animals(animals, stimuli=STIMULI))
    assert values[1].value == pytest.approx(values[0].value, rel=1e-6)
    assert values[1].p == values[0].p


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
    score = score_animals(_make_agreeing_animals(1))
    assert score.status == "undefined"
    assert score.reasons[0] == "fewer than two animals can be used"
    assert math.isnan(score.value)


def test_two_animals_make_one_comparison_and_have_no_interval():
    score = score_animals(_make_agreeing_animals(2))
    assert score.subjects[0].value == pytest.approx(score.subjects[1].value, abs=1e-12)
    assert score.interval is None
    assert "two animals make one comparison: no confidence interval" in score.reasons


def test_unreliable_animals_are_left_out_and_named():
    animals = _make_agreeing_animals(3)
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


def test_an_agreement_refuses_what_it_cannot_take():
    with pytest.raises(UsageError, match="give at least one SubjectRDM"):
        score_animals([])
    with pytest.raises(UsageError, match="6 stimuli; 2 are scored"):
        score_animals(_make_agreeing_animals(2), stimuli=["a", "b"])


@pytest.mark.parametrize("metric", ["rsa", "rsa-correlation"])
def test_the_error_of_random_splits_is_what_values_scatter_by_over_seeds(metric):
    latent, measure = make_latent(stimuli=8), get_metric(metric)
    blocks = [make_block(latent, seed=seed, noise=3.0) for seed in range(3)]
    features, values, errors = {"layer": latent}, [], []
    for seed in range(30):
        animals = [measure.animal(f"m{i}", [block], 8, seed=seed, splits=20) for i, block in enumerate(blocks)]
        score = measure.score(features, animals, name="model", stimuli=list("abcdefgh"))
        values.append(score.value)
        error = score.provenance.statistics["monte_carlo_error"]
        errors.append(error["value"])
    assert np.mean(errors) == pytest.approx(np.std(values, ddof=1), rel=0.35)


@pytest.mark.parametrize("metric", ["cka", "ridge"])
def test_the_errors_of_chance_and_of_what_is_attainable_are_what_they_scatter_by_over_seeds(metric, monkeypatch):
    latent, measure = make_latent(stimuli=10), get_metric(metric)
    monkeypatch.setattr(type(measure), "orders", 60)
    animals = [measure.animal(f"m{seed}", [make_block(latent, seed=seed, noise=3.0)], 10) for seed in range(3)]
    scores = [
        measure.score({"layer": latent}, animals, name="model", stimuli=list("abcdefghij"), seed=seed)
        for seed in range(24)
    ]
    for part in ("chance", "attainable"):
        errors = [score.provenance.statistics["monte_carlo_error"][part] for score in scores]
        assert np.mean(errors) == pytest.approx(np.std([getattr(score, part) for score in scores], ddof=1), rel=0.4)
