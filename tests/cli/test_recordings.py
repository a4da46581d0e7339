"""``brainbench recordings check | export | fetch`` and pooling, from the command line."""

import json

import numpy as np
import pytest
import rsatoolbox

from brainbench.datasets import read_rdms, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.synthetic import ResponseGeometry, write_files
from brainbench.metrics import compare, get_metric, rdm
from brainbench.models.features import read_features, write_features
from brainbench.scoring.neural_responses import open_neural_responses
from brainbench.scoring.options import ScoreOptions
from tests.factories.published_files import make_zero_filled, write_published
from tests.factories.recordings import quiet_design


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("synthetic")
    geometry = ResponseGeometry.from_features(np.random.default_rng(0).normal(size=(6, 4)))
    write_files(folder, geometry, quiet_design(animals=2, sessions=2, units=15, trials=12))
    return folder


def test_check_passes_good_recordings_and_says_why(run, folder):
    result = run("recordings", "check", str(folder), "--conditions", "trials:stimulus", "--strict")
    assert result.status == 0
    assert result.out.startswith(f"{folder}: 4 sessions, 0 errors, 0 warnings, 4 notes")
    assert "spikes answer touch (first-contact) within 5 to 30 ms" in result.out


def test_check_fails_on_errors_and_lists_them_as_json(run, folder, tmp_path):
    (tmp_path / "broken.nwb").write_bytes(b"")
    result = run("recordings", "check", str(tmp_path), "--json")
    assert result.status == 1
    data = json.loads(result.out)
    assert data["verdict"] == "error"
    assert data["findings"][0]["check"] == "file"
    assert "it is empty" in data["findings"][0]["message"]
    assert run("recordings", "check", str(tmp_path / "nothing.nwb")).status == 2


def test_a_copy_scores_the_same(run, folder, tmp_path):
    options = ("--conditions", "trials:stimulus", "--window", "first-contact..choice", "--json")
    result = run("recordings", "export", str(folder), str(tmp_path / "copy"))
    assert result.status == 0
    assert result.out.count(".nwb") == 4
    one, two = (json.loads(run("recordings", "rdm", str(path), *options).out) for path in (folder, tmp_path / "copy"))
    assert one["animals"] == two["animals"]
    assert one["recordings"]["content_hash"] == two["recordings"]["content_hash"]


@pytest.mark.parametrize(("pool", "names"), [("session", 4), ("all", 1)])
def test_sessions_and_animals_are_pooled_on_request(run, folder, pool, names):
    result = run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--pool", pool, "--json")
    assert len(json.loads(result.out)["animals"]) == names
    assert run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--pool", "al").status == 2


def test_a_session_that_an_rdm_leaves_out_is_named(run, tmp_path):
    for name, labels in (("1", "abc"), ("2", "ab")):
        table = {"start_time": np.arange(1.0, 31), "stop_time": np.arange(1.5, 31), "stimulus": [*labels * 15][:30]}
        spikes = [np.sort(np.random.default_rng([unit, *name.encode()]).uniform(0, 32, 900)) for unit in range(9)]
        write_recordings(tmp_path / f"{name}.h5", make_session("m", name, spikes, {"trials": table}))
    given = ("recordings", "rdm", str(tmp_path), "--conditions", "trials:stimulus")
    assert "1 of 2 sessions left out: fewer than 2 trials of c (0)" in " ".join(run(*given).out.split())
    (animal,) = json.loads(run(*given, "--json").out)["animals"]
    assert (animal["units"], len(animal["notes"])) == (9, 1)


def test_json_of_rdms_says_all_that_the_table_says(run, tmp_path):
    random = np.random.default_rng(0)
    start = np.sort(random.uniform(1, 40, 60))  # windows of half a second that overlap
    table = {"start_time": start, "stop_time": start + 0.5, "stimulus": [*"abcd" * 15]}
    spikes = [np.sort(random.uniform(0, 42, 900)) for _ in range(9)]
    write_recordings(tmp_path / "m.h5", make_session("m", "1", spikes, {"trials": table}))
    given = ("recordings", "rdm", str(tmp_path), "--conditions", "trials:stimulus")
    text, data = run(*given).out, json.loads(run(*given, "--json").out)
    title, _, row, *rest = text.splitlines()
    assert title == f"{data['conditions']}, {data['window']}; RDM: {data['distance']} distance"
    assert row.endswith(data["animals"][0]["verdict"])
    assert "unreliable" in row
    assert data["doubts"]
    assert [line for line in rest if line.startswith("Note: ")] == [f"Note: {doubt}." for doubt in data["doubts"]]


def test_the_reliability_of_scores_is_shown_before_scoring(run, folder):
    result = run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--metric", "rsa", "--json")
    ours = [animal["reliability"] for animal in json.loads(result.out)["animals"]]
    brain = open_neural_responses(folder, progress=None, conditions="trials:stimulus")
    animals = brain.animals(brain.vocabulary, get_metric("rsa"), ScoreOptions())
    assert ours == [animal.reliability for animal in animals]
    refused = run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--metric", "cka")
    assert refused.status == 2
    assert "'cka'" in refused.err


