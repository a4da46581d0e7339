"""Recordings at the extremes: each has a defined outcome, in words where something is missing."""

import tracemalloc
import warnings
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import check, inspect, open_recordings, write_recordings
from brainbench.datasets.sessions import SessionTable, make_session
from brainbench.datasets.synthetic import ResponseGeometry
from brainbench.datasets.trials.session_trials import pooled, trials_by_subject
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.recordings import as_recordings, make_simple_session, quiet_design
from tests.factories.synthetic_animals import simulate


def make_geometry(stimuli):
    return ResponseGeometry.from_features(np.random.default_rng(0).normal(size=(stimuli, 8)))


def result(dataset, subject):
    """What the metrics say about an animal of a data set."""
    trials = [Trials(item.responses[:, 0], item.labels, item.keys) for item in trials_by_subject(dataset)[subject]]
    labels = dataset.attrs["vocabulary"]
    return subject_rdm(subject, trials, len(labels), stimuli=labels, splits=20)


def many(tmp_path, *, trials=12, units=3, stimuli=("a", "b", "c"), rate=5.0, **options):
    """A session of regular trials, as a file."""
    random = np.random.default_rng(0)
    start = 1.0 + np.arange(trials)
    spikes = [np.sort(random.uniform(0, trials + 2, random.poisson(rate * trials))) for _ in range(units)]
    table = {"start_time": start, "stop_time": start + 0.8, "stimulus": np.resize(np.array(stimuli), trials)}
    spans = [np.array([[0.0, trials + 2.0]])] * units
    session = make_session("m", "1", spikes, {"trials": table}, observed=spans, **options)
    return write_recordings(tmp_path / "a.h5", session)


def test_one_trial_per_stimulus_is_read_and_has_no_reliability(tmp_path):
    dataset = open_recordings(many(tmp_path, trials=3, units=20), conditions="trials:stimulus")
    assert dataset.sizes["trial"] == 3
    found = result(dataset, "m")
    assert "fewer than 2 trials" in str(found.problem)
    (item,) = [
        item for item in check(tmp_path / "a.h5", conditions="trials:stimulus").findings if "fewer" in item.message
    ]
    assert item.message == "3 labels have fewer than 2 trials: a (1), b (1), c (1)"


def test_no_spike_at_all_is_refused_with_the_number_of_units(tmp_path):
    path = many(tmp_path, rate=0.0)
    with pytest.raises(DataError, match=r"a\.h5: units: no spikes .*3"):
        open_recordings(path, conditions="trials:stimulus")
    silent = open_recordings(path, conditions="trials:stimulus", select="none")
    assert np.all(silent["counts"].values == 0)
    assert result(silent, "m").problem
    assert check(path).verdict == "error"


def test_no_spike_in_any_window_is_silence_not_an_absence(tmp_path):
    session = make_simple_session()
    outside = [np.arange(0.2, 26, 2.0)] * 3
    path = write_recordings(
        tmp_path / "a.h5", make_session("m", "1", outside, {"trials": session.tables["trials"].data})
    )
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert np.all(dataset["counts"].values == 0)
    assert result(dataset, "m").problem


def test_one_unit_is_read_and_its_correlation_rdm_is_undefined_in_words(tmp_path):
    dataset = open_recordings(many(tmp_path, units=1), conditions="trials:stimulus")
    assert dataset.sizes["unit"] == 1
    assert "unit" in str(result(dataset, "m").problem)


def test_two_stimuli_are_read_and_one_pair_cannot_be_compared():
    dataset = as_recordings(make_geometry(2), quiet_design(animals=2, units=10, trials=6))
    assert dataset.attrs["vocabulary"] == ["s1", "s2"]
    assert result(dataset, "synthetic01").problem


def test_five_hundred_stimuli_keep_their_order_and_are_proposed(tmp_path):
    names = [f"image-{index}" for index in np.random.default_rng(0).permutation(500)]
    path = many(tmp_path, trials=1000, units=4, stimuli=names)
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert dataset.attrs["vocabulary"] == [f"image-{index}" for index in range(500)]
    (proposal,) = inspect(path).proposals
    assert (len(proposal.labels), proposal.fewest) == (500, 2)
    geometry = make_geometry(500)
    assert geometry.rdm.shape == (124_750,)
    (animal,) = simulate(geometry, quiet_design(animals=1, units=10, trials=2))
    assert animal.truth.shape == (124_750,)


def many_units(tmp_path, units):
    trials = 12
    random = np.random.default_rng(0)
    counts = random.poisson(4.0, units)
    times = random.uniform(0, trials + 2, counts.sum())
    data = {
        "id": np.arange(units),
        "spike_times": times[np.lexsort((times, np.repeat(np.arange(units), counts)))],
        "spike_times_index": np.cumsum(counts),
    }
    session = replace(make_simple_session(trials=trials), units=SessionTable("units", data))
    return write_recordings(tmp_path / "a.h5", session), counts


def test_five_thousand_units_are_read_and_checked(tmp_path):
    path, counts = many_units(tmp_path, 5_000)
    dataset = open_recordings(path, conditions="trials:stimulus", window="start..+0.5")
    silent = int(np.sum(counts == 0))
    assert dataset.attrs["removed"]["units: no spikes"] == silent
    assert dataset.sizes["unit"] == 5_000 - silent
    assert f"{silent} of 5000 (2 %) units" in str(check(path))


@pytest.mark.slow
def test_a_hundred_thousand_units_need_little_memory(tmp_path):
    path, _ = many_units(tmp_path, 100_000)
    tracemalloc.start()
    open_recordings(path, conditions="trials:stimulus", window="start..+0.5")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Counts are 12 × 100,000 × 4 bytes = 5 MB; spike times 3 MB.
    assert peak < 250e6


def test_an_animal_that_lacks_a_stimulus_is_kept_and_undefined_in_words():
    design = quiet_design(animals=3, units=12, trials=6, missing=((1, 3),))
    dataset = as_recordings(make_geometry(6), design)
    assert dataset.attrs["missing"] == {"synthetic02": ["s4"]}
    assert result(dataset, "synthetic01").problem is None
    assert "s4" in str(result(dataset, "synthetic02").problem)
    # Pooled with the others, only its session lacks the stimulus.
    assert pooled(dataset, "all").attrs["missing"] == {}


def test_a_single_animal_with_a_single_session_goes_through():
    found = result(as_recordings(make_geometry(6), quiet_design(animals=1, units=15, trials=8)), "synthetic01")
    assert found.problem is None
    assert 0 < found.reliability <= 1


def test_a_bin_wider_than_every_window_is_a_slip_and_a_tiny_one_makes_many(tmp_path):
    path = many(tmp_path)
    with pytest.raises(UsageError, match=r"bin of 100 s is longer than every window \(up to 0\.8 s\)"):
        open_recordings(path, conditions="trials:stimulus", bin=100.0)
    assert open_recordings(path, conditions="trials:stimulus", bin=0.8).sizes["time"] == 1
    fine = open_recordings(path, conditions="trials:stimulus", bin=1e-4)
    assert fine.sizes["time"] == 8000
    assert np.nanmax(fine["counts"].values) <= 2


def test_absurd_rates_are_counted_and_flagged(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = many(tmp_path, rate=20_000.0, units=1)
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert dataset["counts"].values.mean() == pytest.approx(0.8 * 20_000 * 12 / 14, rel=0.05)
    assert any(item.check == "refractory" and item.severity == "error" for item in check(path).findings)
