"""Objects of users and optional parts, by the names that users and entry points give them."""

from __future__ import annotations

import os
import sys

import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError, MissingDependencyError, UsageError
from brainbench.core.plugins import OptionalPart, files_of, load_module, load_object, require_optional


def test_an_object_of_a_file_may_use_the_files_beside_it(tmp_path):
    (tmp_path / "beside.py").write_text("VALUE = 3\n")
    (tmp_path / "own.py").write_text("from beside import VALUE\n\ndef make():\n    return VALUE\n")
    make = load_object(f"{tmp_path / 'own.py'}:make", "model")
    assert make() == 3
    assert {path.name for path in files_of(tmp_path / "own.py")} == {"own.py", "beside.py"}


def test_files_of_one_name_in_two_folders_do_not_meet(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "beside.py").write_text(f"VALUE = {name!r}\n")
        (tmp_path / name / "own.py").write_text("from beside import VALUE\n")
    assert [load_object(f"{tmp_path / name / 'own.py'}:VALUE", "model") for name in ("a", "b")] == ["a", "b"]


def test_an_edit_that_leaves_time_and_length_alone_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    (tmp_path / "inner").mkdir()
    texts = {
        "own.py": "from beside import WIDTH\nfrom inner.deep import DEPTH\nVALUE = WIDTH, DEPTH, 1\n",
        "beside.py": "WIDTH = 1\n",
        "inner/deep.py": "DEPTH = 1\n",
    }
    for number in (1, 2):
        for name, text in texts.items():
            (tmp_path / name).write_text(text.replace("1", str(number)))
            os.utime(tmp_path / name, (1e9, 1e9))
        assert load_object(f"{tmp_path / 'own.py'}:VALUE", "model") == (number,) * 3


def test_an_object_of_a_package_is_found():
    assert load_object("brainbench.core.plugins:load_object", "model") is load_object


def test_what_cannot_be_loaded_is_told(tmp_path):
    own = tmp_path / "own.py"
    own.write_text("def make():\n    pass\n")
    with pytest.raises(UsageError, match="A metric of your own is FILE"):
        load_object("own", "metric")
    with pytest.raises(UsageError, match="did you mean 'make'"):
        load_object(f"{own}:mkae", "metric")
    with pytest.raises(DataFileNotFoundError):
        load_module(str(tmp_path / "none.py"))
    own.write_text("1 / 0\n")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        load_module(str(own))


def test_a_part_whose_folder_was_taken_off_names_the_folder():
    part = OptionalPart("brainbench.commands", "juggle", "brainbench.no_such_folder.inner.commands:juggle")
    assert not part.present
    assert part.taken_off
    assert part.folder == "brainbench/no_such_folder"
    assert part.summary == ""
    with pytest.raises(MissingDependencyError, match="brainbench/no_such_folder"):
        part.load("command")


def test_a_part_that_is_here_is_described_without_importing_it_and_loaded():
    part = OptionalPart("brainbench.metrics", "own", "brainbench.core.plugins:load_object")
    assert part.present
    assert not part.taken_off
    assert part.summary.startswith("Return the object NAME of")
    assert part.load("metric") is load_object


def test_a_part_that_the_installation_does_not_know_asks_for_a_new_one():
    with pytest.raises(MissingDependencyError, match=r"recorder 'nobody' is not known .* install the project again"):
        require_optional("robotics_bridge.links", "nobody", "recorder")
