"""Layers are chosen without the data they are scored on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import get_metric
from brainbench.metrics.evaluation import HALVES, choose_on_others, first_best, held_out, most_chosen
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.metrics.reliability.subject_rdm import subject_rdm
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


def test_unreliable_animals_do_not_vote_and_are_named():
    latent = make_latent(5)
    layers, good = make_layers(latent), make_animals(latent, 4)
    rng = np.random.default_rng(0)
    noisy = make_subject("z", make_rdm(rng), reliability=0.2)
    score, without = score_of(layers, [*good, noisy]), score_of(layers, good)
    assert score.value == pytest.approx(without.value, abs=1e-15)
    assert score.p == without.p
    assert score.status == "ok"
    assert "animal z left out: reliability 0.20 is below 0.3" in score.reasons
    last = score.subjects[-1]
    assert (last.subject, last.status) == ("z", "unreliable")
    assert math.isfinite(last.value)


@pytest.mark.parametrize(("reliabilities", "status"), [((0.4, 0.45, 0.6), "unreliable"), ((0.4, 0.6, 0.65), "ok")])
def test_the_mean_reliability_of_the_study_decides_not_that_of_single_animals(reliabilities, status):
    rng = np.random.default_rng(6)
    animals = [make_subject(f"m{i}", make_rdm(rng), reliability=r, seed=i) for i, r in enumerate(reliabilities)]
    score = score_of({"a": make_rdm(rng)}, animals)
    assert score.status == status
    assert [subject.status for subject in score.subjects] == [status] * 3
    assert ("reliability, 0.45, is below 0.5" in "; ".join(score.reasons)) == (status == "unreliable")


def test_when_no_animal_is_reliable_the_value_is_reported_as_unreliable():
    rng = np.random.default_rng(6)
    animals = [make_subject(f"m{i}", make_rdm(rng), reliability=0.3, seed=i) for i in range(3)]
    score = score_of({"a": make_rdm(rng), "b": make_rdm(rng)}, animals)
    assert score.status == "unreliable"
    assert score.reasons[0] == "no animal is reliable"
    assert math.isfinite(score.value)


def test_animals_without_a_stimulus_are_left_out_in_words():
    latent = make_latent(7)
    lacking = subject_rdm("a0", [make_block(latent, gap=(2,))], 6, stimuli=STIMULI)
    score = score_of(make_layers(latent), [lacking, *make_animals(latent, 3)])
    assert score.status == "ok"
    assert "animal a0 left out: no trials of 'convex-far'" in score.reasons
    assert score.subjects[0].status == "undefined"
    alone = score_of(make_layers(latent), [lacking])
    assert alone.status == "undefined"
    assert alone.reasons == ("no animal can be used", "animal a0 left out: no trials of 'convex-far'")
    assert math.isnan(alone.value)
    assert alone.p_smallest == pytest.approx(1 / 720)


def test_an_animal_given_twice_or_with_other_stimuli_is_refused():
    latent = make_latent(16)
    (animal,) = make_animals(latent, 1)
    with pytest.raises(UsageError, match="Subject 'm0' appears twice"):
        score_of(make_layers(latent), [animal, animal])
    with pytest.raises(UsageError, match="'m0' has an RDM of 5"):
        score_of(make_layers(latent), make_animals(make_latent(16, stimuli=5), 1))


def test_each_animal_gets_the_layer_that_is_best_on_the_others():
    r = np.random.default_rng(0).normal(size=(5, 4))
    expected = [int(np.argmax(np.delete(r, animal, axis=1).mean(axis=1))) for animal in range(4)]
    assert choose_on_others(r).tolist() == expected
    np.testing.assert_array_equal(held_out(r), r[expected, range(4)])


def test_permutations_are_chosen_one_by_one():
    r = np.random.default_rng(1).normal(size=(7, 5, 4))
    np.testing.assert_array_equal(held_out(r), np.stack([held_out(one) for one in r]))


def test_what_is_chosen_on_one_half_is_evaluated_on_the_other():
    # Two splits of two halves each, side by side.
    r = np.array([[0.9, 0.3, 0.1, 0.7], [0.2, 0.6, 0.8, 0.5]])
    assert HALVES.choose(r).tolist() == [1, 0, 0, 1]
    assert HALVES.held(r).tolist() == [0.2, 0.3, 0.1, 0.5]


def test_ties_go_to_the_first_layer_even_when_rounding_differs():
    assert first_best(np.array([[0.1], [0.5], [0.5 + 1e-15]])).tolist() == [1]
    assert most_chosen(np.array([2, 1, 2, 1])) == 1


def _null_scores(count, seed, layers=10, animals=4):
    """Nested and naive results of models whose layers know nothing."""
    rng = np.random.default_rng(seed)
    p, values, naive = [], [], []
    for _ in range(count):
        shared = make_rdm(rng)
        subjects = [make_subject(f"m{i}", shared + 0.1 * rng.normal(size=15), seed=i) for i in range(animals)]
        score = score_rdms({f"l{i}": make_rdm(rng) for i in range(layers)}, subjects, name="null", stimuli=STIMULI)
        p.append(score.p)
        values.append(score.value)
        naive.append(_naive_p(score))
    return np.array(p), np.array(values), np.array(naive)


def _naive_p(score):
    """The p-value of the best layer as if it had been the only one: t table of one layer's null."""
    best = max(layer.r for layer in score.layers)
    return stats.norm.sf(best / 0.27)


