"""A metric of a user has a name of its own, so that a record tells it from those of the package."""

import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import get_metric, list_metrics

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


def test_every_metric_has_words_of_its_own():
    words = [get_metric(name).describe(()) for name in list_metrics()]
    assert len(set(words)) == len(words)  # boards and audits take scores of equal words for comparable