@pytest.fixture
def rdms(run, folder, tmp_path):
    """RDMs of the animals, as the command writes them, and a model's features."""
    run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--out", str(tmp_path / "rdms.h5"))
    layers = {name: np.random.default_rng(seed).normal(size=(6, 5)) for seed, name in enumerate(("first", "second"))}
    write_features(tmp_path / "model.h5", read_rdms(tmp_path / "rdms.h5").stimuli[::-1], layers)
    return tmp_path


def test_rdms_are_written_for_rsatoolbox_and_shown_from_its_files(run, folder, rdms):
    animals = json.loads(run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--json").out)
    theirs = rsatoolbox.rdm.load_rdm(str(rdms / "rdms.h5"))
    np.testing.assert_array_equal(theirs.dissimilarities, [animal["rdm"] for animal in animals["animals"]])
    assert theirs.descriptors["content_hash"] == animals["recordings"]["content_hash"]
    assert str(folder.parent) not in str(theirs.descriptors)
    assert "noise cannot be estimated" in run("recordings", "inspect", str(rdms / "rdms.h5")).out
    shown = run("recordings", "rdm", str(rdms / "rdms.h5")).out
    assert shown.startswith("2 RDMs of 6 stimuli (correlation; ")
    assert f"RDM {theirs.rdm_descriptors['subject'][0]}" in shown
    refused = run("recordings", "rdm", str(rdms / "rdms.h5"), "--conditions", "trials:stimulus")
    assert "leave out what chooses trials" in refused.err


def test_rdms_of_a_file_are_compared_with_a_model_and_never_scored(run, rdms, tmp_path):
    files = str(rdms / "rdms.h5"), str(rdms / "model.h5")
    data = json.loads(run("recordings", "compare", *files, "--json").out)
    assert data["noise"] == "unknown"
    features = {
        layer: values[::-1].reshape(6, -1) for layer, values in read_features(rdms / "model.h5").activations.items()
    }
    stored = read_rdms(files[0])
    for layer, values in data["values"].items():
        # Stimuli are paired by name, so the order of rows means nothing.
        expected = compare(rdm(features[layer]), stored.values)
        np.testing.assert_allclose(values, expected, atol=1e-12)
    table = run("recordings", "compare", *files).out
    assert "Nothing is corrected for noise or tested" in table
    itself = json.loads(run("recordings", "compare", files[0], files[0], "--json").out)["values"]
    np.testing.assert_allclose([itself[name][place] for place, name in enumerate(stored.names)], 1)
    refused = run("score", files[1], "--recordings", files[0])
    assert refused.status == 1
    assert "no score on it would be honest" in refused.err
    assert "is no file of RDMs" in run("recordings", "compare", files[1], files[0]).err
    (tmp_path / "match.csv").write_text("".join(f"{label},\n" for label in stored.stimuli[:4]))
    few = run("recordings", "compare", *files, "--match", str(tmp_path / "match.csv"))
    assert "have 's5', 's6' in common; a comparison needs 3 stimuli" in few.err


def test_a_copy_for_torch_brain_scores_the_same(run, folder, tmp_path):
    assert run("recordings", "export", str(folder), str(tmp_path / "copy"), "--format", "temporaldata").status == 0
    options = ("--conditions", "trials:stimulus", "--json")
    first, second = (json.loads(run("recordings", "rdm", str(place), *options).out) for place in (folder, tmp_path))
    assert first["animals"] == second["animals"]
    wrong = run("recordings", "export", str(folder), str(tmp_path / "a.nwb"), "--format", "temporaldata")
    assert "Files of temporaldata end in '.h5', '.hdf5'" in wrong.err
    assert "did you mean 'temporaldata'" in run("recordings", "export", str(folder), "x", "--format", "temporal").err


@pytest.mark.slow
def test_the_demo_recordings_can_be_looked_into_and_checked(run):
    assert "trials:stimulus" in run("recordings", "inspect", "demo").out
    result = run("recordings", "check", "demo")
    assert result.status == 0
    assert "10 sessions, 0 errors" in result.out


def test_fetching_without_the_client_says_how_to_get_it(run, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    result = run("recordings", "fetch", "rodgers", "--out", str(tmp_path / "data"))
    assert result.status == 1
    assert "pip install -c constraints.txt '.[dandi]'" in result.err
    assert "did you mean 'rodgers'" in run("recordings", "fetch", "rogers").err


def test_a_published_file_is_checked_and_inspected_from_the_command_line(run, tmp_path):
    path = write_published(tmp_path / "rodgers6_data.npz", m1=make_zero_filled([24, 30])[0])
    result = run("recordings", "check", str(path), "--json")
    assert result.status == 1
    data = json.loads(result.out)
    assert data["sessions"] == ["m1 / 01", "m1 / 02"]
    assert data["findings"][0]["check"] == "labels"
    assert "slot-6" in run("recordings", "inspect", str(path)).out
    assert "published-npz" in run("recordings", "recipe").out