@pytest.mark.slow
def test_p_stays_calibrated_after_choosing_a_layer_and_the_naive_maximum_does_not():
    p, _, naive = _null_scores(150, seed=2)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert 0.02 <= (p <= 0.05).mean() <= 0.09
    assert (naive <= 0.05).mean() > 0.25


@pytest.mark.slow
def test_p_is_calibrated_after_layer_choice_in_two_thousand_simulations():
    p, _, naive = _null_scores(2000, seed=3)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert 0.04 <= (p <= 0.05).mean() <= 0.06
    assert (naive <= 0.05).mean() > 0.25


@pytest.mark.slow
def test_p_of_a_single_animal_is_calibrated_after_choosing_on_halves():
    p, _, _ = _null_scores(2000, seed=4, animals=1)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert 0.04 <= (p <= 0.05).mean() <= 0.06


def test_without_shared_stimuli_held_out_choice_is_unbiased_and_the_maximum_is_not():
    rng = np.random.default_rng(5)
    held, maximum = [], []
    for _ in range(400):
        r = 0.27 * rng.normal(size=(12, 4))
        held.append(held_out(r).mean())
        maximum.append(r.mean(axis=1).max())
    assert abs(np.mean(held)) < 4 * np.std(held) / np.sqrt(400)
    assert np.mean(maximum) > 0.15


SIXTEEN = [f"s{place}" for place in range(16)]


def _study(metric, seed, *, related=True, rest=2.5):
    """Animals of one geometry, and layers: one that holds it, one of many features that know nothing."""
    rng = np.random.default_rng(seed)
    geometry, other, unrelated = rng.normal(size=(3, 16, 4))
    labels, animals = np.repeat(np.arange(16), 6), []
    for animal in range(4):
        responses = ((geometry if related else unrelated) @ rng.normal(size=(4, 40)))[labels]
        responses += 2 * rng.normal(size=responses.shape)
        keys = [f"{animal}/{trial}" for trial in range(len(labels))]
        animals.append(metric.animal(f"m{animal}", [Trials(responses, labels, keys)], 16, splits=20))
    good, flat = np.hstack([geometry, rest * other]) @ rng.normal(size=(8, 60)), rng.normal(size=(16, 500))
    noise = rng.normal(size=(5, 16, 3)) @ rng.normal(size=(3, 60))
    return animals, {"flat": flat, "good": good}, noise


def _without(values, *stimuli):
    return np.where(np.isin(np.arange(16), stimuli)[:, None], np.nan, values)


@pytest.mark.parametrize("name", ["rsa", "rsa-correlation", "cka", "procrustes", "ridge", "soft-matching"])
def test_what_a_perfect_model_reaches_depends_on_no_layer_and_chance_mostly_does(name):
    metric = get_metric(name)
    animals, layers, _ = _study(metric, 0)
    alone = [metric.score({label: values}, animals, name="x", stimuli=SIXTEEN) for label, values in layers.items()]
    assert alone[0].attainable == alone[1].attainable
    # With one chance for all, the raw order is that of the common scale; else layers of high chance would win.
    difference = alone[0].chance - alone[1].chance
    assert abs(difference) < 0.02 if name in ("rsa-correlation", "ridge") else abs(difference) > 0.05


def test_the_chance_of_a_layer_is_that_of_its_dimensions():
    rng = np.random.default_rng(3)
    metric, animals = get_metric("cka"), make_animals(make_latent(3), 2)
    layer = rng.normal(size=(6, 40))
    score = metric.score({"a": layer}, animals, name="x", stimuli=STIMULI)
    # Over all 6! orders the mean product of two centred kernels is that of their traces.
    kernels = [part @ part.T for part in (x - x.mean(axis=0) for x in (layer, *(one.patterns for one in animals)))]
    share, *shares = (np.trace(kernel) / np.linalg.norm(kernel) for kernel in kernels)
    factors = [subject.value / subject.r for subject in score.subjects]
    assert score.chance == pytest.approx(np.mean(np.multiply(factors, shares)) * share / 5, rel=1e-9)


