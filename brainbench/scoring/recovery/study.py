"""Run the boards of a recovery, on this machine or a cluster, and go on where an earlier run stopped.

:func:`find_cheapest` repeats that with growing designs until the true candidate comes first often enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.files import read_json, to_plain, write_json
from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.regular import readable
from brainbench.core.records import Interval
from brainbench.core.runs.folder import begin_run
from brainbench.core.runs.jobs import run_jobs
from brainbench.metrics.measures.metric import get_metric
from brainbench.scoring.recovery.boards import Candidate, RecoveryBoard, RecoveryDesign, make_board
from brainbench.scoring.recovery.confusion import Recovery

BOARDS = 10
_TOGETHER = 5  # boards that one job makes and one file keeps


@dataclass(frozen=True)
class _Job:
    """Some boards of one true candidate."""

    true: int
    numbers: tuple[int, ...]

    @property
    def file(self) -> str:
        """Name of the file of its boards in the folder of a study."""
        return f"boards-{self.true:03d}-{self.numbers[0]:05d}.json"


def recover(
    candidates: Sequence[Candidate],
    design: RecoveryDesign | None = None,
    *,
    boards: int = BOARDS,
    first: int = 0,
    folder: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Recovery:
    """Draw boards from every candidate and count how often the true one wins.

    Neither ``workers`` nor the scheduler changes a number. With a folder, a run that was killed goes on when it is
    started again. ``first`` is the number of the first board: boards of other numbers have other animals. A folder
    keeps finished boards; ``scheduler`` is the address of a Dask scheduler, whose workers make the boards instead of
    processes here.
    """
    design = design or RecoveryDesign()
    check_candidates(candidates, design, boards)
    check_number("The number of the first board", first, least=0, whole=True)
    jobs = [
        _Job(true, tuple(range(start, min(start + _TOGETHER, first + boards))))
        for start in range(first, first + boards, _TOGETHER)
        for true in range(len(candidates))
    ]
    results: dict[_Job, list[RecoveryBoard]] = {}
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        config = {"candidates": [item.identity for item in candidates], "design": design}
        begin_run(folder, config, "recovery", results="boards-*.json")
        for job in jobs:
            if (folder / job.file).is_file():
                with readable(folder / job.file, "part of a recovery", "Delete it to make it again."):
                    stored = [RecoveryBoard.of(item) for item in read_json(folder / job.file)]
                if [item.number for item in stored] == list(job.numbers):
                    results[job] = stored
    missing = [job for job in jobs if job not in results]
    total = done = sum(len(job.numbers) for job in jobs)
    done -= sum(len(job.numbers) for job in missing)
    work = partial(_make_boards, tuple(candidates), design)
    for place, finished in run_jobs(work, missing, workers=workers, scheduler=scheduler):
        job = missing[place]
        results[job] = finished
        done += len(finished)
        if folder is not None:
            write_json(folder / job.file, to_plain([board.stored for board in finished]))
        if progress is not None:
            progress(done, total, "scoring boards")
    every = sorted((board for job in jobs for board in results[job]), key=lambda board: (board.true, board.number))
    count = design.stimuli or len(candidates[0].stimuli)
    return Recovery(tuple(item.name for item in candidates), design, count, tuple(every))


def _make_boards(candidates: tuple[Candidate, ...], design: RecoveryDesign, job: _Job) -> list[RecoveryBoard]:
    return [make_board(candidates, design, job.true, number) for number in job.numbers]


def check_candidates(candidates: Sequence[Candidate], design: RecoveryDesign, boards: int) -> None:
    """Raise UsageError for what cannot be run, before any work."""
    check_number("number of candidates, which a recovery tells apart,", len(candidates), least=2)
    check_number("The number of boards", boards, least=1, whole=True)
    pool = len(candidates[0].stimuli)
    if any(item.stimuli != candidates[0].stimuli for item in candidates):
        raise UsageError("The candidates saw different stimuli; run all of them on the same ones in the same order.")
    if design.stimuli is not None and design.stimuli > pool:
        raise UsageError(f"A board of {design.stimuli} stimuli was asked for; the pool has {pool}.")
    if get_metric(design.metric).of_model_alone:
        raise UsageError(
            f"The metric {design.metric!r} scores a model without looking at the animals, so it cannot tell who made "
            "their data; choose another, such as 'rsa'."
        )
    if design.layer not in ("any", "last"):
        for candidate in candidates:
            candidate.choose(design.layer, np.random.default_rng(0))


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


def _cost(numbers: tuple[int, int, int, int]) -> tuple[int, int, int]:
    """Return what a design costs: trials of all animals together, then units, then animals."""
    animals, units, trials, stimuli = numbers
    return animals * trials * stimuli, units, animals


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
    grid = sorted(product(ANIMALS, UNITS, TRIALS, sizes), key=_cost)
    tried: list[TriedDesign] = []
    failed: list[tuple[int, ...]] = []

    def measured(animals: int, units: int, trials: int, stimuli: int, **counted: int) -> TriedDesign:
        population = replace(design.population, animals=animals, units=units, trials=trials)
        changed = replace(design, population=population, stimuli=stimuli)
        result = recover(candidates, changed, **counted, **where)
        return TriedDesign(animals, units, trials, stimuli, result.win_rate, result.wins())

    for numbers in track(grid, "trying designs", progress):
        if any(all(mine <= other for mine, other in zip(numbers, one, strict=True)) for one in failed):
            continue
        attempt = measured(*numbers, boards=boards, first=0)
        tried.append(attempt)
        if attempt.interval.high < wanted:
            failed.append(numbers)
        elif attempt.win_rate >= wanted:
            # The first to reach a rate by luck would be returned too often: it must do so again.
            again = measured(*numbers, boards=2 * boards, first=boards)
            tried[-1] = again
            if again.win_rate >= wanted:
                return again, tuple(tried)
    return None, tuple(tried)
