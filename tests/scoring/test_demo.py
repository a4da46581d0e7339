from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

import brainbench
from brainbench.core.errors import UsageError
from brainbench.core.provenance import Provenance
from brainbench.datasets import open_recordings
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, read_truth
from brainbench.datasets.synthetic.populations import draw_sessions
from brainbench.datasets.trials.session_trials import trials_by_subject
from brainbench.metrics import compare, rdm
from brainbench.models.activations import extract
from brainbench.models.registry import locate_model
from brainbench.models.training.checkpoints import shipped
from brainbench.scoring.demo import DEMOS, HIDDEN_LAYER, HIDDEN_NETWORK, demo_identity, demo_recordings, hidden_features
from brainbench.scoring.neural_responses import open_neural_responses
from brainbench.stimuli import load_stimuli
from leaderboards import read_records

RESULTS = Path(__file__).parents[2] / "leaderboards" / "results"


@pytest.fixture(scope="module")
def folder():
    return demo_recordings()


@pytest.fixture(scope="module")
def dataset(folder):
    return open_recordings(folder)


@pytest.fixture(scope="module")
def stimuli():
    return load_stimuli(DEMOS["demo"])


def features_of(name, stimuli):
    found = extract(locate_model(name).build(0), stimuli.input)
    return {layer: values.mean(axis=1) for layer, values in found.items()}


def measured(dataset):
    """RDM of condition means of every animal, as nothing in the package computes it."""
    found = []
    for (block,) in trials_by_subject(dataset).values():
        means = np.stack([block.responses[block.labels == index, 0].mean(axis=0) for index in range(40)])
        found.append(rdm(means, method="sqeuclidean"))
    return np.stack(found)


def test_forty_objects_touch_several_whiskers_each(stimuli):
    touched = stimuli.dataset["contact"].any("time").sum("whisker").values
    assert len(touched) == 40
    assert touched.min() >= 5
    assert (stimuli.dataset["status"].values == "ok").all()


def test_ten_animals_felt_the_stimuli_that_their_files_name(dataset, stimuli):
    assert dataset.attrs["stimuli"] == "objects"
    assert dataset.attrs["layout"].startswith("synthetic")
    assert sorted(dataset.attrs["vocabulary"]) == sorted(stimuli.labels)
    assert dataset.attrs["synthetic"] is True
    assert dataset.attrs["missing"] == {}
    animals = trials_by_subject(dataset)
    assert len(animals) == 10
    for (block,) in animals.values():
        number = np.bincount(block.labels)
        assert (number.min(), number.max()) == (16, 20)
        assert block.responses.shape[2] == 60
        assert 3 < block.responses.mean() < 10


def test_the_truth_is_the_geometry_of_the_layer_that_it_names(folder, dataset, stimuli):
    truth = read_truth(folder)
    assert (truth["network"], truth["layer"]) == (HIDDEN_NETWORK, HIDDEN_LAYER)
    values = features_of(HIDDEN_NETWORK, stimuli)[HIDDEN_LAYER]
    wanted = rdm((values - values.mean(axis=0)) / values.std(axis=0), method="sqeuclidean")
    assert truth["labels"] == list(stimuli.labels)
    np.testing.assert_allclose(np.corrcoef(truth["shared"], wanted)[0, 1], 1.0, atol=1e-4)
    order = [truth["labels"].index(label) for label in dataset.attrs["vocabulary"]]
    square = np.zeros((40, 40))
    square[np.triu_indices(40, 1)] = truth["shared"]
    shared = (square + square.T)[np.ix_(order, order)][np.triu_indices(40, 1)]
    assert np.corrcoef(measured(dataset).mean(axis=0), shared)[0, 1] > 0.75