@pytest.mark.parametrize("name", ["rsa", "cka"])
def test_a_layer_of_high_chance_takes_the_choice_from_no_other(name):
    metric = get_metric(name)
    animals, layers, _ = _study(metric, 4)
    alone = metric.score({"good": layers["good"]}, animals, name="x", stimuli=SIXTEEN)
    flat = metric.score({"flat": layers["flat"]}, animals, name="x", stimuli=SIXTEEN)
    assert flat.value > alone.value
    assert flat.p > 0.05 >= alone.p
    beside = metric.score(layers, animals, name="x", stimuli=SIXTEEN)
    assert (beside.layer, beside.best_layer, beside.value) == ("good", "good", alone.value)
    assert beside.p <= 0.05
    # Values of layers stand on the scale of the score, whose chance the choice raises a little.
    assert beside.layers[0].value == pytest.approx(alone.chance, abs=0.05)
    assert beside.layers[0].r == flat.r
    assert alone.chance <= beside.chance < alone.chance + 0.1
    committed = metric.score(layers, animals, name="x", stimuli=SIXTEEN, layer="flat")
    assert (committed.value, committed.p, committed.chance) == (flat.value, flat.p, flat.chance)
    assert committed.best_layer == "good"


@pytest.mark.parametrize("name", ["rsa", "ridge"])
def test_layers_that_lack_other_stimuli_compete_on_one_scale(name):
    metric = get_metric(name)
    animals, layers, noise = _study(metric, 4, rest=0.5)
    given = {"flat": _without(layers["flat"], 5), "noise": _without(noise[0], 7), "good": _without(layers["good"], 3)}
    score = metric.score(given, animals, name="x", stimuli=SIXTEEN)
    alone = metric.score({"good": given["good"]}, animals, name="x", stimuli=SIXTEEN)
    assert (score.layer, score.best_layer, score.value) == ("good", "good", alone.value)
    assert score.attainable == alone.attainable
    assert (score.p <= 0.05) == (alone.p <= 0.05)
    assert "flat (1 of 16), noise (1 of 16), good (1 of 16)" in score.reasons[0]
    fewer = {f"p{place}": _without(values, *range(8)) for place, values in enumerate(noise)}
    more = metric.score(given | fewer, animals, name="x", stimuli=SIXTEEN)
    assert (more.p, more.value, more.chance) == (score.p, score.value, score.chance)


@pytest.mark.slow
def test_p_is_calibrated_and_power_is_kept_beside_layers_of_high_chance_or_without_stimuli():
    metric, p = get_metric("rsa"), {}
    for seed in range(300):
        for related in (False, True):
            animals, layers, noise = _study(metric, seed, related=related)
            cases = {
                "alone": {"good": layers["good"]},
                "flat": layers,
                "partial": {"good": layers["good"]} | {f"p{i}": _without(x, *range(8)) for i, x in enumerate(noise)},
                "lacking": {"good": _without(layers["good"], 3), "flat": _without(layers["flat"], 5)},
            }
            for case, given in cases.items():
                score = metric.score(given, animals, name="x", stimuli=SIXTEEN)
                p.setdefault((case, related), []).append(score.p <= 0.05)
    share = {key: np.mean(values) for key, values in p.items()}
    # Two standard errors of .05 in 300 studies are .025.
    assert all(value < 0.075 for (_, related), value in share.items() if not related), share
    assert p["partial", True] == p["alone", True]
    assert share["flat", True] > share["alone", True] - 0.06, share
    assert share["lacking", True] > share["alone", True] - 0.12, share


def test_a_layer_that_lacks_stimuli_lowers_the_power_of_no_other_and_is_chosen_only_among_its_like():
    rng = np.random.default_rng(0)
    hidden, names, labels = rng.normal(size=(16, 4)), [f"s{place}" for place in range(16)], np.repeat(np.arange(16), 6)
    metric, animals = get_metric("rsa"), []
    for animal in range(4):
        responses = (hidden @ rng.normal(size=(4, 30)))[labels] + 2 * rng.normal(size=(96, 30))
        keys = [f"{animal}/{trial}" for trial in range(96)]
        animals.append(metric.animal(f"m{animal}", [Trials(responses, labels, keys)], 16, splits=40))

    def score(**layers: np.ndarray):
        return metric.score(layers, animals, name="net", stimuli=names)

    weak, partial = hidden @ rng.normal(size=(4, 2)), {f"p{place}": rng.normal(size=(16, 3)) for place in range(20)}
    partial = {name: np.where(np.arange(16)[:, None] < 8, values, np.nan) for name, values in partial.items()}
    alone, beside = score(weak=weak), score(weak=weak, **partial)
    assert (beside.p, beside.value, beside.chance) == (alone.p, alone.value, alone.chance)
    assert (beside.layer, beside.best_layer, beside.interval) == ("weak", "weak", alone.interval)
    assert "chosen only where no layer has more" in beside.reasons[0]
    tests = {test["layer"]: test for test in beside.provenance.statistics["layer_tests"]}
    assert tests["weak"]["p_corrected"] == tests["weak"]["p"]
    true = np.where(np.arange(16)[:, None] < 8, hidden, np.nan)
    assert score(true=true, **partial).layer == "true"
