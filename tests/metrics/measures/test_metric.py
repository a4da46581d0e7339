"""A metric of a user has a name of its own, so that a record tells it from those of the package."""

import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import get_metric, list_metrics
from brainbench.metrics.measures import metric

CODE = "class Mine:\n    name, title = {name!r}, 'mine'\n    animal = score = score_animals = None\n"


def test_a_metric_of_a_file_may_not_take_a_built_in_name(tmp_path):
    for name in ("rsa", "cka"):
        path = tmp_path / f"{name}.py"
        path.write_text(CODE.format(name=name))
        with pytest.raises(UsageError) as caught:
            get_metric(f"{path}:Mine")
        assert repr(name) in str(caught.value)
    path.write_text(CODE.format(name="mine"))
    (tmp_path / "other.py").write_text(CODE.format(name="mine"))
    assert get_metric(f"{tmp_path / 'other.py'}:Mine").name == "mine"


def test_metrics_of_other_packages_arrive_by_their_entry_points(tmp_path, monkeypatch):
    (tmp_path / "metric_elsewhere.py").write_text(CODE.format(name="theirs"))
    info = tmp_path / "metric_elsewhere-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: metric-elsewhere\nVersion: 1.0\n")
    entries = "[brainbench.metrics]\ntheirs = metric_elsewhere:Mine\nwrong = metric_elsewhere:Mine\n"
    (info / "entry_points.txt").write_text(entries)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(metric, "_METRICS", dict(metric._METRICS))
    assert get_metric("theirs").name == "theirs"
    assert get_metric("theirs") is get_metric("theirs")
    with pytest.raises(UsageError, match="makes a metric named 'theirs'"):
        get_metric("wrong")
    names = list_metrics()
    assert names[0] == "rsa"
    assert "theirs" in names
    assert "wrong" not in names


def test_every_metric_has_words_of_its_own():
    words = [get_metric(name).describe(()) for name in list_metrics()]
    assert len(set(words)) == len(words)  # boards and audits take scores of equal words for comparable
