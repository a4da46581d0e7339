import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, draw_animals
from brainbench.metrics import compare, rdm


def make_features(seed=0, stimuli=12, features=30):
    random = np.random.default_rng(seed)
    return random.normal(size=(stimuli, 5)) @ random.normal(size=(5, features)) * random.uniform(0.1, 9, features) + 3


def standardised(values):
    return (values - values.mean(axis=0)) / values.std(axis=0)


def measured(sessions, stimuli=12):
    rates = [[block.responses[block.labels == k, 0].mean(axis=0) for k in range(stimuli)] for block in sessions]
    return rdm(np.concatenate(rates, axis=1), method="sqeuclidean")


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
