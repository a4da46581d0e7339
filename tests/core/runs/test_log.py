import csv
import json
import math
import sys
from types import SimpleNamespace

import pytest

from brainbench.core.errors import MissingDependencyError, UsageError
from brainbench.core.runs import log as module
from brainbench.core.runs.log import RunLog, check_sinks, read_log


def _make_log(folder, *, last=0, **options):
    return RunLog(folder, "step", last, **{"sinks": (), **options})


def test_lines_after_the_state_are_dropped_and_written_anew(tmp_path):
    log = _make_log(tmp_path)
    for step in (1, 2, 3):
        log.write("train", step, loss=1.0 / step)
    log.close()
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"kind": "train", "ste')
    log = _make_log(tmp_path, last=2)
    log.write("train", 3, loss=math.nan)
    log.write("validation", 3, top1=0.5)
    log.close()
    assert [(line["step"], line["loss"]) for line in read_log(tmp_path, "train")] == [(1, 1.0), (2, 0.5), (3, None)]


def test_a_process_that_is_not_the_first_writes_nothing(tmp_path):
    log = _make_log(tmp_path, sinks=("csv",), active=False)
    log.write("train", 1, loss=1.0)
    log.close()
    assert not list(tmp_path.iterdir())


def test_the_csv_file_is_the_log(tmp_path):
    log = _make_log(tmp_path, sinks=("csv",))
    log.write("", 1, reward=0.25)
    log.write("", 2, reward=0.5, success=1.0)
    log.close()
    with (tmp_path / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows == [{"step": "1", "reward": "0.25", "success": ""}, {"step": "2", "reward": "0.5", "success": "1.0"}]
    assert json.loads((tmp_path / "log.jsonl").read_text().splitlines()[0]) == {"step": 1, "reward": 0.25}


def test_weights_and_biases_stays_offline(tmp_path, monkeypatch):
    calls = []
    run = SimpleNamespace(
        log=lambda row, step: calls.append((step, row["reward"])), finish=lambda: calls.append(("end",))
    )
    fake = SimpleNamespace(init=lambda **given: calls.append((given["mode"], given["config"]["task"])) or run)
    monkeypatch.setitem(sys.modules, "wandb", fake)
    log = _make_log(tmp_path, sinks=("wandb",), facts={"task": "t"})
    log.write("", 3, reward=0.5)
    log.close()
    assert calls == [("offline", "t"), (3, 0.5), ("end",)]


def test_sinks_are_known_and_installed(monkeypatch):
    with pytest.raises(UsageError, match="did you mean 'tensorboard'"):
        check_sinks(("tensorbord",))
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    for name, install in (("wandb", "pip install wandb"), ("tensorboard", "policies")):
        with pytest.raises(MissingDependencyError, match=install):
            check_sinks((name,))
