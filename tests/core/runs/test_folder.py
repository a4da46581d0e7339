import json

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.runs.folder import EARLIER_STATE, begin_run, claim, mark


def _claim(folder, identity, **changes):
    claim(folder / "run.json", identity, lambda: {"run": identity}, stated=lambda document: document["run"], **changes)


def test_a_folder_holds_one_run(tmp_path):
    _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.1}})
    _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.1}})
    with pytest.raises(UsageError, match=r"another run: rate\.first 0\.1 \(now 0\.2\)"):
        _claim(tmp_path / "a", {"seed": 0, "rate": {"first": 0.2}})
    with pytest.raises(UsageError, match=r"rate\.first 0\.1 \(now None\)"):
        _claim(tmp_path / "a", {"seed": 0, "rate": {}})


def test_all_processes_but_one_leave_a_folder_without_a_run_as_it_is(tmp_path):
    _claim(tmp_path / "a", {"seed": 0}, write=False)
    assert not (tmp_path / "a").exists()


def test_more_can_be_said_of_a_run(tmp_path):
    _claim(tmp_path, {"seed": 0})
    mark(tmp_path / "run.json", status="finished")
    assert json.loads((tmp_path / "run.json").read_text()) == {"run": {"seed": 0}, "status": "finished"}


def test_a_run_of_an_earlier_format_is_refused(tmp_path):
    _claim(tmp_path, {"seed": 0})
    (tmp_path / EARLIER_STATE).touch()
    with pytest.raises(DataError, match=r"resume\.safetensors' was saved by an earlier brainbench"):
        _claim(tmp_path, {"seed": 0})


def test_a_folder_of_something_else_is_not_taken_for_a_run(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UsageError, match=r"holds no data set \(it has 'thesis\.tex'\)"):
        begin_run(tmp_path, {"seed": 0}, "data set", results="*.h5")
