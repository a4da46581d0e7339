import pytest

from brainbench.core.errors import UsageError
from brainbench.scoring.recovery import cheapest, find_cheapest
from tests.factories.candidates import DESIGN, make_candidates


@pytest.fixture
def small(monkeypatch):
    """A grid of four designs."""
    for name, values in (("ANIMALS", (4,)), ("UNITS", (40,)), ("TRIALS", (2, 8)), ("STIMULI", (6, 12))):
        monkeypatch.setattr(cheapest, name, values)


def test_the_cheapest_design_that_suffices_is_named(small):
    candidates = make_candidates(14)
    best, tried = find_cheapest(candidates, DESIGN, 0.7, boards=3, workers=1)
    assert best is not None
    assert best.win_rate >= 0.7
    assert best == tried[-1]
    costs = [one.animals * one.trials * one.stimuli for one in tried]
    assert max(costs) == costs[-1]


def test_none_is_named_where_none_suffices(small):
    # Twins cannot be told apart, whatever is measured.
    (one,) = make_candidates(14, names=("a",))
    (twin,) = make_candidates(14, names=("b",))
    best, tried = find_cheapest((one, twin), DESIGN, 0.9, boards=4, workers=1)
    assert best is None
    assert tried


def test_a_rate_lies_between_0_and_1():
    with pytest.raises(UsageError, match="received 1"):
        find_cheapest(make_candidates(), DESIGN, 1.0)
