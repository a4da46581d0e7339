from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings
from brainbench.datasets.synthetic import (
    PopulationDesign,
    ResponseGeometry,
    calibrate,
    draw_animals,
    measure_ceiling,
    read_truth,
    write_files,
)
from brainbench.datasets.synthetic.populations import stimulus_means
from brainbench.datasets.trials.session_trials import trials_by_subject
from brainbench.metrics import compare, noise_ceiling, rdm
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.recordings import as_recordings, make_sessions, quiet_design
from tests.factories.synthetic_animals import FAULTS, simulate


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


def rdms_of(animals, stimuli=6):
    means = [np.concatenate([stimulus_means(block, stimuli) for block in item.sessions], axis=1) for item in animals]
    return np.stack([rdm(item) for item in means])


# Geometry


@settings(max_examples=25)
@given(seed=st.integers(0, 2**16), stimuli=st.integers(2, 12), features=st.integers(3, 40))
def test_the_truth_of_features_is_their_correlation_distance(seed, stimuli, features):
    values = np.random.default_rng(seed).normal(size=(stimuli, features)) + 5.0
    geometry = ResponseGeometry.from_features(values)
    np.testing.assert_allclose(geometry.rdm, rdm(values), atol=1e-9)
    assert geometry.directions.shape[1] <= max(stimuli, 2) or features <= stimuli


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: ResponseGeometry.from_features(np.zeros(3)), UsageError, r"at least 2 × 2; received shape \(3,\)"),
        (lambda: ResponseGeometry.from_features([[1, 2], [3, 3]]), DataError, "stimulus 1 are constant"),
        (lambda: ResponseGeometry.from_features([[1, 2], [3, np.nan]]), DataError, "1 feature values are not finite"),
        (
            lambda: ResponseGeometry.from_features(np.eye(3), ["a", "b", "b"]),
            UsageError,
            "3 stimuli need as many different",
        ),
        (lambda: PopulationDesign(units=0), UsageError, "units .*at least 1; received 0"),
        (lambda: PopulationDesign(rate=0.0), UsageError, r"rate .*received 0"),
        (lambda: PopulationDesign(dispersion=-1.0), UsageError, r"dispersion .*received -1"),
        (lambda: PopulationDesign(modulation=0.9), UsageError, r"modulation .*0\.4; received 0\.9"),
        (lambda: PopulationDesign(individual=2.0), UsageError, r"individual .*received 2"),
        (lambda: simulate(make_geometry(), replace(SMALL, missing=((0, 6),))), UsageError, "numbered 0 to 5"),
    ],
)
def test_wrong_requests_say_what_is_allowed(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_calibrated_design_has_the_ceiling_that_was_asked_for():
    geometry, wanted = make_geometry(1), 0.7
    design = calibrate(geometry, quiet_design(animals=11, units=20, trials=10), ceiling=wanted, simulations=12)
    reached, error = measure_ceiling(geometry, design, simulations=36, seed=77)
    # Both the calibration (on 12 studies) and this measurement (on 36) have a Monte-Carlo error.
    assert abs(reached - wanted) < 3 * error * np.sqrt(1 + 36 / 12)
    assert error < 0.02
    # What scoring calls the noise ceiling brackets it when there are many animals.
    lower, upper = noise_ceiling(rdms_of(simulate(geometry, replace(design, animals=100), seed=9)))
    assert lower - 0.05 < wanted < upper + 0.05
    assert upper - lower < 0.06


NOISY = {"dispersion": 0.2, "shared_gain": 0.15, "sessions": 2, "trials": (8, 22)}


@pytest.mark.slow
@pytest.mark.parametrize(("wanted", "noise"), [(0.3, {}), (0.6, {}), (0.9, {}), (0.6, NOISY)])
def test_calibration_is_exact_within_its_monte_carlo_error(wanted, noise):
    geometry = make_geometry(2)
    design = calibrate(
        geometry, quiet_design(animals=11, units=60, **{"trials": 15, **noise}), ceiling=wanted, simulations=60
    )
    reached, error = measure_ceiling(geometry, design, simulations=180, seed=77)
    assert error < 0.01
    assert abs(reached - wanted) < 3 * error * np.sqrt(1 + 180 / 60)


def test_a_ceiling_out_of_reach_says_what_is_reached():
    with pytest.raises(UsageError, match=r"0\.99 .* up to 0\.[0-8]"):
        calibrate(make_geometry(), quiet_design(animals=5, units=5, trials=1, rate=1.0), ceiling=0.99, simulations=5)


def test_an_undefined_ceiling_is_no_number():
    assert np.isnan(measure_ceiling(make_geometry(stimuli=2), quiet_design(animals=2), simulations=1)[0])
    everywhere = tuple((animal, 0) for animal in range(2))
    assert np.isnan(measure_ceiling(make_geometry(), quiet_design(animals=2, missing=everywhere), simulations=1)[0])


# Faults


def test_the_released_faults_cost_agreement_between_animals():
    geometry = make_geometry(5)
    design = quiet_design(animals=11, sessions=3, units=40, trials=10)

    def agreement(*faults):
        rdms = rdms_of(simulate(geometry, replace(design, trials=(6, 14)), faults=faults))
        return noise_ceiling(rdms).lower

    clean, filled, ordered, both = (
        agreement(*faults) for faults in ((), ("zero-fill",), ("first-appearance",), tuple(FAULTS))
    )
    assert clean > 0.8
    assert filled < clean
    assert ordered < 0.4
    assert both < 0.4


def test_zero_fill_answers_every_stimulus_on_every_trial():
    plain, filled = (simulate(make_geometry(), SMALL, faults=faults)[0].sessions[0] for faults in ((), ("zero-fill",)))
    assert len(filled.labels) == 6 * len(plain.labels)
    assert filled.responses.sum() == plain.responses.sum()
    # Balanced trials of one session: all means shrink alike, six-fold.
    np.testing.assert_allclose(6 * stimulus_means(filled, 6), stimulus_means(plain, 6))
    assert len(set(filled.keys)) == len(filled.keys)


def test_first_appearance_renumbers_each_session_by_itself():
    (plain,), (numbered,) = (
        simulate(make_geometry(), replace(SMALL, animals=1), faults=faults) for faults in ((), ("first-appearance",))
    )
    for one, two in zip(plain.sessions, numbered.sessions, strict=True):
        assert list(dict.fromkeys(two.labels.tolist())) == list(range(6))
        order = np.array(list(dict.fromkeys(one.labels.tolist())))
        np.testing.assert_array_equal(order[two.labels], one.labels)


# Data sets and files


def test_a_data_set_holds_the_counts_of_the_arrays():
    geometry = make_geometry()
    found = trials_by_subject(as_recordings(geometry, SMALL, seed=3))
    for animal in simulate(geometry, SMALL, seed=3):
        for one, two in zip(animal.sessions, found[animal.subject], strict=True):
            np.testing.assert_array_equal(one.responses, two.responses)
            np.testing.assert_array_equal(one.labels, two.labels)
            assert one.keys == two.keys


@pytest.mark.parametrize(
    ("ask", "told"),
    [
        (lambda geometry, design: measure_ceiling(geometry, design, simulations=0), "simulations .*0"),
        (lambda geometry, design: measure_ceiling(geometry, design, simulations=1.5), r"simulations .*1\.5"),
        (lambda geometry, design: calibrate(geometry, design, ceiling=np.nan), "ceiling .*nan"),
        (lambda geometry, design: calibrate(geometry, design, ceiling=90), "ceiling .*received 90"),
        (lambda geometry, design: ResponseGeometry.from_features([[1j, 2], [3, 4]]), "real numbers"),
    ],
)
def test_ceilings_and_features_that_are_none_are_refused_before_anything_is_drawn(ask, told):
    with pytest.raises(UsageError, match=told):
        ask(ResponseGeometry.from_features(np.eye(3)), PopulationDesign(animals=1, units=2))


@pytest.mark.parametrize("format", ["nwb", "h5"])
def test_files_give_the_same_counts_as_arrays(tmp_path, format):
    geometry = make_geometry()
    design = replace(SMALL, animals=2, dispersion=0.3, missing=((0, 1),))
    paths = write_files(tmp_path, geometry, design, seed=3, format=format)
    assert len(paths) == 4
    dataset = open_recordings(tmp_path, conditions="trials:stimulus", window="first-contact..choice")
    expected = as_recordings(geometry, design, seed=3)
    xr.testing.assert_equal(dataset["counts"].drop_vars(dataset.coords), expected["counts"].drop_vars(expected.coords))
    assert dataset.attrs["vocabulary"] == list(geometry.labels)
    assert dataset.attrs["synthetic"] is True
    truth = read_truth(tmp_path)
    np.testing.assert_allclose(truth["shared"], geometry.rdm)
    for animal in simulate(geometry, design, seed=3):
        np.testing.assert_allclose(truth["subjects"][animal.subject], animal.truth)


@pytest.mark.filterwarnings("ignore")
def test_files_are_valid_for_pynwb(tmp_path):
    pynwb = pytest.importorskip("pynwb")
    (path,) = write_files(tmp_path, make_geometry(), replace(SMALL, animals=1, sessions=1))
    assert list(pynwb.validate(path=str(path))) == []


def test_an_unknown_format_suggests_the_nearest(tmp_path):
    with pytest.raises(UsageError, match="'nbw'; did you mean 'nwb'"):
        write_files(tmp_path, make_geometry(), SMALL, format="nbw")


def test_no_unit_fires_within_its_refractory_time():
    for session in make_sessions(make_geometry(), quiet_design(animals=1, units=10, rate=60.0, window=0.4)):
        units = session.units.data
        for times in np.split(units["spike_times"], units["spike_times_index"][:-1]):
            assert np.diff(times).min() > 0.00199


def test_trial_blocks_take_simulated_sessions_as_they_are():
    animal = simulate(make_geometry(), quiet_design(animals=1))[0]
    trials = [Trials(block.responses[:, 0], block.labels, block.keys) for block in animal.sessions]
    found = subject_rdm(animal.subject, trials, 6, splits=50)
    np.testing.assert_allclose(found.rdm, rdms_of([animal])[0])
    assert found.reliability > 0.8
