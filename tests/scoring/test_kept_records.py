from pathlib import Path

import pytest

from brainbench.core.records import ModelCard, ResultRecord, Score
from brainbench.metrics.measures import metric as registry
from brainbench.metrics.measures.metric import register_metric
from brainbench.metrics.measures.patterns import LinearCKA
from brainbench.metrics.measures.rsa import RSA
from brainbench.scoring import kept_records
from brainbench.scoring.options import ScoreOptions

NAME = "zhuang-small.supervised"


def _path(model: str = NAME, command: str = "brainbench score", **changes) -> Path | None:
    return kept_records.record_path(model, ScoreOptions(**changes), command)


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    return tmp_path


def test_equal_scores_have_one_entry_and_others_another(monkeypatch: pytest.MonkeyPatch):
    assert _path() == _path()
    monkeypatch.setattr(kept_records, "code_stamp", lambda: "edited")
    after_an_edit = _path()
    monkeypatch.undo()
    others = [_path("zhuang-small"), _path(command="other"), _path(seed=1), _path(title="mine"), after_an_edit]
    assert len({_path(), *others}) == 6


@pytest.mark.parametrize(
    ("model", "changes"),
    [
        ("mine.py:make", {}), ("activations.h5", {}), ("local-dir:folder", {}), ("no-such-model", {}),
        (NAME, {"recordings": "data/*.nwb"}), (NAME, {"stimuli": "scene.toml"}), (NAME, {"metric": "mine.py:Metric"}),
        (NAME, {"match": {"a": "b"}}),
    ],
)  # fmt: skip
def test_what_depends_on_files_of_the_user_is_scored_each_time(model: str, changes: dict):
    assert _path(model, **changes) is None


def test_a_metric_that_another_package_registered_is_scored_each_time(monkeypatch: pytest.MonkeyPatch):
    class Mine(LinearCKA):
        name = "mine"

    monkeypatch.setattr(registry, "_METRICS", dict(registry._METRICS))
    register_metric(Mine())
    assert _path(metric="mine") is None
    assert _path(metric="cka") is not None
    assert _path(metric="no-such-metric") is None


def test_a_metric_of_ours_with_options_of_another_package_has_an_entry_for_each(monkeypatch: pytest.MonkeyPatch):
    def entry(comparison: str) -> Path | None:
        monkeypatch.setattr(registry, "_METRICS", {"mine": RSA("mine", "t", comparison=comparison)})
        return _path(metric="mine")

    assert entry("pearson") not in (None, entry("spearman"))


def test_a_kept_record_is_read_and_a_damaged_one_is_not(caplog: pytest.LogCaptureFixture):
    path, record = _path(), ResultRecord(Score("x", 0.5, "ok"), card=ModelCard("x"))
    assert kept_records.read_kept(path) is None
    kept_records.keep(record, path)
    read = kept_records.read_kept(path)
    assert read is not None
    assert read.identity == record.identity
    assert path is not None
    path.write_text("{}")
    assert kept_records.read_kept(path) is None
    assert "damaged" in caplog.text


def test_an_edited_record_and_one_of_another_model_are_not_read(caplog: pytest.LogCaptureFixture):
    path, rival = _path(), _path("zhuang-small")
    assert path is not None
    assert rival is not None
    for place, value in ((path, 0.5), (rival, 0.7)):
        kept_records.keep(ResultRecord(Score("x", value, "ok")), place)
    rival.replace(path)
    assert kept_records.read_kept(path) is None
    text = ResultRecord(Score("x", 0.5, "ok")).to_json()
    path.write_text(text.replace("0.5", "0.987"))
    assert kept_records.read_kept(path) is None
    path.write_text(text)
    assert kept_records.read_kept(path) is not None
    assert caplog.text.count("is made again") == 2
