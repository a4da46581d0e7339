"""Matched units: exact transport, calibrated against chance, and what each unit adds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.stats import kstest

from brainbench.core.contracts import Trials
from brainbench.metrics import get_metric
from brainbench.metrics.measures.patterns import MOST_FEATURES, OneToOne, SoftMatching
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

STIMULI, TRIALS = 12, 8
NAMES = [f"s{index}" for index in range(STIMULI)]


def _transported(likeness):
    """The value of optimal transport between equal masses, by a linear programme."""
    units, features = likeness.shape
    rows, columns = np.kron(np.eye(units), np.ones(features)), np.kron(np.ones(units), np.eye(features))
    masses = np.r_[np.full(units, 1 / units), np.full(features, 1 / features)]
    return -linprog(-likeness.ravel(), A_eq=np.r_[rows, columns], b_eq=masses).fun


def _make_animals(metric, tunings, *, noise=1.0, seed=0, columns=None):
    """Animals whose units have given tunings [K, U], and noise on each trial."""
    rng, animals = np.random.default_rng(seed), []
    labels = np.repeat(np.arange(STIMULI), TRIALS)
    for index, tuning in enumerate(tunings):
        responses = tuning[labels] + noise * rng.normal(size=(len(labels), tuning.shape[1]))
        keys = [f"{index}/{row}" for row in range(len(labels))]
        block = Trials(responses, labels, keys, columns=columns or {})
        animals.append(metric.animal(f"m{index}", [block], STIMULI, seed=seed))
    return animals


def _matched_score(metric, layers, animals):
    return metric.score(layers, animals, name="model", stimuli=NAMES)


@pytest.mark.parametrize(("units", "features"), [(5, 5), (4, 12), (12, 4)])
def test_soft_matching_is_optimal_transport(units, features):
    likeness = np.random.default_rng(units).uniform(-1, 1, size=(units, features))
    chosen = SoftMatching().chosen(features, units)
    rows, columns = SoftMatching().pairs(likeness[:, chosen])
    assert likeness[rows, chosen[columns]].mean() == pytest.approx(_transported(likeness), abs=1e-9)
    assert len(np.unique(rows)) == units


@pytest.mark.parametrize(("units", "features"), [(60, 40), (60, 50), (60, 7)])
@pytest.mark.parametrize("related", [True, False])
def test_a_layer_of_fewer_features_than_units_reaches_what_equal_masses_do(units, features, related):
    # Features that suited the units took twice the mass of others, so 40 features reached .78 in place of .73.
    metric, errors = SoftMatching(), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shared = rng.normal(size=(STIMULI, 5)) * related
        sides = [
            shared @ rng.normal(size=(5, count)) + rng.normal(size=(STIMULI, count)) for count in (units, features)
        ]
        left, right = ((side - side.mean(axis=0)) / side.std(axis=0) / np.sqrt(STIMULI) for side in sides)
        likeness = left.T @ right
        chosen = metric.chosen(features, units)
        assert np.bincount(chosen).max() - np.bincount(chosen).min() <= 1
        reached = likeness[:, chosen][metric.pairs(likeness[:, chosen])].mean()
        errors.append(reached - _transported(likeness))
    assert np.mean(errors) == pytest.approx(0, abs=0.015)


def test_units_that_stand_twice_change_little():
    metric, rng = get_metric("soft-matching"), np.random.default_rng(0)
    shared = rng.normal(size=(STIMULI, 5))
    tunings = [shared @ rng.normal(size=(5, 30)) for _ in range(4)]
    layer = shared @ rng.normal(size=(5, 40)) + 0.5 * rng.normal(size=(STIMULI, 40))
    single, double = (
        _matched_score(metric, {"layer": layer}, _make_animals(metric, some, noise=0.1))
        for some in (tunings, [np.repeat(tuning, 2, axis=1) for tuning in tunings])
    )
    assert double.value == pytest.approx(single.value, abs=0.025)
    assert double.chance == pytest.approx(single.chance, abs=0.025)


def test_one_to_one_gives_no_feature_twice_and_large_layers_are_sampled_in_multiples():
    likeness = np.random.default_rng(0).uniform(-1, 1, size=(6, 9))
    units, features = OneToOne().pairs(likeness)
    assert (len(set(units.tolist())), len(set(features.tolist()))) == (6, 6)
    sample = SoftMatching().chosen(1000, 30)
    assert (len(sample), len(np.unique(sample))) == (30 * (MOST_FEATURES // 30), len(sample))
    assert len(SoftMatching().chosen(300, 200)) == 200


@pytest.mark.parametrize("name", ["soft-matching", "one-to-one"])
def test_a_network_with_the_same_units_reaches_one_and_a_turned_one_does_not(name):
    metric, rng = get_metric(name), np.random.default_rng(3)
    truth = rng.normal(size=(STIMULI, 40)) ** 3
    tunings = [truth[:, rng.permutation(40)[:20]] for _ in range(4)]
    animals = _make_animals(metric, tunings, noise=2.0)
    equal = _matched_score(metric, {"layer": truth}, animals)
    turned = _matched_score(metric, {"layer": truth @ np.linalg.qr(rng.normal(size=(40, 40)))[0]}, animals)
    assert (equal.status, equal.p) == ("ok", pytest.approx(1 / 200))
    # Of twice as many features soft matching has to use those of other animals' units, too.
    assert equal.scaled == pytest.approx(1.0, abs=0.1) if name == "one-to-one" else equal.scaled > 0.4
    assert turned.scaled < equal.scaled - 0.2
    rsa = get_metric("rsa")
    same = [
        _matched_score(rsa, {"layer": part}, _make_animals(rsa, tunings, noise=2.0)).value
        for part in (truth, truth * 2)
    ]
    assert same[0] == pytest.approx(same[1])


def test_agreement_of_animals_does_not_depend_on_how_they_and_their_units_are_listed():
    metric, rng = get_metric("soft-matching"), np.random.default_rng(4)
    truth = rng.normal(size=(STIMULI, 60))
    animals = _make_animals(metric, [truth[:, rng.permutation(60)[:45]] for _ in range(4)], noise=1.0)
    order = rng.permutation(45)
    listed = [replace(a, patterns=a.patterns[:, order], noise=a.noise[:, order]) for a in animals[::-1]]
    # Of the 135 units of the others a sample of 90 is taken.
    first, second = (metric.score_animals(some, stimuli=range(STIMULI)).value for some in (animals, listed))
    assert second == pytest.approx(first, abs=1e-12)


def test_a_score_does_not_depend_on_how_the_features_of_a_layer_are_listed():
    metric, rng = get_metric("soft-matching"), np.random.default_rng(7)
    truth = rng.normal(size=(STIMULI, 20))
    animals, layer = _make_animals(metric, [truth] * 3), truth[:, rng.permutation(20)] @ rng.normal(size=(20, 30))
    lacking = np.where(np.arange(STIMULI)[:, None] == 2, np.nan, layer)
    order = rng.permutation(30)
    # Of the 30 features a sample of 20 is taken.
    for values in (layer, lacking, np.clip(np.round(layer / 5), 0, 1)):
        first, second = (_matched_score(metric, {"layer": part}, animals) for part in (values, values[:, order]))
        assert (second.value, second.chance) == pytest.approx((first.value, first.chance), abs=1e-12)


@pytest.mark.parametrize("name", ["soft-matching", "one-to-one"])
def test_networks_that_know_nothing_have_uniform_p(name):
    metric, p = get_metric(name), []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        animal = SubjectRDM("m", np.ones(66), np.empty(0), np.empty((0, 2, 66)), patterns=rng.normal(size=(12, 8)))
        orders = np.stack([np.arange(12), *(rng.permutation(12) for _ in range(39))])
        values = metric.compare_orders(rng.normal(size=(12, 16)), [animal], orders)[:, 0]
        p.append(np.mean(values >= values[0]))
    assert kstest(p, "uniform").pvalue > 0.01
    assert np.mean(np.array(p) <= 0.1) < 0.2


def test_what_each_unit_adds_is_known_by_unit_and_by_layer():
    metric, rng = get_metric("one-to-one"), np.random.default_rng(5)
    truth = rng.normal(size=(STIMULI, 10))
    tunings = [np.c_[truth, rng.normal(size=(STIMULI, 10))] for _ in range(4)]
    layers = np.repeat(["L4", "L5"], 10)
    animals = _make_animals(metric, tunings, noise=0.5, columns={"layer": layers, "area": np.full(20, "")})
    units = _matched_score(metric, {"layer": truth}, animals).provenance.statistics["units"]
    parts = np.array(units["animals"]["m0"], dtype=float)
    assert parts[:10].min() > 0.9
    groups = units["groups"]["layer"]
    assert list(units["groups"]) == ["layer"]
    assert groups["L4"]["value"] > 0.9
    assert (groups["L4"]["units"], groups["L4"]["animals"]) == (40, 4)
    assert "L5" not in groups or groups["L5"]["value"] < groups["L4"]["value"]


def test_without_a_stimulus_is_the_correlation_over_the_others():
    metric, rng = get_metric("one-to-one"), np.random.default_rng(6)
    truth = rng.normal(size=(STIMULI, 6))
    (animal,) = _make_animals(metric, [truth], noise=0.2)
    without = metric.compare_without([truth], [animal])[:, 0, 0]
    rest = [np.delete(np.arange(STIMULI), place) for place in range(STIMULI)]
    direct = [np.mean([np.corrcoef(truth[r, i], animal.patterns[r, i])[0, 1] for i in range(6)]) for r in rest]
    np.testing.assert_allclose(without, direct, atol=1e-12)


def test_silent_units_and_constant_features_take_no_part():
    metric = get_metric("soft-matching")
    model = np.c_[np.ones(STIMULI), np.arange(STIMULI)]
    (animal,) = _make_animals(metric, [np.c_[np.arange(STIMULI) * 1.0, np.zeros(STIMULI)]], noise=0.0)
    np.testing.assert_allclose(metric.contributions(model, animal), [1.0, np.nan], atol=1e-12)


@pytest.mark.parametrize("name", ["soft-matching", "one-to-one"])
def test_units_and_features_that_never_vary_change_no_score(name):
    rng, metric = np.random.default_rng(4), get_metric(name)
    tunings = [rng.normal(size=(STIMULI, 8)) for _ in range(4)]
    layer = np.concatenate([tuning[:, :5] for tuning in tunings], axis=1)
    scores = []
    for silent, dead in ((0, 0), (6, 0), (0, 30)):
        animals = _make_animals(metric, tunings)
        for index, animal in enumerate(animals):
            patterns, noise = (np.pad(part, ((0, 0), (0, silent))) for part in (animal.patterns, animal.noise))
            animals[index] = replace(animal, patterns=patterns, noise=noise)
        score = _matched_score(metric, {"layer": np.pad(layer, ((0, 0), (0, dead)))}, animals)
        scores.append((score.value, score.scaled))
    # Six silent units of fourteen took the value from .78 to .45.
    np.testing.assert_allclose(scores[1:], [scores[0]] * 2, atol=0.02)
    assert np.isnan(score.provenance.statistics["monte_carlo_error"]["value"]) == (name == "soft-matching")
