"""Benchmarks are made from the options of a score, and checked against what they state."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from brainbench.benchmarks import making
from brainbench.benchmarks.making import check, make
from brainbench.core.errors import UsageError
from brainbench.core.files import file_hash
from brainbench.scoring.options import ScoreOptions


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
    monkeypatch.setattr(making, "_measure", lambda options, progress: ("0123456789", None))


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
    benchmark = make(ScoreOptions(stimuli="objects"), making.Path("demo.toml"), name="demo")
    assert (benchmark.recordings.path, benchmark.files) == ("demo", {})
