import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.datasets import blocks, open_recordings, write_recordings
from tests.factories.recordings import make_simple_session


def make_dataset(folder, **options):
    sessions = [
        make_simple_session(subject="m1", session="1", seed=1, observed=options.get("observed")),
        make_simple_session(subject="m1", session="2", units=5, seed=2),
        make_simple_session(subject="m2", session="1", units=2, seed=3),
    ]
    path = write_recordings(folder / "a.h5", sessions)
    return open_recordings(path, conditions="trials:stimulus", bin=options.get("bin"))


def test_each_session_is_one_block_of_rates(tmp_path):
    dataset = make_dataset(tmp_path, bin=0.4)
    found = blocks(dataset)
    assert [(name, [block.responses.shape for block in items]) for name, items in found.items()] == [
        ("m1", [(12, 3, 3), (12, 3, 5)]),
        ("m2", [(12, 3, 2)]),
    ]
    block = found["m1"][1]
    counts, duration = dataset["counts"].values[12:24, :, 3:8], dataset["duration"].values[12:24]
    np.testing.assert_allclose(block.responses, counts / duration[..., None])
    labels = [dataset.attrs["vocabulary"][index] for index in block.labels]
    assert labels == dataset["stimulus"].values[12:24].tolist()


def test_a_session_holds_one_response_label_and_key_per_trial(tmp_path):
    trials = blocks(make_dataset(tmp_path))["m2"][0]
    assert len(trials.responses) == len(trials.labels) == len(set(trials.keys)) == 12
    assert trials.keys[0] == "m2/1/5"


def test_trials_are_taken_with_all_that_belongs_to_them(tmp_path):
    trials = blocks(make_dataset(tmp_path))["m2"][0]
    some = trials.take(trials.labels > 0)
    assert some.keys == tuple(key for key, label in zip(trials.keys, trials.labels, strict=True) if label)
    np.testing.assert_array_equal(some.responses, trials.responses[trials.labels > 0])
    np.testing.assert_array_equal(trials.take([3, 1]).labels, trials.labels[[3, 1]])


def test_units_lost_in_some_trials_stay_missing_there(tmp_path):
    observed = [[[0, 100]], [[0, 10.5]], [[0, 100]]]
    responses = blocks(make_dataset(tmp_path, observed=observed))["m1"][0].responses[:, 0]
    assert np.isnan(responses[:, 1]).sum() == 7
    assert np.isfinite(responses[:, [0, 2]]).all()


def test_other_data_sets_are_refused():
    import xarray as xr

    with pytest.raises(DataError, match="needs the variable 'counts'"):
        blocks(xr.Dataset())
