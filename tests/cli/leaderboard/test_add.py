"""Records are taken in, refused and compared from the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from brainbench.cli.options import score_command
from brainbench.core.records import ResultRecord
from brainbench.datasets import open_recordings, write_recordings
from brainbench.scoring.jobs import read_batch
from leaderboards.store import read_record


def test_only_a_score_of_the_same_question_is_known_or_replaced(run, files, tmp_path):
    to, batch = tmp_path / "board", tmp_path / "batch.toml"
    given = f'recordings = "{files["recordings"]}"\nstimuli = "{files["arrays"]}"\nconditions = "trials:texture"\n'
    (tmp_path / "match.csv").write_text("a,b\nb,a\n")
    paired = f"match = '{tmp_path / 'match.csv'}'"
    states = []
    titled = "title = 'pilot'"
    for option in ("", "layer = 'gru'", "normalize = false", "window = 'start..+0.3'", paired, titled, "", paired):
        batch.write_text(f'[options]\n{given}{option}\n[[entries]]\nmodels = ["{files["model"]}"]\n')
        result = run("leaderboard", "add", "--batch", str(batch), "--to", str(to), "--prune", "--json")
        assert result.status == 0, result.err
        states += [item["state"] for item in json.loads(result.out)["results"]]
    assert states == ["scored"] * 6 + ["known"] * 2
    assert len(list(to.glob("*.json"))) == 6
    copied = run("leaderboard", "add", str(to), "--to", str(tmp_path / "copy"), "--json")
    assert {item["state"] for item in json.loads(copied.out)["results"]} == {"added"}


def test_features_with_labels_of_their_own_are_scored_once(run, files, tmp_path):
    batch, given = tmp_path / "batch.toml", f'recordings = "{files["recordings"]}"\nconditions = "trials:texture"\n'
    states = []
    entry = f'[[entries]]\nmodels = ["{files["features"]}"]\nseeds = [0, 1]\n'
    for title in ("", "", "title = 'pilot'", "title = 'pilot'"):
        batch.write_text(f"[options]\n{given}{title}\n{entry}{entry}")
        result = run("leaderboard", "add", "--batch", str(batch), "--to", str(tmp_path / "board"), "--json")
        assert result.status == 0, result.err
        states += [item["state"] for item in json.loads(result.out)["results"]]
    assert states == ["scored", "known", "scored", "known"]


def test_a_job_has_the_command_that_makes_its_score(tmp_path):
    batch = tmp_path / "b.toml"
    batch.write_text('[[entries]]\nmodels = ["s4-small"]\nseeds = [0, 1]\n')
    job = read_batch(batch)[1]
    assert score_command(job.model, job.options) == "brainbench score s4-small --weights-seed 1"


def _forge(path: Path) -> Path:
    """Raise the value and give the file the name that fits it, as a careful cheat would."""
    data = json.loads(path.read_text())
    data["score"]["value"] += 0.2
    forged = path.parent / "forged" / ResultRecord.from_json(data).file_name
    forged.parent.mkdir(exist_ok=True)
    forged.write_text(json.dumps(data))
    assert read_record(forged)
    return forged


def test_diff_names_what_changed(run, scored, tmp_path):
    path, _ = scored
    for name in ("old", "new"):
        (tmp_path / name).mkdir()
    shutil.copy(path, tmp_path / "old")
    shutil.copy(_forge(path), tmp_path / "new")
    old, new = str(tmp_path / "old"), str(tmp_path / "new")
    changes = json.loads(run("leaderboard", "diff", old, new, "--json").out)["changes"]
    assert [change["kind"] for change in changes] == ["changed"]
    assert "No difference." in run("leaderboard", "diff", old, old).out


@pytest.mark.slow
def test_models_are_scored_once_and_the_batch_goes_on_where_it_stopped(run, files, tmp_path):
    batch = tmp_path / "batch.toml"
    options = f'recordings = "{files["recordings"]}"\nstimuli = "{files["arrays"]}"\nconditions = "trials:texture"\n'
    batch.write_text(f'[options]\n{options}\n[[entries]]\nmodels = ["{files["model"]}"]\nseeds = [0, 1]\n')
    to = tmp_path / "board"
    result = run("leaderboard", "add", "--batch", str(batch), "--to", str(to), "--json")
    assert result.status == 0, result.err
    states = [item["state"] for item in json.loads(result.out)["results"]]
    assert states == ["scored", "scored"]
    next(to.glob("*.json")).unlink()
    result = run("leaderboard", "add", "--batch", str(batch), "--to", str(to), "--json")
    assert sorted(item["state"] for item in json.loads(result.out)["results"]) == ["known", "scored"]
    assert len(list(to.glob("*.json"))) == 2
    Path(files["model"].partition(":")[0]).write_text(
        Path(files["model"].partition(":")[0]).read_text().replace("GRU(8, 6", "GRU(8, 5")
    )
    result = run("leaderboard", "add", "--batch", str(batch), "--to", str(to), "--prune", "--workers", "2", "--json")
    assert result.status == 0, result.err
    results = json.loads(result.out)["results"]
    assert [item["state"] for item in results] == ["scored", "scored"]
    assert all("replaces" in item["note"] for item in results)
    assert {path.name for path in to.glob("*.json")} == {item["record"] for item in results}


@pytest.mark.parametrize("part", ["animals", "days"])
def test_other_recordings_in_a_file_of_the_same_name_replace_nothing(run, files, tmp_path, part):
    whole = open_recordings(files["recordings"], conditions="trials:texture")
    animals = whole["subject"].values
    parts = [animals == animal for animal in np.unique(animals)]
    if part == "days":
        # The first trials of each animal and the last, which its neurons do not tell apart.
        early = np.concatenate([np.arange(rows.sum()) < rows.sum() // 2 for rows in parts])
        parts = [early, ~early]
    to, states = tmp_path / "board", []
    for number, rows in enumerate(parts):
        (tmp_path / str(number)).mkdir()
        units = np.isin(whole["unit_subject"].values, animals[rows])
        path = write_recordings(tmp_path / str(number) / "data.h5", whole.isel(trial=rows, unit=units))
        given = ("--recordings", str(path), "--model", files["features"], "--to", str(to), "--prune")
        result = run("leaderboard", "add", *given, "--json")
        states += [item["state"] + item["note"] for item in json.loads(result.out)["results"]]
    assert states == ["scored", "scored"]
    assert len(list(to.glob("*.json"))) == 2


@pytest.mark.parametrize("option", [("--metric", "cka"), ("--seed", "1")])
def test_options_of_scores_without_a_model_are_refused(run, tmp_path, option):
    result = run("leaderboard", "add", str(tmp_path), "--to", str(tmp_path / "board"), *option)
    assert result.status == 2
    assert option[0] in result.err


def test_a_file_in_place_of_the_folder_is_refused_before_anything_is_scored(run, tmp_path):
    (tmp_path / "file").write_text("")
    result = run("leaderboard", "add", "--model", "s4-small", "--to", str(tmp_path / "file"))
    assert result.status == 2
    assert "--to" in result.err


def test_nothing_to_add_is_an_error(run):
    result = run("leaderboard", "add")
    assert result.status == 2
    assert "Name record files to take in" in result.err
