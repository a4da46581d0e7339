"""What others send beside recordings, with its structure changed by seed: refused in one sentence, or sound."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from tests.factories.foreign_commands import DOORS, FAILURES, Door, cases
from tests.factories.reading_surfaces import SURFACES, _log
from tests.factories.reading_trials import attempt
from tests.factories.structures import restructure

STRUCTURES = (
    "contract", "student, configuration", "student, weights", "published settings, YAML", "network, JSON", "batch file",
    "sweep of students", "probe layout", "scene", "result record", "site manifest", "change text", "selection text",
    "plan", "hub name",
)  # fmt: skip
"""Surfaces whose readers are quick."""


@pytest.mark.parametrize(
    "surface", [pytest.param(surface, id=surface.name) for surface in SURFACES if surface.name in STRUCTURES]
)
def test_another_structure_is_refused_or_sound(surface, tmp_path):
    good = surface.make(tmp_path)
    outcomes = [attempt(surface, good, seed, restructure) for seed in range(12)]
    assert [outcome for outcome in outcomes if outcome.kind not in ("refused", "accepted")] == []


def test_changes_are_those_of_their_seed(tmp_path):
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text('{"one": [1, 2.5, "x"], "two": {"three": null}}')
    pairs = [(restructure(tmp_path / "a.json", seed), restructure(tmp_path / "b.json", seed)) for seed in range(20)]
    assert all(left == right for left, right in pairs)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("door", [pytest.param(door.name, id=door.name) for door in DOORS])
def test_commands_refuse_what_was_changed_in_one_sentence(door, tmp_path):
    words = [sys.executable, "-m", "tests.factories.foreign_commands", str(tmp_path), door, "--cases", "40"]
    printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    whole, *verdicts = map(json.loads, printed.splitlines())
    assert whole["kind"] == "accepted", whole
    assert len(verdicts) == 40
    assert [verdict for verdict in verdicts if verdict["kind"] in FAILURES] == []


def test_each_kind_of_failure_is_seen(tmp_path, monkeypatch):
    def verdict(work):
        monkeypatch.setattr("brainbench.cli.main", lambda: sys.stdout.write(json.dumps(work(Path(sys.argv[1])))))
        with tempfile.TemporaryDirectory(dir=tmp_path) as folder:
            (only,) = cases(Door("tried", _log, "{file}"), Path(folder), range(0))
        return only.kind

    assert verdict(lambda path: 1.0) == "accepted"
    assert verdict(lambda path: float("nan")) == "silent"
    assert verdict(lambda path: int("x")) == "traceback"
    assert verdict(lambda path: os.kill(os.getpid(), signal.SIGKILL)) == "crash"
    assert verdict(lambda path: (path.parent / "../../etc/passwd").read_text(encoding="utf-8")) == "leaked"
    assert verdict(lambda path: sys.exit("No.")) == "refused"
    assert verdict(lambda path: [(path.parent / "half").touch(), sys.exit("No.")]) == "half-written"
