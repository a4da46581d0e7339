"""A benchmark in place of the options of a score: what is the benchmark's, and what stays the caller's."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brainbench.benchmarks.opening import open_for_score, options_of
from brainbench.core.errors import DataError, UsageError
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
    with pytest.raises(DataError, match=r"'data' holds 'more.h5', which the benchmark 'lab' does not list"):
        open_for_score(ScoreOptions(benchmark=lab / "lab.toml"))


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
