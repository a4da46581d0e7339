"""A score depends on what files say, not on how HDF5 stores it."""

import h5py
import numpy as np
import pytest

from brainbench.core.reading.hdf5 import LINKED_VARIABLE
from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.scores import score_record
from brainbench.stimuli.sources import load_stimuli
from tests.factories.storages import STORAGES, store_again

LABELS = [*"abcdef"]


def _write(folder):
    """Write recordings of two animals, activations and arrays for six conditions."""
    rng = np.random.default_rng(0)
    start, label = 1.0 + np.arange(48), np.arange(48) % 6
    sessions = []
    for animal in "xy":
        spikes = [
            np.concatenate(
                [
                    t + np.linspace(0, 0.4, rng.poisson(2 + 2 * ((k + unit) % 3)))
                    for t, k in zip(start, label, strict=True)
                ]
            )
            for unit in range(6)
        ]
        table = {"start_time": start, "stop_time": start + 0.5, "stimulus": np.array(LABELS)[label]}
        sessions.append(make_session(animal, "1", spikes, {"trials": table}))
    recordings = write_recordings(folder / "recordings.h5", sessions)
    features = write_features(
        folder / "features.h5", LABELS, {"b": rng.normal(size=(6, 9)), "a": rng.normal(size=(6, 4))}
    )
    with h5py.File(folder / "arrays.h5", "w") as file:
        file["stimuli"] = rng.normal(size=(6, 10, 4)).astype(np.float32)
        file["labels"] = np.array(LABELS, dtype=h5py.string_dtype())
    return recordings, features, folder / "arrays.h5"


def _read(recordings, features, arrays):
    options = {"recordings": str(recordings), "conditions": "trials:stimulus", "window": "start..stop"}
    record = score_record(str(features), baselines=False, **options)
    stimuli = load_stimuli(arrays)
    return (
        record.score.value,
        record.score.layer,
        record.score.provenance["recordings"]["content_hash"],
        stimuli.content_hash,
    )


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    files = _write(tmp_path_factory.mktemp("originals"))
    return files, _read(*files)


def test_there_are_seventeen_storages():
    assert len(STORAGES) == 17


@pytest.mark.parametrize("storage", STORAGES)
def test_one_content_gives_one_score_and_one_hash(originals, tmp_path, monkeypatch, storage):
    monkeypatch.setenv(LINKED_VARIABLE, str(tmp_path))
    files, expected = originals
    assert _read(*(store_again(path, tmp_path / path.name, storage) for path in files)) == expected
