"""Every reader of users' files, fed with seeded damage: it refuses in one sentence, or what it returns is sound."""

import pytest

from tests.factories.reading_surfaces import SURFACES
from tests.factories.reading_trials import attempt


def _failures(surface, good, seeds):
    outcomes = {seed: attempt(surface, good, seed) for seed in seeds}
    return {seed: outcome for seed, outcome in outcomes.items() if outcome.kind not in ("refused", "accepted")}


CASES = [pytest.param(surface, id=surface.name.replace(", ", "-").replace(" ", "-")) for surface in SURFACES]


@pytest.fixture(scope="module")
def goods(tmp_path_factory):
    made = {}

    def good(surface):
        if surface.name not in made:
            made[surface.name] = surface.make(tmp_path_factory.mktemp("good"))
        return made[surface.name]

    return good


@pytest.mark.parametrize("surface", CASES)
def test_damage_is_refused_in_one_sentence(surface, goods):
    assert _failures(surface, goods(surface), range(10)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("surface", CASES)
def test_much_damage_is_refused_in_one_sentence(surface, goods):
    assert _failures(surface, goods(surface), range(500)) == {}


@pytest.mark.parametrize("surface", CASES)
def test_what_is_whole_is_read(surface, goods, tmp_path):
    good = goods(surface)
    assert not surface.faults(surface.read(surface.copy(good, tmp_path / "copy")))
