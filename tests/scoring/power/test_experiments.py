"""Power analysis: its simulated truth, its limits, and its agreement with the whole pipeline."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.metrics import compare, get_metric
from brainbench.metrics.inference.permutation import label_orders, tail_p
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.metrics.rdms.comparison import compare_all, permuted_comparisons, products
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.scoring.power.experiments import (
    MOST,
    ExperimentDesign,
    needed,
    pattern_dimensions,
    power,
    signal_dimensions,
    simulate_experiments,
)
from tests.factories.animals import STIMULI, make_subject


def test_the_simulated_rdms_have_the_stated_correlations():
    design = ExperimentDesign(stimuli=40, animals=3, effect=0.5, consistency=0.7, reliability=0.6, layers=2)
    model, brain = simulate_experiments(np.random.default_rng(0), design, 60)

    def r(a, b):
        return compare(a, b, method="whitened-pearson").mean()

    q = design.reliability_of_differences
    assert r(model[:, 0], brain[:, 0]) == pytest.approx(0.5 * np.sqrt(q), abs=0.02)
    assert r(brain[:, 0], brain[:, 1]) == pytest.approx(0.7 * q, abs=0.02)
    assert r(model[:, 1], brain[:, 0]) == pytest.approx(0, abs=0.02)
    assert brain.std() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(("stimuli", "dimensions", "noise"), [(6, 4, 7.0), (12, 2, 8.0), (16, 10, 14.0)])
def test_reliability_is_that_of_whole_rdms_as_a_score_states_it(stimuli, dimensions, noise):
    # The mean distance makes the RDMs of few stimuli look reliable, and tells no model from another.
    rng, metric = np.random.default_rng(stimuli), get_metric("rsa")
    labels, methods = np.repeat(np.arange(stimuli), 6), ("whitened-cosine", "whitened-pearson")
    sizes = np.zeros((2, 2))
    for _ in range(200):
        patterns = rng.normal(size=(stimuli, dimensions)) @ rng.normal(size=(dimensions, 60))
        trials = patterns[labels] + noise * rng.normal(size=(len(labels), 60))
        measured = metric.animal("m", [Trials(trials, labels)], stimuli, splits=1).rdm
        for side, values in enumerate((rdm(patterns, method="sqeuclidean"), measured)):
            sizes[side] += [float(products(values, values, method)) for method in methods]
    whole, differences = sizes[0] / sizes[1]
    assert differences < whole - 0.02
    design = ExperimentDesign(stimuli=stimuli, dimensions=dimensions, reliability=whole)
    assert design.reliability_of_differences == pytest.approx(differences, abs=0.04)
    for extreme in (0.0, 1.0):
        assert dataclasses.replace(design, reliability=extreme).reliability_of_differences == extreme


@pytest.mark.parametrize(("stimuli", "dimensions"), [(5, 5), (5, 10), (6, 10), (8, 5)])
def test_few_stimuli_show_on_average_what_is_stated(stimuli, dimensions):
    # What sums of RDMs share is not what a few stimuli show of it: .52 where .57 was stated, with five.
    design = ExperimentDesign(stimuli, 2, effect=0.6, consistency=0.8, reliability=0.9, dimensions=dimensions)
    model, brain = simulate_experiments(np.random.default_rng(0), design, 4000)
    q = design.reliability_of_differences
    assert compare(model[:, 0], brain[:, 0], method="whitened-pearson").mean() == pytest.approx(0.6 * q**0.5, abs=0.02)
    assert compare(brain[:, 0], brain[:, 1], method="whitened-pearson").mean() == pytest.approx(0.8 * q, abs=0.03)
    opposite = dataclasses.replace(design, effect=-0.6)
    model, brain = simulate_experiments(np.random.default_rng(0), opposite, 4000)
    assert compare(model[:, 0], brain[:, 0], method="whitened-pearson").mean() == pytest.approx(-0.6 * q**0.5, abs=0.05)


def test_two_stimuli_have_no_differences_between_distances():
    design = ExperimentDesign(stimuli=2, animals=1)
    assert design.reliability_of_differences == 0
    assert power(design).reason == "2 stimuli allow no p below 1, whatever is true"
    model, brain = simulate_experiments(np.random.default_rng(0), design, 3)
    assert (model.shape, brain.shape) == ((3, 1, 1), (3, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize(("dimensions", "noise"), [(5, 2.0), (10, 0.5)])
def test_power_of_five_stimuli_and_one_animal_is_that_of_experiments(dimensions, noise):
    stimuli, studies, rng = 5, 1500, np.random.default_rng(dimensions)
    orders = next(iter(label_orders(stimuli, 0, exact=6, draws=119)))
    results = []
    for _ in range(studies):
        shared, other, own, twin = rng.normal(size=(4, stimuli, dimensions))
        weights = rng.normal(size=(4, dimensions, 60))
        first, second = (
            np.sqrt(0.8) * shared @ left + np.sqrt(0.2) * rest @ right
            for rest, left, right in ((own, *weights[:2]), (twin, *weights[2:]))
        )
        mixed = rng.normal(size=(2, dimensions, 300))
        patterns = np.sqrt(0.5) * (shared @ mixed[0] + other @ mixed[1])
        noisy = first + noise * np.sqrt(dimensions / 8) * rng.normal(size=first.shape)
        model, true, animal, measured = (rdm(p, method="sqeuclidean") for p in (patterns, first, second, noisy))
        null = next(iter(permuted_comparisons(model[None], measured[None], iter([orders]), "whitened-cosine")))
        pairs = ((model, true), (true, animal), (true, measured))
        values = [float(compare(one, two, method="whitened-pearson")) for one, two in pairs]
        results.append([tail_p(null[:, 0, 0]) <= 0.05, *values])
    hits, effect, consistency, noiseless = np.mean(results, axis=0)
    design = ExperimentDesign(stimuli, 1, effect=effect, consistency=consistency, dimensions=dimensions)
    mean = (4 * dimensions + 2) / 18
    whole = noiseless**2 * (1 + mean) / (1 + mean * noiseless**2)  # the reliability that a score states
    design = dataclasses.replace(design, reliability=whole)
    assert design.reliability_of_differences == pytest.approx(noiseless**2)
    assert power(design, simulations=3000).power == pytest.approx(hits, abs=0.035)


@pytest.mark.parametrize("layers", [1, 8])
def test_without_an_effect_the_power_is_the_level(layers):
    found = power(ExperimentDesign(effect=0.0, animals=4, layers=layers), simulations=600, seed=1)
    assert found.interval.low <= 0.05 <= found.interval.high


def test_power_grows_with_stimuli_animals_and_effect():
    base = ExperimentDesign(stimuli=6, animals=4, effect=0.5)
    values = [
        power(design, simulations=300).power
        for design in (
            ExperimentDesign(6, 4, 0.2),
            base,
            ExperimentDesign(6, 4, 0.8),
            ExperimentDesign(10, 4, 0.5),
            ExperimentDesign(6, 30, 0.5),
        )
    ]
    assert values[0] < values[1] < values[2]
    assert values[3] > values[1]
    assert values[4] >= values[1] - 0.05


def test_the_search_returns_a_number_that_suffices_and_none_where_nothing_does():
    design = ExperimentDesign(effect=0.6, animals=6)
    number = needed(design, "stimuli", simulations=300)
    assert power(ExperimentDesign(number, 6, 0.6), simulations=300).power >= 0.8
    # With six stimuli more animals cannot help a weak effect.
    assert needed(ExperimentDesign(effect=0.2), "animals", simulations=200) is None


def test_three_stimuli_find_nothing():
    found = power(ExperimentDesign(stimuli=3))
    assert (found.power, found.simulations) == (0.0, 0)
    assert found.reason == "3 stimuli allow no p below 0.167, whatever is true"


@pytest.mark.slow
def test_power_is_that_of_the_scores_own_test():
    design = ExperimentDesign(animals=5, effect=0.6, layers=3)
    rng = np.random.default_rng(1)
    model, brain = simulate_experiments(rng, design, 400)
    found = 0
    for layers, animals in zip(model, brain, strict=True):
        subjects = [make_subject(f"m{i}", animal, seed=i) for i, animal in enumerate(animals)]
        score = score_rdms(
            {str(i): layer for i, layer in enumerate(layers)},
            subjects,
            name="x",
            stimuli=STIMULI,
            compare="whitened-pearson",
        )
        found += score.p <= 0.05
    expected = power(design, simulations=2000)
    assert found / 400 == pytest.approx(expected.power, abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("dimensions", [2, 10])
def test_the_power_predicted_from_a_pilot_is_that_of_new_experiments(dimensions):
    """Trials of 60 neurons and whole experiments on them; everything that the prediction takes is measured on them."""
    stimuli, animals, units, studies = 10, 8, 60, 150
    rng = np.random.default_rng(dimensions)
    found, effects, consistencies, reliabilities, pilots = 0, [], [], [], []
    for _ in range(studies):
        shared, other = rng.normal(size=(2, stimuli, dimensions))
        own = rng.normal(size=(animals, stimuli, dimensions))
        weights = rng.normal(size=(2, animals, dimensions, units))
        means = np.sqrt(0.8) * shared @ weights[0] + np.sqrt(0.2) * own @ weights[1]
        mixed = rng.normal(size=(2, dimensions, 300))
        model = rdm(np.sqrt(0.3) * shared @ mixed[0] + np.sqrt(0.7) * other @ mixed[1], method="sqeuclidean")
        noisy = means + 0.7 * np.sqrt(dimensions) * rng.normal(size=(2, *means.shape))
        brain = np.stack([rdm(mean, method="sqeuclidean") for mean in noisy.mean(axis=0)])
        orders = label_orders(stimuli, 0, draws=199)
        null = permuted_comparisons(model[None], brain, orders, "whitened-cosine")
        found += tail_p(np.concatenate([r.mean(axis=(1, 2)) for r in null])) <= 0.05
        true = np.stack([rdm(mean, method="sqeuclidean") for mean in means])
        effects.append(compare(model, true, method="whitened-pearson").mean())
        consistencies.append(compare_all(true, true, method="whitened-pearson")[np.triu_indices(animals, 1)].mean())
        if len(pilots) < 20:
            labels = np.repeat(np.arange(stimuli), 8)
            # The noise of their mean is that of the two halves above.
            spread = 1.4 * np.sqrt(dimensions)
            sessions = [[Trials(m[labels] + spread * rng.normal(size=(len(labels), units)), labels)] for m in means]
            pilots.append(signal_dimensions(sessions, stimuli))
            reliabilities += [get_metric("rsa").animal("m", one, stimuli, splits=20).reliability for one in sessions]
    design = ExperimentDesign(
        stimuli=stimuli,
        animals=animals,
        effect=float(np.mean(effects)),
        consistency=float(np.mean(consistencies)),
        reliability=float(np.mean(reliabilities)),
        dimensions=round(float(np.median(pilots))),
    )
    assert design.dimensions == pytest.approx(dimensions, rel=0.25)
    assert power(design, simulations=600).power == pytest.approx(found / studies, abs=0.09)


def test_fewer_dimensions_hide_an_effect():
    narrow, wide = (ExperimentDesign(stimuli=10, animals=8, effect=0.4, dimensions=d) for d in (2, 10))
    assert power(narrow, simulations=500).power < power(wide, simulations=500).power - 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stimuli": 1}, "stimuli .*at least 2"),
        ({"reliability": 1.2}, "reliability .*at most 1; received 1.2"),
        ({"alpha": 0}, "alpha .*above 0"),
        ({"dimensions": 0}, "dimensions .*at least 1; received 0"),
        ({"effect": 0.95, "consistency": 0.5}, "bounds it by √consistency = 0.707"),
    ],
)
def test_impossible_designs_are_refused_in_a_sentence(change, message):
    with pytest.raises(UsageError, match=message):
        ExperimentDesign(**change)


def test_other_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="power analysis varies 'trials'"):
        needed(ExperimentDesign(), "trials")
    with pytest.raises(UsageError, match="target power"):
        needed(ExperimentDesign(), target=1.0)
    with pytest.raises(UsageError, match=r"seed .*received -1"):
        power(ExperimentDesign(), seed=-1)
    with pytest.raises(UsageError, match=r"simulations .*at least 1"):
        power(ExperimentDesign(), simulations=0)


def test_levels_that_only_many_orders_can_reach_are_simulated_with_as_many_as_a_score_takes():
    easy = ExperimentDesign(stimuli=16, animals=10, effect=0.8, alpha=0.0008)
    assert power(easy, simulations=40).power > 0.5
    impossible = power(dataclasses.replace(easy, alpha=0.0004), simulations=40)
    assert impossible.power == 0
    assert impossible.p_smallest == pytest.approx(1 / 2000)
    assert "16 stimuli" in impossible.reason


def _animals(rng, stimuli, dimensions, *, individual=0.0, noise=1.0, animals=6, units=60, trials=8):
    shared = rng.normal(size=(stimuli, dimensions))
    labels = np.repeat(np.arange(stimuli), trials)
    for _ in range(animals):
        own = rng.normal(size=(stimuli, dimensions))
        parts = [x @ rng.normal(size=(dimensions, units)) for x in (shared, own)]
        means = np.sqrt(1 - individual) * parts[0] + np.sqrt(individual) * parts[1]
        spread = noise * np.sqrt(dimensions)
        yield [Trials(means[labels] + spread * rng.normal(size=(len(labels), units)), labels)]


@pytest.mark.parametrize("dimensions", [1, 2, 10])
def test_patterns_have_as_many_dimensions_as_they_were_made_of(dimensions):
    rng = np.random.default_rng(dimensions)
    latent = rng.normal(size=(40, 40, dimensions))
    found = np.mean([pattern_dimensions(x @ rng.normal(size=(dimensions, 500))) for x in latent])
    assert found == pytest.approx(dimensions, rel=0.15)


@pytest.mark.parametrize("individual", [0.0, 0.3])
@pytest.mark.parametrize("dimensions", [2, 10])
def test_neither_noise_nor_an_animals_own_part_adds_dimensions(dimensions, individual):
    rng = np.random.default_rng(3)
    found = [signal_dimensions(_animals(rng, 16, dimensions, individual=individual), 16) for _ in range(12)]
    assert np.median(found) == pytest.approx(dimensions, rel=0.25)


def test_time_is_averaged_and_one_animal_is_enough():
    rng = np.random.default_rng(4)
    (sessions,) = _animals(rng, 30, 2, animals=1)
    (block,) = sessions
    moving = Trials(np.stack([block.responses, block.responses], axis=1), block.labels)
    assert signal_dimensions([[moving]], 30) == pytest.approx(signal_dimensions([sessions], 30))
    assert signal_dimensions([sessions], 30) == pytest.approx(2, rel=0.4)


def test_equal_distances_have_the_most_dimensions():
    assert pattern_dimensions(np.eye(6)) == MOST


def test_what_cannot_be_estimated_is_said():
    rng = np.random.default_rng(5)
    with pytest.raises(UsageError, match="at least 3; received 2"):
        signal_dimensions(_animals(rng, 2, 2), 2)
    with pytest.raises(UsageError, match=r"received shape \(4,\)"):
        pattern_dimensions(np.ones(4))
    with pytest.raises(DataError, match="4 trials of every stimulus"):
        signal_dimensions(_animals(rng, 6, 2, trials=3), 6)
    with pytest.raises(DataError, match="do not differ"):
        pattern_dimensions(np.ones((6, 3)))
