from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.scoring.recovery import Candidate, select_stimuli
from brainbench.scoring.recovery.selection import keep_stimuli
from tests.factories.candidates import DESIGN, make_candidates


def _pool(informative: int, alike: int, seed: int = 1):
    """Return candidates that differ for the first stimuli alone; for the rest all three are the same."""
    random = np.random.default_rng(seed)
    names = [f"s{index}" for index in range(informative + alike)]
    shared = random.standard_normal((len(names), 6))
    found = []
    for name in "abc":
        values = shared.copy()
        values[:informative] = random.standard_normal((informative, 6))
        found.append(Candidate.of(name, names, {"x": values}))
    return tuple(found)


def test_stimuli_that_tell_nothing_are_left_out():
    found = 0
    for seed in range(6):
        chosen = select_stimuli(_pool(8, 12, seed), 8, DESIGN, boards=4, exchanges=250)
        found += len(set(chosen.rows) & set(range(8)))
        assert chosen.gain > 0
        assert chosen.stimuli == tuple(f"s{row}" for row in chosen.rows)
    # Of 48 picks at random 19 ± 3 would tell the candidates apart by themselves; pairs with the others tell too.
    assert found >= 30


def test_the_choice_is_the_same_again():
    pool = _pool(5, 5)
    assert select_stimuli(pool, 5, DESIGN, boards=1, exchanges=20) == select_stimuli(
        pool, 5, DESIGN, boards=1, exchanges=20
    )


def test_kept_stimuli_keep_their_features():
    pool = make_candidates(8)
    kept = keep_stimuli(pool, [1, 4])
    assert kept[2].stimuli == ("s1", "s4")
    np.testing.assert_array_equal(kept[2].features["layer1"], pool[2].features["layer1"][[1, 4]])


def test_more_stimuli_than_the_pool_has_are_refused():
    for keep in (3, 9, 4.5):
        with pytest.raises(UsageError, match=f"the 8 of the pool .*received {keep}"):
            select_stimuli(make_candidates(8), keep, DESIGN)
    with pytest.raises(UsageError, match="at least 2"):
        select_stimuli(make_candidates(8, names=("a",)), 4, DESIGN)
    with pytest.raises(UsageError, match="'procrustes'"):
        select_stimuli(make_candidates(8), 4, replace(DESIGN, metric="procrustes"))
