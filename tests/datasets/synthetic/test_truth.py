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
    measure_ceiling,
    read_truth,
    write_files,
)
from brainbench.datasets.synthetic.truth import stimulus_means
from brainbench.datasets.trials.session_trials import trials_by_subject
from brainbench.metrics import noise_ceiling, rdm
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.recordings import as_recordings, make_sessions, quiet_design
from tests.factories.synthetic_animals import FAULTS, simulate

SMALL = quiet_design(animals=3, sessions=2, units=12, trials=5)


def make_geometry(seed=0, stimuli=6, features=4):
    return ResponseGeometry.from_features(np.random.default_rng(seed).normal(size=(stimuli, features)))


def measured(animals, stimuli=6):
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
    lower, upper = noise_ceiling(measured(simulate(geometry, replace(design, animals=100), seed=9)))
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
        rdms = measured(simulate(geometry, replace(design, trials=(6, 14)), faults=faults))
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
    np.testing.assert_allclose(found.rdm, measured([animal])[0])
    assert found.reliability > 0.8
