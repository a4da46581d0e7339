"""What others send beside recordings, with its structure changed by seed: refused in one sentence, or sound."""

import os
import signal

import pytest

from brainbench.core.errors import DataError
from tests.factories.foreign_commands import DOORS, FAILURES, Door, cases
from tests.factories.foreign_surfaces import FOREIGN
from tests.factories.reading_trials import attempt
from tests.factories.structures import restructure

SLOW = ("HDF5", "WhiskiWrap", "WhiskerMan", "imported", "manifest")
"""A reader of these starts a process or builds a network for every case."""
CASES = [pytest.param(surface, id=surface.name.replace(", ", "-").replace(" ", "-")) for surface in FOREIGN]


def _failures(surface, folder, seeds):
    good = surface.make(folder)
    assert not surface.faults(surface.read(good))
    # To read a file may leave something beside it, which is no part of the cases.
    fresh = folder / "fresh"
    fresh.mkdir()
    good = surface.make(fresh)
    outcomes = {seed: attempt(surface, good, seed, restructure) for seed in seeds}
    return {seed: outcome for seed, outcome in outcomes.items() if outcome.kind not in ("refused", "accepted")}


@pytest.mark.parametrize("surface", CASES)
def test_another_structure_is_refused_or_sound(surface, tmp_path):
    assert _failures(surface, tmp_path, range(2 if any(name in surface.name for name in SLOW) else 12)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("surface", CASES)
def test_many_structures_are_refused_or_sound(surface, tmp_path):
    assert _failures(surface, tmp_path, range(200)) == {}


def test_changes_are_those_of_their_seed(tmp_path):
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text('{"one": [1, 2.5, "x"], "two": {"three": null}}')
    pairs = [(restructure(tmp_path / "a.json", seed), restructure(tmp_path / "b.json", seed)) for seed in range(20)]
    assert all(left == right for left, right in pairs)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.name.replace(", ", "-").replace(" ", "-"))
def test_commands_refuse_what_was_changed_in_one_sentence(door, tmp_path):
    verdicts = list(cases(door, tmp_path, range(6)))
    assert [verdict for verdict in verdicts if verdict.kind in FAILURES] == []


def test_each_kind_of_failure_is_seen(tmp_path):
    def verdict(read):
        door = Door("tried", "log", read=read)
        (only,) = cases(door, tmp_path, range(-1, 0))
        return only.kind

    assert verdict(lambda path: 1.0) == "accepted"
    assert verdict(lambda path: float("nan")) == "silent"
    assert verdict(lambda path: int("x")) == "traceback"
    assert verdict(lambda path: os.kill(os.getpid(), signal.SIGKILL)) == "crash"
    assert verdict(lambda path: (path.parent / "../../etc/passwd").read_text(encoding="utf-8")) == "leaked"

    def refuse(path):
        (path.parent / "half").touch()
        raise DataError("No.")

    assert verdict(refuse) == "half-written"
