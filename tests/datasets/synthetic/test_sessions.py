from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.datasets import open_recordings
from brainbench.datasets.synthetic import (
    ResponseGeometry,
    read_truth,
    write_files,
)
from brainbench.datasets.synthetic.truth import stimulus_means
from brainbench.metrics import rdm
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.recordings import as_recordings, make_sessions, quiet_design
from tests.factories.synthetic_animals import simulate

SMALL = quiet_design(animals=3, sessions=2, units=12, trials=5)


def make_geometry(seed=0, stimuli=6, features=4):
    return ResponseGeometry.from_features(np.random.default_rng(seed).normal(size=(stimuli, features)))


def measured(animals, stimuli=6):
    means = [np.concatenate([stimulus_means(block, stimuli) for block in item.sessions], axis=1) for item in animals]
    return np.stack([rdm(item) for item in means])


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
