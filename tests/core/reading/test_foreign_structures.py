"""What others send beside recordings, with its structure changed by seed: refused in one sentence, or sound."""

import pytest

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