@pytest.mark.slow
def test_the_hidden_network_is_found_among_the_shipped_ones(dataset, stimuli):
    rows = [stimuli.labels.index(label) for label in dataset.attrs["vocabulary"]]
    brain, found = measured(dataset), {}
    for name in shipped():
        rdms = np.stack([rdm(values[rows], method="sqeuclidean") for values in features_of(name, stimuli).values()])
        values = compare(rdms[:, None], brain[None], method="whitened-cosine")
        # The layer of an animal is chosen on the others.
        chosen = [np.delete(values, animal, axis=1).mean(axis=1).argmax() for animal in range(len(brain))]
        found[name] = np.mean([values[layer, animal] for animal, layer in enumerate(chosen)])
    first, second = sorted(found, key=found.__getitem__)[:-3:-1]
    assert first == HIDDEN_NETWORK
    assert found[first] > found[second] + 0.1


def test_a_folder_of_them_is_scored_without_naming_stimuli(folder, stimuli):
    features = {"hidden": features_of(HIDDEN_NETWORK, stimuli)[HIDDEN_LAYER], "noise": np.eye(40)}
    found = brainbench.score(features, recordings=sorted(folder.glob("*.nwb"))[:2])
    assert found.layer == "hidden"
    assert found.value > 0.5
    assert found.provenance.settings["stimuli"] == "objects"


def test_stimuli_that_are_asked_for_go_first(folder, tmp_path):
    with h5py.File(tmp_path / "mine.h5", "w") as file:
        file["stimuli"] = np.zeros((2, 3, 4), np.float32)
        file["labels"] = ["left", "right"]
    two = sorted(folder.glob("*.nwb"))[:2]
    with pytest.raises(UsageError, match="'left', 'right'"):
        brainbench.score({"one": np.eye(2)}, recordings=two, stimuli=tmp_path / "mine.h5")


def test_they_are_made_once(folder):
    stamp = folder.stat().st_mtime_ns
    assert demo_recordings() == folder
    assert folder.stat().st_mtime_ns == stamp


@pytest.mark.filterwarnings("ignore:TF32 acceleration")
def test_the_same_spikes_are_drawn_on_another_processor(stimuli):
    """Other kernels and another number of threads stand for it; in single precision they give other features."""

    def single():
        network = locate_model(HIDDEN_NETWORK).build(0)
        return extract(network, stimuli.input, layers=(HIDDEN_LAYER,))[HIDDEN_LAYER].mean(axis=1)

    def counts(features):
        geometry = ResponseGeometry.from_activations(features, stimuli.labels)
        return np.concatenate([drawn.counts.ravel() for drawn in draw_sessions(geometry, PopulationDesign(), 18)])

    here, features, threads = single(), hidden_features(stimuli.input), torch.get_num_threads()
    with torch.backends.mkldnn.flags(enabled=False):
        torch.set_num_threads(3 - min(threads, 2))
        there, again = single(), hidden_features(stimuli.input)
    torch.set_num_threads(threads)
    assert not np.array_equal(here, there)
    assert np.array_equal(counts(features), counts(again))


def test_they_have_one_name_on_every_processor_that_of_the_shipped_board(folder):
    stored = next(item.record for item in read_records(RESULTS) if item.record)
    here = Provenance(recordings=open_neural_responses("demo", progress=None).origin)
    assert here.recordings_hash == stored.score.provenance.recordings_hash
    # Elsewhere a few spikes differ, and so does the hash of their content.
    there = Provenance(recordings={**here.recordings, "content_hash": "0123456789abcdef"})
    assert there.recordings_hash == here.recordings_hash


@pytest.mark.parametrize(("name", "value"), [("window", "stimulus..choice"), ("bin", 0.01), ("conditions", "outcome")])
def test_another_reading_of_them_has_another_name(folder, dataset, name, value):
    assert demo_identity(folder, dataset.attrs) != demo_identity(folder, {**dataset.attrs, name: value})


def test_recordings_of_ones_own_are_named_by_their_content(folder):
    origin = open_neural_responses(sorted(folder.glob("*.nwb"))[:2], progress=None).origin
    assert "config_hash" not in origin
    assert Provenance(recordings=origin).recordings_hash == origin["content_hash"]
