"""A benchmark in place of the options of a score: what is the benchmark's, and what stays the caller's."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from brainbench.benchmarks import opening
from brainbench.benchmarks.opening import check, make, open_for_score, options_of
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import file_hash
from brainbench.scoring.options import ScoreOptions


def test_the_benchmarks_options_take_the_place_of_the_callers(lab):
    given = ScoreOptions(benchmark=lab / "lab.toml", layer="fc", weights_seed=7, memory=1.0)
    options = open_for_score(given).options
    assert options == ScoreOptions(
        recordings=str(lab / "data"), conditions="trials:texture", stimuli=str(lab / "eight.h5"), seed=1,
        layer="fc", weights_seed=7, memory=1.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("options", "explicit", "sentence"),
    [
        ({"metric": "cka"}, (), "metric is a matter of the benchmark 'lab', which states 'rsa'; received 'cka'"),
        ({"recordings": "other"}, (), "recordings is a matter of the benchmark 'lab', which states 'data'"),
        ({"match": {"a": "b"}}, (), "match is a matter of the benchmark 'lab'"),
        ({"seed": 0}, ("seed",), "seed is a matter of the benchmark 'lab', which states 1; received 0"),
        ({"title": "x"}, (), "title is a matter"),
    ],
)
def test_options_that_contradict_it_are_refused(lab, options, explicit, sentence):
    with pytest.raises(UsageError, match=sentence):
        open_for_score(ScoreOptions(benchmark=lab / "lab.toml", **options), explicit)


def test_options_that_say_the_same_pass(lab):
    given = ScoreOptions(benchmark=lab / "lab.toml", conditions="trials:texture", metric="rsa")
    assert open_for_score(given, ("conditions", "metric")).options.seed == 1


def test_a_file_put_beside_the_recordings_is_refused(lab):
    (lab / "data" / "more.h5").write_bytes((lab / "data" / "w.h5").read_bytes())
    with pytest.raises(DataError, match=r"'data' holds or names 'more.h5', which the benchmark 'lab' does not list"):
        open_for_score(ScoreOptions(benchmark=lab / "lab.toml"))


def test_a_scene_that_names_a_file_elsewhere_is_refused(lab, laboratory, tmp_path):
    (tmp_path / "private.csv").write_text("1")
    (lab / "scene.toml").write_text(f'[whisking]\npath = "{tmp_path / "private.csv"}"\n')
    files = {**laboratory[1].files, "scene.toml": file_hash(lab / "scene.toml", length=64)}
    changed = replace(laboratory[1], options={"stimuli": "scene.toml"}, files=files)
    with pytest.raises(DataError, match=r"'scene.toml' holds or names 'private.csv', which the benchmark"):
        options_of(changed, lab)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"options": {"stimuli": "eigth.h5"}}, "stimuli of a benchmark 'eigth.h5'; did you mean 'eight.h5'"),
        ({"options": {"metric": "mine.py:Metric"}}, "A benchmark brings no code, and its metric is"),
        ({"options": {"metric": "rsaa"}}, "Unknown metric 'rsaa'; did you mean 'rsa'"),
        ({"options": {"conditions": 3}}, "conditions must be a text; received 3"),
        ({"options": {"whiskers": True}}, "whiskers must be a text"),
        ({"options": {"bin": "wide"}}, "bin"),
        ({"path": "rodger:data"}, "recording layout of a benchmark 'rodger'; did you mean 'rodgers'"),
        ({"path": "mine.py:data"}, "recording layout of a benchmark 'mine.py'"),
    ],
)
def test_what_is_not_installed_or_brings_code_is_refused(laboratory, change, sentence):
    folder, benchmark = laboratory
    path = change.pop("path", benchmark.recordings.path)
    changed = replace(benchmark, recordings=replace(benchmark.recordings, path=path), **change)
    with pytest.raises(UsageError, match=sentence):
        options_of(changed, folder)


def test_a_benchmark_states_what_is_not_the_default_and_the_hash_of_each_file(laboratory):
    folder, benchmark = laboratory
    assert benchmark.options == {"stimuli": "eight.h5", "conditions": "trials:texture", "seed": 1}
    assert {*benchmark.files} == {"eight.h5", *(f"data/{name}.h5" for name in "wxyz")}
    assert benchmark.files["eight.h5"] == file_hash(folder / "eight.h5", length=64)
    assert benchmark.ceiling is not None
    assert (benchmark.ceiling.animals, benchmark.ceiling.stimuli) == (4, 8)
    assert 0 < benchmark.ceiling.lower < benchmark.ceiling.upper <= 1


def test_check_names_what_others_will_miss_and_nothing_wrong(laboratory):
    findings = check(str(laboratory[0] / "lab.toml"))[1]
    assert {finding.severity for finding in findings} == {"note"}
    assert [finding.what.split()[0] for finding in findings] == ["contact", "recordings.source", "recordings.licence"]


def test_check_finds_numbers_that_are_not_those_of_the_recordings(lab, laboratory):
    benchmark = laboratory[1]
    wrong = replace(benchmark, ceiling=replace(benchmark.ceiling, reliability=0.5))
    (lab / "lab.toml").write_text(wrong.to_toml())
    errors = [finding.what for finding in check(str(lab / "lab.toml"))[1] if finding.severity == "error"]
    assert len(errors) == 1
    assert re.match(r"reliability of the ceiling is 0\.9\d+ here, and 0\.5 is stated", errors[0])


@pytest.fixture
def unmeasured(monkeypatch):
    """No recordings are read."""
    monkeypatch.setattr(opening, "_measure", lambda options, progress: ("0123456789", None))


@pytest.mark.usefixtures("unmeasured")
def test_recordings_outside_the_folder_are_refused(lab):
    options = ScoreOptions(recordings=str(lab / "data"))
    with pytest.raises(UsageError, match=r"lies outside the folder .* of --out"):
        make(options, lab / "other" / "lab.toml", name="lab")


@pytest.mark.usefixtures("unmeasured")
def test_a_layout_stays_with_the_path_and_pairs_are_written_out(lab):
    (lab / "match.csv").write_text("a,b\nb,\n")
    options = ScoreOptions(recordings=f"rodgers:{lab / 'data'}", match=lab / "match.csv", title="Ours")
    benchmark = make(options, lab / "lab.toml", name="lab")
    assert benchmark.recordings.path == "rodgers:data"
    assert benchmark.match == {"a": "b", "b": ""}
    assert benchmark.options == {"title": "Ours"}


@pytest.mark.usefixtures("unmeasured")
def test_a_demo_needs_no_files():
    benchmark = make(ScoreOptions(stimuli="objects"), Path("demo.toml"), name="demo")
    assert (benchmark.recordings.path, benchmark.files) == ("demo", {})
