import json
import logging

import pytest
import torch

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.models import registry
from brainbench.models.registry import (
    add_user_model,
    describe_model,
    list_models,
    load_model,
    read_user_models,
    remove_user_model,
    settings_file,
)

CODE = "from torch import nn\n\n\ndef make():\n    return nn.Linear(4, 2)\n"


@pytest.fixture(autouse=True)
def _settings(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAINBENCH_CONFIG", str(tmp_path / "settings"))
    monkeypatch.setattr(registry, "_loaded", set())
    monkeypatch.setattr(registry, "_records", dict(registry._records))


@pytest.fixture
def still(tmp_path):
    path = tmp_path / "still.py"
    path.write_text(CODE)
    add_user_model(f"{path}:make", "still", names=[])
    return path


@pytest.mark.usefixtures("still")
def test_an_added_model_is_found_by_name_with_seeded_weights():
    assert "still" in list_models()
    assert torch.equal(load_model("still", seed=1).weight, load_model("still", seed=1).weight)
    assert not torch.equal(load_model("still", seed=1).weight, load_model("still", seed=2).weight)
    assert describe_model("still").family == "user module"


def test_a_file_that_is_gone_or_changed_is_told(still, caplog):
    still.write_text(CODE.replace("2", "3"))
    with caplog.at_level(logging.WARNING):
        assert load_model("still").out_features == 3
    assert str(still) in caplog.text
    still.unlink()
    with pytest.raises(DataFileNotFoundError, match=r"still\.py"):
        load_model("still")


def test_a_change_of_what_the_file_imports_beside_it_is_told(tmp_path, caplog):
    (tmp_path / "sizes_of_mine.py").write_text("WIDTH = 2\n")
    (tmp_path / "unrelated.py").write_text("WIDTH = 2\n")
    path = tmp_path / "wide.py"
    path.write_text("from sizes_of_mine import WIDTH\n" + CODE.replace("2", "WIDTH"))
    add_user_model(f"{path}:make", "wide", names=[])
    (tmp_path / "unrelated.py").write_text("WIDTH = 5\n")
    with caplog.at_level(logging.WARNING):
        load_model("wide")
    assert not caplog.text
    (tmp_path / "sizes_of_mine.py").write_text("WIDTH = 33333\n")
    with caplog.at_level(logging.WARNING):
        assert load_model("wide").out_features == 33333
    assert str(path) in caplog.text


def test_nothing_is_stored_of_code_that_gives_no_module(tmp_path):
    path = tmp_path / "wrong.py"
    path.write_text("def make():\n    return 3\n")
    with pytest.raises(UsageError, match="int"):
        add_user_model(f"{path}:make", "wrong", names=[])
    assert read_user_models() == {}


def test_names_are_taken_once_and_follow_the_grammar(still):
    for name, taken in (("still", []), ("zhuang", ["zhuang"]), ("Still life", [])):
        with pytest.raises(UsageError, match=name):
            add_user_model(f"{still}:make", name, names=taken)
    with pytest.raises(UsageError, match="'still'"):
        remove_user_model("stil")
    remove_user_model("still")
    assert "still" not in list_models()


@pytest.mark.parametrize("content", ["[]", '{"a": 3}', '{"a": {"target": 3, "hash": ""}}', "{"])
def test_damaged_settings_are_answered_in_one_sentence(content):
    settings_file().parent.mkdir()
    settings_file().write_text(content)
    with pytest.raises(DataError, match=r"models\.json"):
        read_user_models()


def test_a_package_that_takes_the_name_wins(still, caplog):
    stored = json.loads(settings_file().read_text())
    settings_file().write_text(json.dumps({"zhuang": stored["still"]}))
    with caplog.at_level(logging.WARNING):
        assert describe_model("zhuang").family == "zhuang"
    assert str(still) in caplog.text
