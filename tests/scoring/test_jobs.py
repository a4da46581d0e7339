"""Jobs are found by patterns and batch files, and only those without a score are computed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.records import ResultRecord
from brainbench.scoring import score
from brainbench.scoring.jobs import ScoringJob, find_models, missing, parse_seeds, read_batch
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.scores import score_record


def test_patterns_mean_architectures_unless_they_have_a_dot():
    names = find_models(["*-small", "zhuang"])
    assert "zhuang-intersection-ln-small" in names
    assert names[-1] == "zhuang"
    assert not [name for name in names if "." in name]
    with pytest.raises(UsageError, match="did you mean 'zhuang'"):
        find_models(["zhuan"])


def test_a_pattern_with_a_dot_finds_the_trained_models_that_come_with_the_package(monkeypatch, tmp_path):
    from brainbench.models.training import checkpoints

    monkeypatch.setattr(
        checkpoints, "shipped", lambda: {"s4-small.simclr": tmp_path, "zhuang-small.supervised": tmp_path}
    )
    assert find_models(["*.*"]) == ["s4-small.simclr", "zhuang-small.supervised"]
    assert find_models(["*.simclr"]) == ["s4-small.simclr"]


def test_seeds_and_batches_are_read_or_refused(tmp_path):
    assert parse_seeds("0-2,7") == (0, 1, 2, 7)
    with pytest.raises(UsageError, match="such as 0-4"):
        parse_seeds("a")
    with pytest.raises(UsageError, match="received '0,3-1'"):
        parse_seeds("0,3-1")
    batch = tmp_path / "b.toml"
    batch.write_text('[[entries]]\nmodels = ["s4-small"]\nseeds = [0, 1]\n')
    assert [(job.model, job.options.model_seed) for job in read_batch(batch)] == [("s4-small", 0), ("s4-small", 1)]
    batch.write_text('[[entries]]\nmodels = ["s4-small"]\nseeds = [3, 3]\n')
    assert [job.options.model_seed for job in read_batch(batch)] == [3]
    batch.write_text('[options]\nseed = 5\nweights_seed = 2\n[[entries]]\nmodels = ["s4-small"]\n')
    assert [(job.options.seed, job.options.model_seed) for job in read_batch(batch)] == [(5, 2)]
    batch.write_text("[options]\ncolour = 1\n")
    with pytest.raises(UsageError, match="Unknown option of a score 'colour'"):
        read_batch(batch)
    with pytest.raises(DataError, match=r"none\.toml"):
        read_batch(tmp_path / "none.toml")


def test_only_weights_that_follow_a_seed_are_scored_for_several(tmp_path):
    batch = tmp_path / "batch.toml"
    shipped = find_models(["*.*"])[0]
    batch.write_text(f'[[entries]]\nmodels = ["{shipped}", "mine.py:net", "s4-small"]\nseeds = [1, 2]\n')
    jobs = read_batch(batch)
    assert [(job.model, job.options.model_seed) for job in jobs] == [
        (shipped, 0), ("mine.py:net", 1), ("mine.py:net", 2), ("s4-small", 1), ("s4-small", 2)
    ]  # fmt: skip
    with pytest.raises(UsageError, match="weights_seed"):
        score(shipped, weights_seed=1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "names no model"),
        ("[[entries]]\nmodels = []\n", "'models'"),
        ("[[entries]]\nmodels = ['s4-small']\nseeds = []\n", "'seeds'"),
        ("[[entries]]\nmodels = ['s4-small', 'zzz*']\n", "No model matches 'zzz\\*'"),
    ],
)
def test_a_batch_that_asks_for_nothing_is_refused(tmp_path, text, said):
    (tmp_path / "batch.toml").write_text(text)
    with pytest.raises((DataError, UsageError), match=said):
        read_batch(tmp_path / "batch.toml")


def test_a_score_is_made_anew_for_another_estimator_not_for_another_package(files):
    options = ScoreOptions(recordings=files["recordings"], conditions="trials:texture")
    job, record = ScoringJob(files["features"], options), score_record(files["features"], options)
    newer = _restated(record, version="99.0")
    older = _restated(record, settings={**record.score.provenance.settings, "estimator_version": 1})
    assert missing([job], [record]) == missing([job], [newer]) == []
    assert missing([job], [older]) == [job]


def test_scores_of_the_published_estimator_are_found_again(files):
    options = ScoreOptions(recordings=files["recordings"], conditions="trials:texture", estimator="thesis")
    record = score_record(files["features"], options)
    # The metric is then the one of correlation distances, whatever its name was.
    assert record.score.provenance.settings["metric"] == "rsa-correlation"
    assert missing([ScoringJob(files["features"], options)], [record]) == []


def _restated(record: ResultRecord, **provenance: object) -> ResultRecord:
    return replace(record, score=replace(record.score, provenance={**record.score.provenance, **provenance}))
