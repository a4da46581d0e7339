from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets.synthetic import (
    PopulationDesign,
    ResponseGeometry,
    draw_animals,
)
from brainbench.datasets.synthetic.truth import stimulus_means
from brainbench.metrics import compare, rdm
from tests.factories.recordings import as_recordings, quiet_design
from tests.factories.synthetic_animals import simulate


def make_features(seed=0, stimuli=12, features=30):
    random = np.random.default_rng(seed)
    return random.normal(size=(stimuli, 5)) @ random.normal(size=(5, features)) * random.uniform(0.1, 9, features) + 3


def standardised(values):
    return (values - values.mean(axis=0)) / values.std(axis=0)


def measured(sessions, stimuli=12):
    rates = [[block.responses[block.labels == k, 0].mean(axis=0) for k in range(stimuli)] for block in sessions]
    return rdm(np.concatenate(rates, axis=1), method="sqeuclidean")


def measured_of_animals(animals, stimuli=6):
    means = [np.concatenate([stimulus_means(block, stimuli) for block in item.sessions], axis=1) for item in animals]
    return np.stack([rdm(item) for item in means])


def test_the_truth_of_activations_is_their_standardised_euclidean_distance():
    values = make_features()
    values[:, 3] = 7.0
    found = ResponseGeometry.from_activations(values).rdm
    wanted = rdm(standardised(np.delete(values, 3, axis=1)), method="sqeuclidean")
    assert np.corrcoef(found, wanted)[0, 1] == pytest.approx(1.0)
    # Mean squared length one: the mean over all ordered pairs of half the squared distance is the variance.
    assert found.sum() * 2 / 12**2 == pytest.approx(1.0)


def test_many_units_show_the_geometry_of_the_features():
    design = PopulationDesign(animals=1, units=3000, emphasis=0.0)
    (sessions,) = draw_animals(make_features(), design).values()
    truth = ResponseGeometry.from_activations(make_features()).rdm
    assert np.corrcoef(measured(sessions), truth)[0, 1] > 0.97


def test_animals_that_emphasise_other_axes_agree_less():
    def agreement(emphasis):
        design = PopulationDesign(animals=6, units=1000, emphasis=emphasis)
        rdms = [measured(sessions) for sessions in draw_animals(make_features(), design).values()]
        return np.corrcoef(rdms)[np.triu_indices(6, 1)].mean()

    assert agreement(0.0) > 0.9
    assert 0.3 < agreement(0.8) < agreement(0.0) - 0.1


def test_the_default_design_has_unequal_trials_and_rates_of_a_few_hertz():
    animals = draw_animals(make_features(), seed=2)
    assert list(animals)[:2] == ["synthetic01", "synthetic02"]
    assert len(animals) == 10
    for (block,) in animals.values():
        number = np.bincount(block.labels)
        assert (number.min(), number.max()) >= (16, 17)
        assert number.max() <= 20
        assert block.responses.shape == (number.sum(), 1, 60)
        assert 3 < block.responses.mean() < 10


def test_a_seed_gives_the_same_animals_and_a_larger_design_begins_with_them():
    few = draw_animals(make_features(), PopulationDesign(animals=2), seed=4)
    many = draw_animals(make_features(), PopulationDesign(animals=4), seed=4)
    other = draw_animals(make_features(), PopulationDesign(animals=2), seed=5)
    for name, (block,) in few.items():
        np.testing.assert_array_equal(block.responses, many[name][0].responses)
        assert (
            block.responses.shape != other[name][0].responses.shape
            or (block.responses != other[name][0].responses).any()
        )


def test_animals_resemble_the_network_that_made_them_more_than_others():
    candidates = [rdm(standardised(make_features(seed)), method="sqeuclidean") for seed in range(4)]
    rdms = [measured(sessions) for sessions in draw_animals(make_features(2), seed=1).values()]
    scores = [np.mean([compare(item, one, method="cosine") for one in rdms]) for item in candidates]
    assert np.argmax(scores) == 2


@pytest.mark.parametrize(
    ("features", "error", "culprit"),
    [
        (np.ones((5, 3)), DataError, "Every feature is the same"),
        (np.full((5, 3), np.nan), DataError, "15 feature values"),
        (np.ones(5), UsageError, r"received shape \(5,\)"),
        (np.ones((1, 5)), UsageError, r"received shape \(1, 5\)"),
    ],
)
def test_features_that_cannot_be_mixed_are_refused(features, error, culprit):
    with pytest.raises(error, match=culprit):
        draw_animals(features)


@pytest.mark.parametrize("trials", [0, (0, 5), (7, 3)])
def test_impossible_numbers_of_trials_are_refused(trials):
    with pytest.raises(UsageError, match="trials"):
        PopulationDesign(trials=trials)


@pytest.mark.parametrize("seed", [-1, 0.5, "a", (0, -1)])
def test_a_seed_is_one_or_several_whole_numbers(seed):
    with pytest.raises(UsageError, match="A seed"):
        draw_animals(make_features(), PopulationDesign(animals=1, units=2, trials=2), seed=seed)


SMALL = quiet_design(animals=3, sessions=2, units=12, trials=5)


