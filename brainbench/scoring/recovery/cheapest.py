"""Search for the cheapest design whose true candidate comes first as often as is wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_number
from brainbench.core.records import Interval
from brainbench.scoring.recovery.candidates import Candidate
from brainbench.scoring.recovery.design import RecoveryDesign
from brainbench.scoring.recovery.study import recover

ANIMALS = (2, 4, 6, 10, 16)
UNITS = (20, 60, 120)
TRIALS = (5, 10, 20)
STIMULI = (6, 10, 20, 40, 80)
"""Numbers that are tried, as far as the pool allows."""


@dataclass(frozen=True)
class TriedDesign:
    """One design of the search."""

    animals: int
    units: int
    trials: int
    """Trials of each stimulus."""
    stimuli: int
    win_rate: float
    """Share of boards in which the true candidate came first."""
    interval: Interval
    """Wilson's interval of ``win_rate``."""


def find_cheapest(
    candidates: Sequence[Candidate],
    design: RecoveryDesign,
    wanted: float,
    *,
    boards: int = 5,
    progress: Progress | None = None,
    **where: Any,
) -> tuple[TriedDesign | None, tuple[TriedDesign, ...]]:
    """Try designs from the cheapest on, and return the first that reaches a win rate, with all that were tried.

    Cost is the number of trials of all animals, then the number of units. A design with no more of anything than one
    that failed clearly (interval below ``wanted``) is not tried. The one returned reaches the rate on boards of other
    numbers too. The design's numbers of animals, units, trials and stimuli are replaced; ``where`` are ``workers`` and
    ``scheduler`` of :func:`recover`.
    """
    check_number("The wanted rate", wanted, above=0, below=1)
    pool = len(candidates[0].stimuli)
    sizes = [size for size in STIMULI if size < pool] + [pool]
    grid = sorted(product(ANIMALS, UNITS, TRIALS, sizes), key=lambda one: (one[0] * one[2] * one[3], one[1], one[0]))
    tried: list[TriedDesign] = []
    failed: list[tuple[int, ...]] = []

    def measured(animals: int, units: int, trials: int, stimuli: int, **counted: int) -> TriedDesign:
        population = replace(design.population, animals=animals, units=units, trials=trials)
        changed = replace(design, population=population, stimuli=stimuli)
        found = recover(candidates, changed, **counted, **where)
        return TriedDesign(animals, units, trials, stimuli, found.win_rate, found.wins())

    for numbers in track(grid, "trying designs", progress):
        if any(all(mine <= other for mine, other in zip(numbers, one, strict=True)) for one in failed):
            continue
        found = measured(*numbers, boards=boards, first=0)
        tried.append(found)
        if found.interval.high < wanted:
            failed.append(numbers)
        elif found.win_rate >= wanted:
            # The first to reach a rate by luck would be returned too often: it must do so again.
            again = measured(*numbers, boards=2 * boards, first=boards)
            tried[-1] = again
            if again.win_rate >= wanted:
                return again, tuple(tried)
    return None, tuple(tried)
