"""``brainbench recordings check | export | fetch`` and pooling, from the command line."""

import json

import numpy as np
import pytest

from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.synthetic import ResponseGeometry, write_files
from brainbench.metrics import get_metric
from brainbench.scoring.neural_responses import open_neural_responses
from brainbench.scoring.options import ScoreOptions
from tests.factories.published_recordings import make_zero_filled, write_published
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


def test_the_reliability_of_scores_is_shown_before_scoring(run, folder):
    result = run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--metric", "rsa", "--json")
    ours = [animal["reliability"] for animal in json.loads(result.out)["animals"]]
    brain = open_neural_responses(folder, progress=None, conditions="trials:stimulus")
    animals = brain.animals(brain.vocabulary, get_metric("rsa"), ScoreOptions())
    assert ours == [animal.reliability for animal in animals]
    refused = run("recordings", "rdm", str(folder), "--conditions", "trials:stimulus", "--metric", "cka")
    assert refused.status == 2
    assert "'cka'" in refused.err


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