def make_geometry(seed=0, stimuli=6, features=4):
    return ResponseGeometry.from_features(np.random.default_rng(seed).normal(size=(stimuli, features)))


def pearson(one, two):
    return float(np.corrcoef(one, two)[0, 1])


# Counts


def test_poisson_counts_have_a_variance_equal_to_the_mean():
    design = quiet_design(animals=1, units=200, trials=400, spread=0.0, modulation=0.0, rate=6.0)
    (animal,) = simulate(make_geometry(), design)
    counts = animal.sessions[0].responses[:, 0]
    assert counts.mean() == pytest.approx(6.0, rel=0.01)
    assert counts.var(axis=0).mean() == pytest.approx(6.0, rel=0.02)


def test_dispersion_is_that_of_the_negative_binomial():
    design = quiet_design(animals=1, units=200, trials=400, spread=0.0, modulation=0.0, rate=6.0, dispersion=0.25)
    counts = simulate(make_geometry(), design)[0].sessions[0].responses[:, 0]
    assert counts.mean() == pytest.approx(6.0, rel=0.01)
    assert counts.var(axis=0).mean() == pytest.approx(6.0 + 0.25 * 36.0, rel=0.03)


def test_a_shared_gain_correlates_units_and_nothing_else_does():
    design = quiet_design(animals=1, units=60, trials=500, spread=0.0, modulation=0.0, rate=10.0)

    def correlation(**change):
        counts = simulate(make_geometry(), replace(design, **change))[0].sessions[0].responses[:, 0]
        return np.corrcoef(counts.T)[np.triu_indices(60, 1)].mean()

    assert abs(correlation()) < 0.005
    # Covariance of units: rate² var(gain); variance: rate + rate² var(gain).
    assert correlation(shared_gain=0.3) == pytest.approx(9 / 19, abs=0.03)


def test_session_effects_change_rates_as_stated():
    design = quiet_design(animals=1, units=300, trials=100, rate=10.0, drift=0.5)
    (animal,) = simulate(make_geometry(), design)
    rates = animal.sessions[0].responses.mean(axis=(1, 2))
    slope = np.polyfit(np.linspace(-0.5, 0.5, len(rates)), rates / rates.mean(), 1)[0]
    assert slope == pytest.approx(0.5, abs=0.02)
    gains = [
        np.log(item.sessions[0].responses.mean())
        for item in simulate(make_geometry(), quiet_design(animals=150, trials=2, session_gain=0.4, spread=0.0))
    ]
    assert np.std(gains) == pytest.approx(0.4, rel=0.15)


def test_trials_can_be_unbalanced_and_stimuli_missing():
    design = replace(SMALL, trials=(4, 20), missing=((1, 2), (1, 4)))
    animals = simulate(make_geometry(), design)
    number = np.array([[np.bincount(block.labels, minlength=6) for block in item.sessions] for item in animals])
    assert (number[1][:, [2, 4]] == 0).all()
    assert (np.delete(number.reshape(6, 6), [2, 3], axis=0) > 0).all()
    assert number[0].std() > 2
    # An RDM of an animal that lacks a stimulus has no value for its pairs.
    assert np.isnan(measured_of_animals(animals)[1]).sum() == 9
    assert as_recordings(make_geometry(), design).attrs["missing"] == {"synthetic02": ["s3", "s5"]}


def test_animals_do_not_depend_on_how_many_there_are():
    few, many = (simulate(make_geometry(), replace(SMALL, animals=number), seed=4) for number in (2, 5))
    for one, two in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.sessions[1].responses, two.sessions[1].responses)
    other = simulate(make_geometry(), SMALL, seed=5)
    assert not np.array_equal(few[0].sessions[0].responses, other[0].sessions[0].responses)


# Truth


def test_with_many_units_the_noiseless_rdm_is_the_geometry():
    geometry = make_geometry(3)
    (animal,) = simulate(geometry, quiet_design(animals=1, units=20_000, trials=1, modulation=0.4))
    assert pearson(animal.truth, geometry.rdm) > 0.995
    lines = np.polyfit(geometry.rdm, animal.truth, 1)
    # Proportional: with mean rates that differ (log-normal s), the factor is m² E b² / (var b + m² E b²).
    spread = np.exp(0.4**2) - 1
    assert lines[0] == pytest.approx(0.16 * (1 + spread) / (spread + 0.16 * (1 + spread)), rel=0.06)
    assert abs(lines[1]) < 0.03


def test_individual_geometry_bounds_what_animals_share():
    geometry = make_geometry()
    design = quiet_design(animals=40, units=400, trials=1)
    shared, half, none = (
        np.mean([pearson(item.truth, geometry.rdm) for item in simulate(geometry, replace(design, individual=share))])
        for share in (0.0, 0.5, 1.0)
    )
    assert shared > 0.95
    assert 0.4 < half < 0.9
    # One geometry for the animal, not one per session.
    (two,) = simulate(geometry, quiet_design(animals=1, sessions=2, units=5000, trials=1, individual=1.0))
    assert (
        pearson(
            *measured_of_animals([replace(two, sessions=two.sessions[:1]), replace(two, sessions=two.sessions[1:])])
        )
        > 0.5
    )
    assert abs(none) < 0.2
