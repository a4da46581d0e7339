from __future__ import annotations

import json

from brainbench.cli.leaderboard.collection import command_of
from brainbench.scoring.jobs import read_batch


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
    assert [command_of(job) for job in read_batch(batch)][1] == "brainbench score s4-small --weights-seed 1"
